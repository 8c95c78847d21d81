"""Days of filtered and smoothed attitudes as they are recorded."""

from typing import Annotated

from pydantic import Field

from service.storage.models.base import Count, Digest, Id, Moment, Record, Stamp, doc


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
