"""Records of alarms, limits, and annotations, which are notes of people."""

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
    """Limit of one quantity of a spacecraft or a tracker."""

    component: ClassVar[str] = "LimitOut"
    spacecraft: str
    quantity: QuantityName
    tracker: Annotated[str | None, doc("null: of the spacecraft as a whole.")] = None
    unit: str
    is_default: bool
    """True if the limit is the shipped one; for a tracker, if it is that of its spacecraft."""
    since: Annotated[Stamp | None, doc("null: it was never changed.")]
    who: str | None
    comment: str | None
    settings: Annotated[dict[str, Any], DescribedAs(LimitSettings)]


class AlarmValue(Record, frozen=True, kw_only=True):
    """Value of a quantity that a limit was evaluated for, with its time and batch."""

    component: ClassVar[str] = "PointOut"
    value: float
    time: Annotated[Moment, doc("Time of the batch; for silence, of the batch before it.")]
    batch_id: Id | None


class AlarmRaised(AlarmValue, frozen=True, kw_only=True):
    """Value of a quantity that raised an alarm."""

    component: ClassVar[str] = "RaisedOut"
    at: Stamp
    bound: Annotated[float, doc("The bound of the worst severity so far.")]


class Acted(Record, frozen=True, kw_only=True):
    """Author and time of an action on an alarm."""

    component: ClassVar[str] = "ActedOut"
    at: Stamp
    who: str


class Shelved(Acted, frozen=True, kw_only=True):
    """Author, time and end of the shelving of an alarm."""

    component: ClassVar[str] = "ShelfOut"
    until: Stamp


class Alarm(Record, frozen=True, kw_only=True):
    """Alarm, kept until it is acknowledged and its quantity is back in limits."""

    component: ClassVar[str] = "AlarmOut"
    id: Id
    spacecraft: str
    run: str
    quantity: QuantityName
    tracker: str | None = None
    """Tracker that the alarm is about; null: the spacecraft as a whole."""
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
    """Number of active alarms by state."""

    open: int
    acknowledged: int
    shelved: int
    worst: Annotated[
        SeverityName | None,
        doc("Worst present severity of the alarms that are not shelved; null: none is out."),
    ]


class Annotation(Record, frozen=True, kw_only=True):
    """Annotation: a note about a time or a period, signed by its author."""

    id: Id
    spacecraft: Annotated[str | None, doc("null: it is about every spacecraft.")]
    start: Annotated[Moment, doc("Telemetry time.")]
    end: Annotated[Moment | None, doc("null: the note is about a moment.")]
    text: str
    who: str
    created: Stamp


AnnotationPage = page_record("AnnotationPage", Annotation, "A page of annotations.")


class AnnotationChange(Annotation, frozen=True, kw_only=True):
    """Data of an event about an annotation that was written or deleted."""

    component: ClassVar[str] = "AnnotationEvent"
    deleted: bool
