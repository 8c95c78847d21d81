"""Alarms and limits as the overview and events have them, and annotations: notes of people."""

from typing import Annotated, Any, ClassVar, Literal

from service.contract.base import (
    DescribedAs,
    Id,
    Moment,
    Record,
    Stamp,
    doc,
    page_record,
)
from service.trends.limits import LimitSettings
from service.trends.quantities import QuantityName

SeverityName = Literal["watch", "warning", "critical"]
AlarmState = Literal["open", "acknowledged", "shelved", "cleared"]
AlarmActionName = Literal[
    "raised",
    "escalated",
    "eased",
    "returned",
    "left_again",
    "acknowledged",
    "shelved",
    "unshelved",
    "shelf_expired",
    "commented",
    "cleared",
]


class Limit(Record, frozen=True, kw_only=True):
    """The limit of one quantity of a spacecraft."""

    component: ClassVar[str] = "LimitOut"
    spacecraft: str
    quantity: QuantityName
    tracker: Annotated[str | None, doc("null: of the spacecraft as a whole.")] = None
    unit: str
    is_default: bool
    """True if this is the shipped limit; for a tracker, if it is the limit of its spacecraft."""
    since: Annotated[Stamp | None, doc("null: it was never changed.")]
    who: str | None
    comment: str | None
    settings: Annotated[dict[str, Any], DescribedAs(LimitSettings)]


class AlarmValue(Record, frozen=True, kw_only=True):
    """An evaluated value with its time and its batch."""

    component: ClassVar[str] = "PointOut"
    value: float
    time: Annotated[Moment, doc("Time of the batch; for silence, of the batch before it.")]
    batch_id: Id | None


class AlarmRaised(AlarmValue, frozen=True, kw_only=True):
    """The value that raised an alarm."""

    component: ClassVar[str] = "RaisedOut"
    at: Stamp
    bound: Annotated[float, doc("The bound of the worst severity so far.")]


class Acted(Record, frozen=True, kw_only=True):
    """The author and the time of an action."""

    component: ClassVar[str] = "ActedOut"
    at: Stamp
    who: str


class Shelved(Acted, frozen=True, kw_only=True):
    """Shelved until a time."""

    component: ClassVar[str] = "ShelfOut"
    until: Stamp


class Alarm(Record, frozen=True, kw_only=True):
    """An alarm. It stays until it is acknowledged and its quantity is back in limits."""

    component: ClassVar[str] = "AlarmOut"
    id: Id
    spacecraft: str
    run: str
    quantity: QuantityName
    tracker: str | None = None
    """The tracker that it is about; null: the spacecraft as a whole."""
    unit: str
    state: AlarmState
    severity: Annotated[SeverityName, doc("The worst severity so far.")]
    current_severity: Annotated[SeverityName | None, doc("null: the value is back in limits.")]
    in_limits: bool
    raised: AlarmRaised
    worst: AlarmValue
    latest: AlarmValue
    returned_at: Stamp | None
    acknowledged: Acted | None
    shelved: Shelved | None
    cleared_at: Stamp | None


class AlarmSummary(Record, frozen=True, kw_only=True):
    """How many alarms are active, by state."""

    open: int
    acknowledged: int
    shelved: int
    worst: Annotated[
        SeverityName | None,
        doc("Worst present severity of the alarms that are not shelved; null: none is out."),
    ]


class Annotation(Record, frozen=True, kw_only=True):
    """A note on a time or a period, signed by its author."""

    id: Id
    spacecraft: Annotated[str | None, doc("null: it is about every spacecraft.")]
    start: Annotated[Moment, doc("Telemetry time.")]
    end: Annotated[Moment | None, doc("null: the note is about a moment.")]
    text: str
    who: str
    created: Stamp


AnnotationPage = page_record("AnnotationPage", Annotation, "A page of annotations.")


class AnnotationChange(Annotation, frozen=True, kw_only=True):
    """The data of an event: an annotation that was written or deleted."""

    component: ClassVar[str] = "AnnotationEvent"
    deleted: bool
