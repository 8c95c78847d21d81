"""Records of events' data, as sent by the event stream and webhooks."""

from collections.abc import Mapping
from typing import Annotated, ClassVar

from pydantic import Field

from service.acquire.result import TrackingState
from service.contract.alarms import Alarm, AnnotationChange, Limit
from service.contract.answers import StarCounts
from service.contract.base import (
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
from service.contract.runs import ReplayProgress
from service.contract.spacecraft import GyroBlockRow


class LatestBatch(Record, frozen=True, kw_only=True):
    """The latest batch among those of an event."""

    id: Id
    batch: str
    time: Moment
    status: Status | None
    reason: Reason | None
    counts: StarCounts


class Recorded(Record, frozen=True, kw_only=True):
    """Data of an event about newly recorded batches."""

    component: ClassVar[str] = "BatchesEvent"
    spacecraft: str
    run: str
    batches: Annotated[Count, doc("How many.")]
    latest: LatestBatch


class Adopted(Record, frozen=True, kw_only=True):
    """Data of an event about an adopted what-if."""

    component: ClassVar[str] = "AdoptedEvent"
    spacecraft: str
    run: str
    id: Annotated[Id, doc("The result that stands for the batch now.")]
    batch_id: Annotated[Id, doc("The batch, by the id of its first result.")]


class TrackingChange(Record, frozen=True, kw_only=True):
    """Data of an event about a change of a spacecraft's tracking state."""

    component: ClassVar[str] = "TrackingEvent"
    spacecraft: str
    run: str
    id: Id
    batch: str
    time: Moment
    state: Annotated[Annotated[str, DescribedAs(TrackingState)] | None, doc("null: not tracked.")]
    before: Annotated[str, DescribedAs(TrackingState)] | None


class CalibrationChange(Record, frozen=True, kw_only=True):
    """Data of an event about a change of the calibration in force."""

    component: ClassVar[str] = "CalibrationEvent"
    id: Id
    spacecraft: str
    adopted: Stamp
    who: str
    note: str
    calibration: Annotated[Id | None, doc("null: back to the mission file.")]
    version: Count | None
    mission: Annotated[Digest, doc("The settings in force since then.")]


class RecordHead(Record, frozen=True, kw_only=True):
    """Head of the record's chain, to be stored where nobody who can change the record can write."""

    number: Annotated[int, Field(ge=1)]
    sha256: Annotated[
        str, Field(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of the statement.")
    ]
    made: Stamp
    statement: Annotated[str, doc("JSON, byte for byte as it is hashed and signed.")]
    signature: Annotated[
        str | None,
        doc("Ed25519, in hexadecimal digits; null: the service has no key."),
    ]

    @property
    def text(self) -> str:
        """The head's number, SHA-256 and time, as `acquire database verify --head` reads them."""
        return f"{self.number} {self.sha256} {self.made}"


EVENT_DATA: Mapping[str, type[Record]] = {
    "batches": Recorded,
    "adopted": Adopted,
    "alarm": Alarm,
    "limit": Limit,
    "annotation": AnnotationChange,
    "replay": ReplayProgress,
    "gyro": GyroBlockRow,
    "tracking": TrackingChange,
    "calibration": CalibrationChange,
    "head": RecordHead,
}
