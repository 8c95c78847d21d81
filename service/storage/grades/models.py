"""Days of filtered and smoothed attitudes as they are recorded."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from service.storage.models.base import (
    Components,
    Count,
    DescribedAs,
    Digest,
    Id,
    Moment,
    Record,
    Stamp,
    doc,
)


class GradedStretchInfo(Record, frozen=True, kw_only=True):
    """An unbroken stretch of a day."""

    model: Annotated[
        str, doc("`gyro`, or `constant_rate` where no gyro runs: the rate is a random walk.")
    ]
    start: Moment
    end: Moment
    samples: Count
    good: Annotated[dict[str, int], doc("Samples of each grade whose status is good.")]


class DaySummary(Record, frozen=True, kw_only=True):
    """What became of what was recorded of a day."""

    stretches: list[GradedStretchInfo]
    measurements: Annotated[
        dict[str, int],
        doc(
            "Measured attitudes by what became of them: accepted, rejected, started (with it the "
            "filter began), undecided, unused, unusable (its covariance), alone (too few)."
        ),
    ]
    gyro: Annotated[dict[str, int], doc("Samples, gaps, samples beyond the largest rate.")]
    nis_per_degree: Annotated[
        float | None,
        doc("Mean of z^T S^-1 z of the accepted measurements by degrees of freedom: about 1."),
    ]


class GradedDayRow(Record, frozen=True, kw_only=True):
    """A day of filtered and smoothed attitudes."""

    id: Id
    spacecraft: str
    run: str
    day: Annotated[str, Field(pattern=r"^\d{4}-\d\d-\d\d$"), doc("UTC day.")]
    revision: Annotated[int, Field(ge=1)]
    created: Stamp
    samples: Annotated[Count, doc("Of each grade.")]
    inputs: Annotated[Digest, doc("Of all that the day was computed from.")]
    digest: Annotated[Digest, doc("Of what was computed.")]
    summary: DaySummary


class Innovation(Record, frozen=True, kw_only=True):
    """How a measured attitude met the filter, and how it differs from the smoothed attitude."""

    component: ClassVar[str] = "Innovation"
    time: Moment
    outcome: Annotated[
        str,
        DescribedAs(Literal["accepted", "rejected", "started", "undecided", "unused"]),
        doc(
            "`accepted` and `started` measurements are used; `started`: with it the filter began. "
            "`undecided`: it agrees with two attitudes that contradict each other."
        ),
    ]
    innovation_arcsec: Annotated[
        Components | None,
        doc("From prediction to measurement, about the body axes; null: nothing was predicted."),
    ]
    innovation_sigma_arcsec: Annotated[
        Components | None, doc("One sigma of prediction and measurement together.")
    ]
    chi_square: Annotated[
        float | None, doc("Of the innovation, with three degrees of freedom: 3 on average.")
    ]
    difference_arcsec: Annotated[
        Components, doc("From the smoothed attitude to the measured one, about the body axes.")
    ]
    difference_sigma_arcsec: Annotated[
        Components, doc("One sigma; the smoothed attitude is partly made of the measured one.")
    ]
    model: Annotated[str, DescribedAs(Literal["gyro", "constant_rate"])]
    revision: Annotated[int, Field(ge=1), doc("Of the day.")]


class InnovationPage(Record, frozen=True, kw_only=True):
    """A page of innovations."""

    component: ClassVar[str] = "InnovationPage"
    items: list[Innovation]
    next_cursor: str | None


class DefinitiveJob(Record, frozen=True, kw_only=True):
    """The making of a definitive attitude: filtered and smoothed attitudes of recorded days."""

    component: ClassVar[str] = "DefinitiveJob"
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


class DefinitiveJobList(Record, frozen=True, kw_only=True):
    """Jobs since the start of the service, the newest first."""

    component: ClassVar[str] = "DefinitiveJobList"
    items: list[DefinitiveJob]
