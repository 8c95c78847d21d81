"""The answer to a batch, and answers in lists."""

from typing import Literal

from pydantic import Field

from service.observe.wire import BatchIn
from service.web.schemas.base import (
    Count,
    Covariance,
    Digest,
    Id,
    Moment,
    Outcome,
    Quaternion,
    Reason,
    Settings,
    Shape,
    Status,
)


class StarRef(Shape):
    """A star of the catalog."""

    catalog: str = Field(examples=["HIP"])
    id: str = Field(examples=["HIP 26311"])


class StarOut(Shape):
    """What became of one observed star."""

    outcome: Outcome
    star: StarRef | None
    votes: Count = Field(description="STARID's highest tally.")
    runner_up: Count = Field(description="The second highest; equal to `votes` in a tie.")
    rivals: list[str] = Field(default=[], description="The tied stars, where it is ambiguous.")
    probability: float | None = Field(description="null where the identifier gives none.")
    residual_arcsec: float | None = Field(description="null where the star is in no attitude.")
    flags: list[Literal["outside_field_of_view", "no_magnitude"]]


class ZoneSummary(Shape):
    """The part of the sky that stars were looked for in."""

    kind: Literal["cap", "band"]
    ra_deg: float = Field(description="Of the cap's centre, of the band's pole.")
    dec_deg: float
    stars: Count = Field(description="NCAP.")
    pairs: Count = Field(description="NTOT.")


class ZoneOut(ZoneSummary):
    """A zone as a batch met it."""

    cached: bool


class TrackerOut(Shape):
    """One tracker's stars, in the order observed."""

    tracker: str
    zone: ZoneOut
    stars: list[StarOut]


class CountsOut(Shape):
    """Stars by outcome."""

    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count


class TrackerFitOut(Shape):
    """How one tracker agrees with the attitude of all."""

    tracker: str
    stars: Count
    taste: float
    outlier: bool


class AttitudeOut(Shape):
    """An attitude with all that tells how far to trust it."""

    quaternion: Quaternion
    frame: Literal["EME2000"]
    covariance_arcsec2: Covariance
    method: Literal["quest", "triad"]
    residual_rms_arcsec: float
    predicted_rms_arcsec: float
    taste: float = Field(description="Weighted sum of squares; about chi-square.")
    degrees_of_freedom: Count
    status: Status = Field(description="`suspect`: `taste` is beyond its 99.9 % point.")
    triad: Quaternion
    quest: Quaternion
    triad_quest_angle_arcsec: float
    trackers: list[TrackerFitOut] = Field(default=[], description="Where there are several.")
    outlier: str | None = Field(default=None, description="The tracker that disagrees.")


class TimingsOut(Shape):
    """Microseconds per step."""

    zone: Count
    identify: Count
    solve: Count
    record: int | None = Field(description="null where nothing was recorded.")


class ProvenanceOut(Shape):
    """What the answer was made of."""

    catalog: Digest
    run_catalog: Digest
    epoch_year: float
    mission: Digest
    version: str


class Answer(Shape):
    """The answer to a batch, as it is recorded."""

    id: Id | None = Field(description="null for a what-if that was not recorded.")
    spacecraft: str
    batch: str
    run: str
    time: Moment
    identifier: Literal["starid", "verified", "ptp", "lost_in_space"]
    path: Literal["zone"]
    observations: list[TrackerOut]
    counts: CountsOut
    attitude: AttitudeOut | None
    reason: Reason | None = Field(description="Why there is no attitude.")
    warnings: list[str]
    timings_us: TimingsOut
    provenance: ProvenanceOut
    parent: Id | None = Field(
        default=None, description="Of a what-if, and only there: the result it was made from."
    )
    recorded: bool = Field(default=True, description="Of a what-if: whether it was kept.")


class Summary(Shape):
    """A result in a list: all but its stars and its attitude."""

    id: Id
    spacecraft: str
    batch: str
    run: str
    time: Moment
    received: Moment = Field(description="When the batch first came.")
    created: Moment = Field(description="When this result was recorded.")
    identifier: str
    options: Settings = Field(description="What was asked to be done otherwise.")
    counts: CountsOut
    status: Status | None = Field(description="Of the attitude; null where there is none.")
    reason: Reason | None
    parent: Id | None = Field(description="Of a what-if: the result it was made from.")
    current: bool = Field(description="Whether it stands for its batch.")


class BatchPage(Shape):
    """A page of results."""

    items: list[Summary]
    next_cursor: str | None


class Record(Shape):
    """A result with the batch it was made of and the other results of that batch."""

    answer: Answer
    input: BatchIn = Field(description="The batch as it was sent, defaults left out.")
    options: Settings = Field(
        description="What this result was asked to do otherwise than its mission; the mission's "
        "own settings are those of `provenance.mission`."
    )
    current: bool
    parent: Id | None
    what_ifs: list[Summary]
