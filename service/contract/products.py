"""Attitudes as products: series, at a moment, live; how they are made, and how far they agree."""

from typing import Annotated, Literal

from msgspec import UNSET, UnsetType
from pydantic import Field

from service.contract.base import (
    Components,
    Count,
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

ContinuousQuaternion = Annotated[
    list[float],
    doc(
        "Transforms inertial into body components; scalar last. Signs are continuous within a "
        "stretch, so qc may be negative."
    ),
]


class ProductAttitude(Record, frozen=True, kw_only=True):
    """An attitude of a series."""

    time: Moment
    quaternion: ContinuousQuaternion
    covariance_arcsec2: Covariance
    rate_deg_per_s: Components | None
    """Rate of the body relative to inertial space, in body axes; null: unknown."""
    rate_origin: Literal["own", "derived", "estimated", "none"]
    """`own`: of the batch. `derived`: from the attitudes before and after. `estimated`: by the
    filter."""
    status: Status
    method: Annotated[
        str, DescribedAs(Literal["quest", "triad", "measured", "ekf", "filter_smoother"])
    ]
    """`ekf` of the grade `filtered`, `filter_smoother` of `smoothed`."""
    residual_rms_arcsec: float | None
    """null unless the grade is `raw` and the attitude is of stars."""
    predicted_rms_arcsec: Annotated[float | None, doc("null unless the grade is `raw`.")]
    stretch: Annotated[Count, doc("Number of the unbroken stretch, from 0.")]
    batch: Annotated[str | None, doc("null unless the grade is `raw`.")]
    id: Annotated[Id, doc("The result's id; unless the grade is `raw`, the revision's.")]
    model: Literal["gyro", "constant_rate"] | UnsetType = UNSET
    """What the filter knows of the motion: the rates of a gyro, or that the rate is constant but
    for a random walk. Absent if the grade is `raw`."""
    revision: int | UnsetType = UNSET
    """Number of the revision of the day's attitudes, from 1. Absent if the grade is `raw`."""
    bias_deg_per_h: Components | UnsetType | None = UNSET
    """Bias of the gyro, in body axes; null at a constant rate. Absent if the grade is `raw`."""
    bias_sigma_deg_per_h: Components | UnsetType = UNSET
    """One sigma of the bias or, at a constant rate, of the rate. Absent if the grade is `raw`."""


class AttitudeProduct(Record, frozen=True, kw_only=True):
    """Attitudes in order of time."""

    about: Annotated[dict[str, str], doc("Where the attitudes come from: filters and origin.")]
    items: list[ProductAttitude]


class AttitudeAtMoment(Record, frozen=True, kw_only=True):
    """The attitude at a moment, with its error."""

    time: Moment
    method: Literal["nearest", "interpolated"]
    quaternion: ContinuousQuaternion
    covariance_arcsec2: Covariance
    """Covariance due to the attitudes used and the motion. Between two batches their errors are
    independent; between filtered or smoothed samples it is the weighted mean."""
    motion_arcsec: float | None
    """The error that the motion adds. Nearest: the angle that the body turns until the moment.
    Interpolated: an eighth of the step times the change of the rate, over more than a quarter turn
    a bound from the rates. Null: no rate is known."""
    offset_s: Annotated[float, doc("From the moment to the nearest attitude that was used.")]
    ids: Annotated[list[Id], doc("The results that were used.")]


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
