"""API records of limits, with their history and preview, and of alarms with their actions."""

from typing import Annotated, Any, ClassVar

from msgspec import Struct

from service.contract.alarms import Alarm, AlarmActionName, Limit, SeverityName
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

LimitList = list_record("LimitList", Limit, "The limits of a spacecraft.")


class LimitHistory(Record, frozen=True, kw_only=True):
    """The limit of a quantity in force, its shipped default, and the history of changes."""

    limit: Limit
    default: Annotated[dict[str, Any], DescribedAs(LimitSettings)]
    history: Annotated[list[Limit], doc("Newest first.")]


class LimitExcursion(Record, frozen=True, kw_only=True):
    """A period in which an alarm would have been out of limits."""

    severity: Annotated[SeverityName, doc("The worst.")]
    start: Annotated[Moment, doc("Time of the batch that would have raised the alarm.")]
    end: Annotated[Moment | None, doc("First batch back in limits; null: out to the end.")]
    worst: Annotated[float, doc("Value furthest beyond the bound.")]
    bound: float


class LimitTrial(Record, frozen=True, kw_only=True):
    """Evaluation of recorded batches against a limit."""

    settings: Annotated[dict[str, Any], DescribedAs(LimitSettings)]
    evaluated: int
    """Number of evaluated values; each is the mean over the latest `minimum_count` batches."""
    beyond: dict[SeverityName, int]
    """Number of values beyond the bounds of each severity, without hysteresis and duration."""
    alarms: Annotated[int, doc("How often the quantity would have left its limits.")]
    excursions: Annotated[list[LimitExcursion], doc("The latest of these, oldest first.")]


class LimitPreview(Record, frozen=True, kw_only=True):
    """Comparison of a proposed limit with the one in force, over the same recorded batches."""

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


AlarmPage = page_record("AlarmPage", Alarm, "A page of alarms.")


class AlarmAction(Record, frozen=True, kw_only=True):
    """An entry in the history of an alarm, caused by a new value or by a user."""

    component: ClassVar[str] = "ActionOut"
    at: Stamp
    action: AlarmActionName
    who: str | None
    comment: str | None
    severity: SeverityName | None
    value: float | None
    time: Moment | None


class AlarmWithActions(Alarm, frozen=True, kw_only=True):
    """An alarm with the history of its actions."""

    component: ClassVar[str] = "AlarmRecord"
    actions: Annotated[list[AlarmAction], doc("Oldest first.")]


class AlarmSpan(Struct, frozen=True, kw_only=True):
    """An interval of telemetry time in which an alarm was out of limits, for a chart."""

    id: Id
    quantity: QuantityName
    tracker: str | None
    severity: SeverityName
    start: Moment
    end: Annotated[Moment | None, doc("null: it still is.")]
