"""Spacecraft: state, settings, attitude history and star rates."""

from typing import Literal

from pydantic import Field

from service.web.schemas.answers import Summary
from service.web.schemas.base import (
    Count,
    Covariance,
    Digest,
    Id,
    Moment,
    Quaternion,
    Settings,
    Shape,
    Status,
)


class AttitudeRow(Shape):
    """An attitude in a history."""

    id: Id
    batch: str
    time: Moment
    quaternion: Quaternion
    frame: Literal["EME2000"]
    covariance_arcsec2: Covariance
    residual_rms_arcsec: float
    predicted_rms_arcsec: float
    taste: float
    method: Literal["quest", "triad"]
    status: Status


class AttitudePage(Shape):
    """A page of attitudes."""

    items: list[AttitudeRow]
    next_cursor: str | None


class SpacecraftRow(Shape):
    """How a spacecraft stands in a run."""

    name: str
    description: str
    state: Literal["good", "suspect", "no_attitude", "no_batches"] = Field(
        description="That of the latest batch."
    )
    latest_batch: Summary | None
    attitude: AttitudeRow | None = Field(
        description="Of the latest batch; null where that has none, whatever came before."
    )
    last_attitude: AttitudeRow | None = Field(
        description="The latest there is: it may be older than the latest batch, see its time."
    )


class SpacecraftList(Shape):
    """Every spacecraft."""

    items: list[SpacecraftRow]


class MissionNow(Shape):
    """A mission's settings as they are."""

    digest: Digest
    settings: Settings


class MissionThen(MissionNow):
    """A mission's settings as they were at some time."""

    since: Moment


class SpacecraftState(SpacecraftRow):
    """How a spacecraft stands, and its mission's settings with their history."""

    mission: MissionNow
    history: list[MissionThen] = Field(
        description="Oldest first; who goes back to earlier settings uses them anew."
    )


class Rates(Shape):
    """Sums over the batches of a bucket."""

    start: Moment
    batches: Count
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count
    solved: Count = Field(description="Batches with an attitude.")
    suspect: Count = Field(description="Batches with a suspect one.")


class RateList(Shape):
    """The buckets that hold batches, oldest first."""

    items: list[Rates]
