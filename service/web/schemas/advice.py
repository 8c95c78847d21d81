"""Advice: what recorded batches say of a mission's settings."""

from typing import Annotated, Literal

from pydantic import Field

from service.missions.mission import Identifier
from service.web.schemas.base import Components, Count, Digest, Moment, Shape

Text = Annotated[str, Field(description="The finding in plain words.")]
Action = Annotated[
    Literal["widen", "tighten", "keep", "correct", "wait"],
    Field(description="What to do; `wait` until more was seen."),
]
Size = Literal["too_small", "fits", "too_large", "no_verdict"]


class Estimate(Shape):
    """An estimate with its 95 % interval; null where the sample does not bound it."""

    value: float
    low: float | None
    high: float | None


class ToleranceAdvice(Shape):
    """A tolerance beside the differences between what was seen and the catalog."""

    tolerance: str = Field(description="By the name in the mission's file.")
    symbol: str = Field(description="The paper's.")
    unit: Literal["deg", "mag"]
    now: float
    verdict: Literal["too_tight", "fits", "too_wide", "no_verdict", "not_used"]
    confidence: Literal["high", "moderate", "low", "none"]
    differences: Count
    batches: Count
    needed: Estimate | None = Field(description="What lets 99 % of the true pairs, or stars, pass.")
    share_beyond: Estimate | None = Field(description="Of the true ones that the value loses.")
    recommended: float | None
    action: Action
    text: Text


class GroupAdvice(Shape):
    """What no setting of the identification mends: two groups of stars, mirrored axes."""

    action: Action
    text: Text


class NoiseAdvice(Shape):
    """A tracker's noise, one standard deviation per tangent axis."""

    tracker: str
    now_arcsec: float
    sigma_arcsec: Estimate | None
    batches: Count
    verdict: Size
    action: Action
    text: Text


class MagnitudeAdvice(Shape):
    """observed = catalog + offset + (scale - 1) (catalog - pivot)."""

    tracker: str
    pivot_mag: float | None = Field(description="The median of the catalog magnitudes.")
    offset_mag: Estimate | None = Field(description="At the pivot; above zero: measured fainter.")
    scale: Estimate | None
    now_sigma_mag: float
    scatter_mag: Estimate | None = Field(description="One standard deviation about the line.")
    stars: Count
    verdict: Literal["off", "fits", "no_verdict"]
    scatter_verdict: Size
    action: Action
    text: Text


class AlignmentAdvice(Shape):
    """How a tracker is turned from where the mission has it, as seen by its first tracker."""

    tracker: str
    reference: str
    rotation_arcsec: Annotated[list[Estimate], Field(min_length=3, max_length=3)] | None = Field(
        description="Rotation vector about the body axes."
    )
    axes_body: Annotated[list[Components], Field(min_length=3, max_length=3)] | None = Field(
        description="The tracker's x, y and z axis as they are, where that is certain."
    )
    batches: Count
    verdict: Literal["off", "fits", "no_verdict"]
    action: Action
    text: Text


class Tried(Shape):
    """What the stars of the sample would have come to with other settings."""

    name: str
    identifier: Identifier
    tolerances: dict[str, float]
    batches: Count
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count
    named_otherwise: Count = Field(
        description="Unique here and by verified identification, but not the same star."
    )
    change_points: Estimate | None = Field(
        description=(
            "Change of the share that is not unique, in percentage points, from the votes with "
            "the present settings; null for what is not compared."
        )
    )


class Change(Shape):
    """A line for the mission's file."""

    table: Literal["tolerances", "catalog", "trackers"]
    tracker: str | None
    line: str


class Advice(Shape):
    """What recorded batches say of a mission's settings."""

    spacecraft: str
    run: str
    first: Moment | None = Field(description="Time of the first batch of the sample.")
    last: Moment | None
    batches_in_range: Count
    batches_sampled: Count = Field(description="Those that were run again.")
    batches_identified: Count
    batches_refused: Count = Field(description="Those that do not fit the mission any more.")
    refusal: str | None
    mission: Digest
    identifier: Identifier
    groups: list[GroupAdvice] = Field(
        description="Batches in which two groups of stars have each an attitude of their own, and "
        "mirrored ones; empty where there are none."
    )
    tolerances: list[ToleranceAdvice]
    noise: list[NoiseAdvice]
    magnitudes: list[MagnitudeAdvice]
    alignment: list[AlignmentAdvice]
    tried: list[Tried]
    changes: list[Change]
