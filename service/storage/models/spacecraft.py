"""Spacecraft: state, settings, star rates, and histories of attitudes and quantities."""

from typing import Annotated, ClassVar, Literal

from msgspec import UNSET, UnsetType
from pydantic import Field

from service.acquire.result import TrackingState
from service.alarms.quantities import QuantityName
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


Numbers = list[float | None]


class Series(Record, frozen=True, kw_only=True):
    """A quantity. `minmax`: mean, least and greatest of each bucket; `latest`: single values."""

    component: ClassVar[str] = "Series"
    unit: Annotated[str, Field(examples=["arcsec"])]
    count: Annotated[list[Count], doc("`minmax`: batches with a value.")] | UnsetType = UNSET
    mean: (
        Annotated[Numbers, doc("`minmax`: for shares, over all stars or batches.")] | UnsetType
    ) = UNSET
    min: Annotated[Numbers, doc("Least value of a batch.")] | UnsetType = UNSET
    max: Annotated[Numbers, doc("Greatest value of a batch.")] | UnsetType = UNSET
    value: Annotated[Numbers, doc("`latest`: the value of each batch.")] | UnsetType = UNSET


class History(Record, frozen=True, kw_only=True):
    """Quantities over a period of time, oldest first; null: unknown."""

    component: ClassVar[str] = "History"
    spacecraft: str
    run: str
    tracker: Annotated[str, doc("If the request names one.")] | UnsetType = UNSET
    not_split: (
        Annotated[
            bool,
            doc(
                "With `tracker`: true while older batches of the run are not split by tracker yet, "
                "and so are missing here."
            ),
        ]
        | UnsetType
    ) = UNSET
    start: Moment | None
    end: Moment | None
    strategy: Literal["minmax", "latest"]
    bucket_s: Annotated[int | None, doc("The width of a bucket; null for single batches.")]
    source: Annotated[
        Literal["batch", "hour", "day"],
        doc("The source of the data; both ends of the period are exact in any case."),
    ]
    thinned: Annotated[bool, doc("Whether the period has more batches than the answer has points.")]
    unix_s: Annotated[
        list[float],
        doc(
            "POSIX time of the beginning of each bucket, or of each batch. Empty buckets are "
            "omitted."
        ),
    ]
    batches: Annotated[list[Count], doc("`minmax`: batches in each bucket.")] | UnsetType = UNSET
    time: Annotated[list[Moment], doc("`latest` only, like the next two fields.")] | UnsetType = (
        UNSET
    )
    id: list[Id] | UnsetType = UNSET
    batch: list[str] | UnsetType = UNSET
    series: dict[QuantityName, Series]


class RankedBatch(Summary, frozen=True, kw_only=True):
    """A batch with its value of the chosen quantity."""

    component: ClassVar[str] = "WorstBatch"
    value: float


class Ranking(Record, frozen=True, kw_only=True):
    """The worst batches of a period."""

    component: ClassVar[str] = "WorstList"
    by: QuantityName
    tracker: Annotated[str, doc("If the request names one.")] | UnsetType = UNSET
    not_split: (
        Annotated[bool, doc("With `tracker`: true while older batches are not split by tracker.")]
        | UnsetType
    ) = UNSET
    items: list[RankedBatch]
