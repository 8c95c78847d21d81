"""The data of events, by their kind: of the event stream, and of webhooks."""

from collections.abc import Mapping
from typing import Annotated

from service.acquire.result import TrackingState
from service.storage.models.alarms import Alarm, AnnotationChange, Limit
from service.storage.models.answers import StarCounts
from service.storage.models.base import (
    Count,
    DescribedAs,
    Digest,
    Id,
    Moment,
    Reason,
    Record,
    Stamp,
    Status,
    doc,
)
from service.storage.models.runs import ReplayProgress
from service.storage.models.spacecraft import GyroBlockRow


class LatestBatch(Record, frozen=True, kw_only=True):
    """The latest of the batches of an event."""

    id: Id
    batch: str
    time: Moment
    status: Status | None
    reason: Reason | None
    counts: StarCounts


class BatchesEvent(Record, frozen=True, kw_only=True):
    """Batches that were recorded."""

    spacecraft: str
    run: str
    batches: Annotated[Count, doc("How many.")]
    latest: LatestBatch


class AdoptedEvent(Record, frozen=True, kw_only=True):
    """A what-if that was adopted."""

    spacecraft: str
    run: str
    id: Annotated[Id, doc("Of the result that stands for the batch now.")]
    batch_id: Annotated[Id, doc("Of the batch: the id of its first result.")]


class TrackingEvent(Record, frozen=True, kw_only=True):
    """A change of the tracking state of a spacecraft."""

    spacecraft: str
    run: str
    id: Id
    batch: str
    time: Moment
    state: Annotated[Annotated[str, DescribedAs(TrackingState)] | None, doc("null: not tracked.")]
    before: Annotated[str, DescribedAs(TrackingState)] | None


class CalibrationEvent(Record, frozen=True, kw_only=True):
    """A change of the calibration in force."""

    id: Id
    spacecraft: str
    adopted: Stamp
    who: str
    note: str
    calibration: Annotated[Id | None, doc("null: back to the mission file.")]
    version: Count | None
    mission: Annotated[Digest, doc("The settings in force since then.")]


EVENT_DATA: Mapping[str, type[Record]] = {
    "batches": BatchesEvent,
    "adopted": AdoptedEvent,
    "alarm": Alarm,
    "limit": Limit,
    "annotation": AnnotationChange,
    "replay": ReplayProgress,
    "gyro": GyroBlockRow,
    "tracking": TrackingEvent,
    "calibration": CalibrationEvent,
}
