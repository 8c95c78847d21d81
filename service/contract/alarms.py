"""Limits and alarms, and annotations: notes that people write on times and periods."""

from typing import Annotated, Any, ClassVar, Literal

from msgspec import Struct

from service.alarms.state_machine import AlarmActionName, AlarmState
from service.contract.base import (
    DescribedAs,
    Id,
    Moment,
    Record,
    Stamp,
    doc,
    list_record,
    page_record,
)
from service.trends.limits import LimitSettings
from service.trends.quantities import QuantityName

SeverityName = Literal["watch", "warning", "critical"]


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


LimitList = list_record("LimitList", Limit, "The limits of a spacecraft.")


class LimitHistory(Record, frozen=True, kw_only=True):
    """One limit, the shipped limit, and the history of changes."""

    limit: Limit
    default: Annotated[dict[str, Any], DescribedAs(LimitSettings)]
    history: Annotated[list[Limit], doc("Newest first.")]


class LimitExcursion(Record, frozen=True, kw_only=True):
    """A time for which an alarm would have been out of limits."""

    severity: Annotated[SeverityName, doc("The worst.")]
    start: Annotated[Moment, doc("Time of the batch that would have raised the alarm.")]
    end: Annotated[Moment | None, doc("First batch back in limits; null: out to the end.")]
    worst: Annotated[float, doc("Value furthest beyond the bound.")]
    bound: float


class LimitTrial(Record, frozen=True, kw_only=True):
    """How recorded batches are evaluated against a limit."""

    settings: Annotated[dict[str, Any], DescribedAs(LimitSettings)]
    evaluated: int
    """Batches at which there was a value: the mean over the latest minimum_count."""
    beyond: dict[SeverityName, int]
    """Values beyond the bounds of each severity, whatever hysteresis and duration are."""
    alarms: Annotated[int, doc("How often the quantity would have left its limits.")]
    excursions: Annotated[list[LimitExcursion], doc("The latest of these, oldest first.")]


class LimitPreview(Record, frozen=True, kw_only=True):
    """A limit that is not set, and the one in force, over the same recorded batches."""

    spacecraft: str
    run: str
    quantity: QuantityName
    tracker: str | None
    start: Annotated[Moment | None, doc("Time of the first batch; null: there is none.")]
    end: Annotated[Moment | None, doc("Time of the last batch.")]
    batches: int
    is_cut: Annotated[bool, doc("True if the days have more batches: these are the latest.")]
    proposed: LimitTrial
    in_force: LimitTrial


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


AlarmPage = page_record("AlarmPage", Alarm, "A page of alarms.")


class AlarmAction(Record, frozen=True, kw_only=True):
    """A change of an alarm, by its value or by a person."""

    component: ClassVar[str] = "ActionOut"
    at: Stamp
    action: AlarmActionName
    who: str | None
    comment: str | None
    severity: SeverityName | None
    value: float | None
    time: Moment | None


class AlarmWithActions(Alarm, frozen=True, kw_only=True):
    """An alarm with its history."""

    component: ClassVar[str] = "AlarmRecord"
    actions: Annotated[list[AlarmAction], doc("Oldest first.")]


class AlarmSpan(Struct, frozen=True, kw_only=True):
    """A span of telemetry time in which an alarm was out of its limits, for a chart."""

    id: Id
    quantity: QuantityName
    tracker: str | None
    severity: SeverityName
    start: Moment
    end: Annotated[Moment | None, doc("null: it still is.")]


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
