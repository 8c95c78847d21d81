"""Attitude over time: the live one, how days get a definitive one, and how far they agree."""

from typing import Annotated, Literal

from pydantic import Field

from service.contract.base import (
    Components,
    Covariance,
    DescribedAs,
    Id,
    Moment,
    Quaternion,
    Record,
    Stamp,
    Status,
    doc,
    list_record,
    page_record,
)


class Innovation(Record, frozen=True, kw_only=True):
    """How a measured attitude met the filter, and how it differs from the smoothed attitude."""

    time: Moment
    outcome: Annotated[
        str, DescribedAs(Literal["accepted", "rejected", "started", "undecided", "unused"])
    ]
    """`accepted` and `started` measurements are used; `started`: with it the filter began.
    `undecided`: it agrees with two attitudes that contradict each other."""
    innovation_arcsec: Components | None
    """From prediction to measurement, about the body axes; null: nothing was predicted."""
    innovation_sigma_arcsec: Components | None
    """One sigma of prediction and measurement together."""
    chi_square: float | None
    """Chi-square of the innovation, with three degrees of freedom: 3 on average."""
    difference_arcsec: Components
    """From the smoothed attitude to the measured one, about the body axes."""
    difference_sigma_arcsec: Components
    """One sigma; the smoothed attitude is partly made of the measured one."""
    model: Annotated[str, DescribedAs(Literal["gyro", "constant_rate"])]
    revision: Annotated[int, Field(ge=1), doc("Revision of the day.")]


InnovationPage = page_record("InnovationPage", Innovation, "A page of innovations.")


class DefinitiveJob(Record, frozen=True, kw_only=True):
    """The making of a definitive attitude: filtered and smoothed attitudes of recorded days."""

    id: Id
    spacecraft: str
    run: str
    start: Annotated[Moment | None, doc("null: from the first day with batches.")]
    end: Annotated[Moment | None, doc("null: to the last.")]
    who: Annotated[str, doc("`schedule`: the mission asks for it each day.")]
    created: Stamp
    ended: Stamp | None
    state: Annotated[
        str, DescribedAs(Literal["queued", "running", "done", "failed", "interrupted"])
    ]
    done: Annotated[int, doc("Days that are finished.")]
    total: Annotated[int, doc("Days with batches; 0 until they are counted.")]
    recorded: Annotated[int, doc("Days that got a new revision; the others had not changed.")]
    fault: str | None


DefinitiveJobList = list_record(
    "DefinitiveJobList", DefinitiveJob, "Jobs since the start of the service, the newest first."
)


class LiveAttitude(Record, frozen=True, kw_only=True):
    """The filtered attitude at the last epoch of live data; use it only where `status` is good."""

    spacecraft: str
    time: Annotated[Moment, doc("Time of the last gyro sample or, without a gyro, measurement.")]
    quaternion: Quaternion
    covariance_arcsec2: Covariance
    rate_deg_per_s: Components
    """Rate of the body relative to inertial space, in body axes."""
    bias_deg_per_h: Components | None
    """Bias of the gyro, in body axes; null at a constant rate."""
    bias_sigma_deg_per_h: Components
    """One sigma of the bias or, at a constant rate, of the rate."""
    status: Status
    """`suspect`: measurements contradict it, or have not confirmed it yet."""
    model: Annotated[str, DescribedAs(Literal["gyro", "constant_rate"])]
