"""Spacecraft: state, settings, attitude history and star rates."""

from typing import Annotated, ClassVar, Literal

from service.acquire.result import TrackingState
from service.storage.models.answers import Summary
from service.storage.models.base import (
    Count,
    Covariance,
    DescribedAs,
    Digest,
    Id,
    MissionSettings,
    Moment,
    Quaternion,
    Record,
    Stamp,
    Status,
    doc,
)


class AttitudeRow(Record, frozen=True, kw_only=True):
    """An attitude in a history."""

    component: ClassVar[str] = "AttitudeRow"
    id: Id
    batch: str
    time: Moment
    quaternion: Quaternion
    frame: Annotated[str, DescribedAs(Literal["EME2000"])]
    covariance_arcsec2: Covariance
    residual_rms_arcsec: Annotated[
        float | None, doc("Null, as the next two, of an attitude that a tracker measured itself.")
    ]
    predicted_rms_arcsec: float | None
    taste: float | None
    method: Annotated[str, DescribedAs(Literal["quest", "triad", "measured"])]
    status: Status


class AttitudePage(Record, frozen=True, kw_only=True):
    """A page of attitudes."""

    component: ClassVar[str] = "AttitudePage"
    items: list[AttitudeRow]
    next_cursor: str | None


class SpacecraftRow(Record, frozen=True, kw_only=True):
    """The state of a spacecraft in a run."""

    component: ClassVar[str] = "SpacecraftRow"
    name: str
    description: str
    retired: Annotated[bool, doc("True if no mission file describes it any more.")]
    state: Annotated[
        Literal["good", "suspect", "no_attitude", "no_batches"],
        doc("State of the latest batch."),
    ]
    latest_batch: Summary | None
    attitude: Annotated[
        AttitudeRow | None,
        doc("Attitude of the latest batch; null if this batch has none."),
    ]
    last_attitude: Annotated[
        AttitudeRow | None,
        doc("The latest attitude. It can be older than the latest batch; see its time."),
    ]
    tracking: Annotated[
        Annotated[str, DescribedAs(TrackingState)] | None,
        doc("State of the latest batch; null if that does not ask for the last attitude."),
    ]


class SpacecraftList(Record, frozen=True, kw_only=True):
    """Every spacecraft."""

    component: ClassVar[str] = "SpacecraftList"
    items: list[SpacecraftRow]


class MissionNow(Record, frozen=True, kw_only=True):
    """The present settings of a mission."""

    component: ClassVar[str] = "MissionNow"
    digest: Digest
    settings: MissionSettings


class MissionThen(MissionNow, frozen=True, kw_only=True):
    """The settings of a mission at some time."""

    component: ClassVar[str] = "MissionThen"
    since: Stamp


class SpacecraftState(SpacecraftRow, frozen=True, kw_only=True):
    """The state of a spacecraft, and its mission's settings with their history."""

    component: ClassVar[str] = "SpacecraftState"
    mission: MissionNow
    history: Annotated[
        list[MissionThen],
        doc("Oldest first; a return to earlier settings is a new entry."),
    ]


class Rates(Record, frozen=True, kw_only=True):
    """Sums over the batches of a bucket."""

    component: ClassVar[str] = "Rates"
    start: Moment
    batches: Count
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count
    solved: Annotated[Count, doc("Batches with an attitude.")]
    suspect: Annotated[Count, doc("Batches with a suspect attitude.")]


class RateList(Record, frozen=True, kw_only=True):
    """The buckets with batches, oldest first."""

    component: ClassVar[str] = "RateList"
    items: list[Rates]
