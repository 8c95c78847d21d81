"""API records of advice on the settings of a mission."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from service.contract.base import Components, Count, Digest, Moment, Record, doc
from service.missions.mission import Identifier

Text = Annotated[str, doc("The finding as a sentence.")]
Action = Annotated[
    Literal["widen", "tighten", "keep", "correct", "wait"],
    doc("What to do; `wait`: more batches are needed."),
]
Size = Literal["too_small", "fits", "too_large", "no_verdict"]


class Estimate(Record, frozen=True, kw_only=True):
    """An estimated value with its 95 % interval; null where the sample gives no bound."""

    value: float
    low: float | None
    high: float | None


class ToleranceAdvice(Record, frozen=True, kw_only=True):
    """A tolerance, compared with the differences between measurements and catalog."""

    tolerance: Annotated[str, doc("The name in the mission file.")]
    symbol: Annotated[str, doc("The symbol of Fink & Shoup (1994).")]
    unit: Literal["deg", "mag"]
    now: float
    verdict: Literal["too_tight", "fits", "too_wide", "no_verdict", "not_used"]
    confidence: Literal["high", "moderate", "low", "none"]
    differences: Count
    batches: Count
    needed: Estimate | None
    """Value of the tolerance that accepts 99 % of the true pairs or stars."""
    share_beyond: Estimate | None
    """Share of the true pairs or stars that the present tolerance rejects."""
    recommended: float | None
    """Recommended tolerance for identification by votes; `not_used` marks another identifier."""
    action: Action
    text: Text


class GroupAdvice(Record, frozen=True, kw_only=True):
    """Findings that no setting can correct: two groups of stars, mirrored axes."""

    action: Action
    text: Text


class ZoneAdvice(Record, frozen=True, kw_only=True):
    """A finding on the size of the zone or on the largest separation of indexed pairs."""

    action: Action
    text: Text


class NoisePeriodAdvice(Record, frozen=True, kw_only=True):
    """A tracker's noise over consecutive batches."""

    sigma_arcsec: Estimate
    batches: Count
    first: Annotated[Moment, doc("Time of the first batch of the period.")]
    last: Moment


class NoiseAdvice(Record, frozen=True, kw_only=True):
    """A tracker's noise, one standard deviation per tangent axis."""

    tracker: str
    now_arcsec: float
    sigma_arcsec: Estimate | None
    batches: Count
    verdict: Size
    worst: NoisePeriodAdvice | None
    """A period in which the noise was certainly larger than `sigma_arcsec`."""
    action: Action
    text: Text


class MagnitudeAdvice(Record, frozen=True, kw_only=True):
    """Magnitude fit of a tracker: observed = catalog + offset + (scale - 1) (catalog - pivot)."""

    tracker: str
    pivot_mag: Annotated[float | None, doc("The median of the catalog magnitudes.")]
    offset_mag: Estimate | None
    """Magnitude offset at the pivot; positive if the tracker measures fainter than the catalog."""
    scale: Estimate | None
    now_sigma_mag: float
    scatter_mag: Annotated[Estimate | None, doc("One standard deviation about the line.")]
    stars: Count
    verdict: Literal["off", "fits", "no_verdict"]
    scatter_verdict: Size
    action: Action
    text: Text


class AlignmentAdvice(Record, frozen=True, kw_only=True):
    """Rotation of a tracker from its place in the mission file, relative to the first tracker."""

    tracker: str
    reference: str
    rotation_arcsec: Annotated[list[Estimate], Field(min_length=3, max_length=3)] | None
    """Rotation vector of the tracker about the body axes."""
    axes_body: Annotated[list[Components], Field(min_length=3, max_length=3)] | None
    """Measured x, y and z axes of the tracker in the body frame; null: not determined."""
    batches: Count
    verdict: Literal["off", "fits", "no_verdict"]
    action: Action
    text: Text


class InnovationAdvice(Record, frozen=True, kw_only=True):
    """Noise of the gyro or the attitudes, estimated from the filter's innovations."""

    subject: Literal["gyro", "attitudes"]
    """Judged noise: `gyro`, sigma_v of the mission, or `attitudes`, the recorded covariances."""
    ratio: Estimate | None
    """Ratio of true to assumed standard deviation; null with too little data."""
    measurements: Annotated[Count, doc("Innovations that were used.")]
    action: Action
    text: Text


class Trial(Record, frozen=True, kw_only=True):
    """Outcomes of the sample's stars with other settings."""

    component: ClassVar[str] = "Tried"
    name: str
    identifier: Identifier
    tolerances: dict[str, float]
    batches: Count
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count
    named_otherwise: Count
    """Number of stars unique here and under `verified`, but as different catalog stars."""
    change_points: Estimate | None
    """Change of the share of stars that are not unique, in percentage points, relative to votes
    with     the present settings; null: not compared.
    """


class Change(Record, frozen=True, kw_only=True):
    """A line to write into the mission file."""

    table: Literal["zone", "tolerances", "catalog", "trackers", "gyro"]
    tracker: str | None
    line: str


class Cause(Record, frozen=True, kw_only=True):
    """A cause of ambiguous or unmatched stars, found in recorded answers."""

    batches: Annotated[Count, doc("Batches of the sample with such stars that it explains.")]
    text: Text
    evidence: Annotated[str, doc("The figures, beside those of the day before.")]
    remedy: Annotated[str, doc("What to do.")]
    effect: Annotated[str, doc("The share of the stars that it concerns.")]
    over_since: Annotated[
        Moment | None, doc("Time of the last such batch of a cause that is over.")
    ]


class Advice(Record, frozen=True, kw_only=True):
    """Recommended settings of a mission, from recorded batches."""

    spacecraft: str
    run: str
    first: Annotated[Moment | None, doc("Time of the first batch of the sample.")]
    last: Moment | None
    batches_in_range: Count
    batches_sampled: Annotated[Count, doc("Batches that were processed again.")]
    batches_identified: Count
    batches_refused: Annotated[Count, doc("Batches that the mission's present settings refuse.")]
    refusal: str | None
    mission: Digest
    identifier: Identifier
    causes: Annotated[list[Cause], doc("Those that explain the most batches first.")]
    groups: list[GroupAdvice]
    """Findings on batches in which two groups of stars give two attitudes, and on mirrored
    batches."""
    zone: Annotated[list[ZoneAdvice], doc("By the a priori errors of the run's latest batches.")]
    tolerances: list[ToleranceAdvice]
    noise: list[NoiseAdvice]
    magnitudes: list[MagnitudeAdvice]
    alignment: list[AlignmentAdvice]
    innovations: list[InnovationAdvice]
    """Advice from the days that `acquire smooth` recorded; empty without `[gyro]`."""
    tried: list[Trial]
    changes: list[Change]
