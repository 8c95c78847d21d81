"""Console pages for alarms: list, single alarm with history, limits, also on charts of trends."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Literal

from msgspec import structs
from starlette.responses import Response

from service.contract.alarms import Alarm, Limit, SeverityName
from service.errors import NotFound, shown_value
from service.features.alarms.part import Alarms
from service.features.alarms.records import AlarmWithActions
from service.features.alarms.state import TimeOut
from service.observations.schema import Key
from service.storage.queries.fleet import present_rank
from service.times import DAY_S, Utc, recorded_utc, shifted
from service.trends.limits import LimitSettings, Severity
from service.trends.quantities import (
    REJECTED,
    SILENCE,
    limited_trackers,
    quantity_named,
    trend_names,
)
from service.web.console.formatting import age, second_after, with_day_of_year
from service.web.console.page import (
    ContextDep,
    FromQuery,
    PageContext,
    PageQuery,
    Panel,
    SortedQuery,
    console_page,
)
from service.web.console.pages.spacecraft_page import (
    DrawnLimits,
    ShownPeriod,
    charts_by_quantity,
    history_address,
)
from service.web.requests.access import Policy
from service.web.requests.query_parameters import Cursor, Query

ROWS = 200
SEVERITIES = [each.word for each in Severity]
State = Literal["active", "open", "returned", "acknowledged", "shelved", "cleared", "all"]
STATES: dict[State, str] = {
    "active": "not cleared",
    "open": "open and out of limits",
    "returned": "back in limits",
    "acknowledged": "acknowledged",
    "shelved": "shelved",
    "cleared": "cleared",
    "all": "all, with history",
}
Order = Literal["last", "severity", "spacecraft", "quantity", "times", "duration", "raised"]
Grouping = Literal["", "time", "quantity", "spacecraft"]
NAMES = ("spacecraft", "quantity")
"""Sort orders that start at A; all others start with the latest or the greatest."""
GROUPINGS: dict[Grouping, str] = {
    "": "not grouped",
    "time": "left limits together",
    "quantity": "one quantity, one usual cause",
    "spacecraft": "one spacecraft",
}
MARGIN_S = 1800.0
"""Seconds before and after the times out of limits, in the period of links from an alarm's page."""
TREND_BEFORE_S = 4 * 3600.0
TOGETHER_S = 1800.0
"""Seconds within which alarms that leave their limits are assumed to share a cause."""
FLEET_TOGETHER_S = 600.0
"""The same for alarms of several spacecraft."""


class AlarmsQuery(SortedQuery):
    """Query of the alarm list: filters, sort order, grouping; an empty form field matches all."""

    state: State = "active"
    spacecraft: Key | Literal[""] = ""
    severity: SeverityName | Literal[""] = ""
    sort: Order = "severity"
    group: Grouping = ""
    cursor: Cursor = None


@dataclass(frozen=True)
class AlarmLine:
    """An alarm with the intervals of telemetry time in which its quantity was out of limits."""

    alarm: Alarm
    times: list[TimeOut]
    bound: float
    """Bound of the severity now; of the worst one if the value is back in limits."""

    @property
    def last(self) -> TimeOut:
        """Latest interval out of limits; without an end if still out of limits."""
        return self.times[-1]

    @property
    def last_ns(self) -> int:
        """Start of the latest interval out of limits, in TAI nanoseconds."""
        return recorded_utc(self.last[0]).tai_ns

    @property
    def duration_s(self) -> float:
        """Total seconds out of limits; an unfinished interval ends at the latest value."""
        ends = [recorded_utc(end or self.alarm.latest.time).tai_ns for _, end in self.times]
        starts = [recorded_utc(start).tai_ns for start, _ in self.times]
        return max(0, sum(ends) - sum(starts)) * 1e-9


@dataclass(frozen=True)
class AlarmGroup:
    """Alarms with the same time, quantity or spacecraft; all of them if no grouping is chosen."""

    title: str
    lines: list[AlarmLine]


@console_page("/alarms", "Alarms", Policy("read", "nothing"), position=20)
def alarms_page(query: FromQuery[AlarmsQuery], context: ContextDep) -> Response:
    """Console page with the alarms of a run, the worst now first."""
    query = query.model_copy(update={"spacecraft": context.listed(query.spacecraft)})
    found, next_cursor = _found(context, query)
    lines = _sorted(_lines(context, found), query)
    return context.rendered(
        "alarms.html.jinja",
        query.run,
        query=query,
        groups=_grouped(lines[:ROWS], query.group),
        left_out=max(0, len(lines) - ROWS),
        next_cursor=next_cursor,
        states=STATES,
        severities=SEVERITIES,
        groupings=GROUPINGS,
        spacecraft=context.spacecraft,
        is_retired=context.app.part(Alarms).is_retired,
    )


def _lines(context: PageContext, found: list[Alarm]) -> list[AlarmLine]:
    part = context.app.part(Alarms)
    return list(map(AlarmLine, found, part.times_out(found), part.present_bounds(found)))


def _found(context: PageContext, query: AlarmsQuery) -> tuple[list[Alarm], str | None]:
    """Alarms that match a query: all that are not cleared, or one page of the history."""
    next_cursor = None
    if query.state in ("cleared", "all"):
        page = context.app.part(Alarms).page(
            run=query.run,
            spacecraft=query.spacecraft or None,
            state=query.state,
            limit=ROWS,
            cursor=query.cursor,
        )
        found, next_cursor = page.items, page.next_cursor
    else:
        found = context.app.part(Alarms).active(query.run)
    return [each for each in found if _matches(each, query)], next_cursor


def _matches(alarm: Alarm, query: AlarmsQuery) -> bool:
    if query.spacecraft not in ("", alarm.spacecraft):
        return False
    if query.severity not in ("", alarm.current_severity or alarm.severity):
        return False
    match query.state:
        case "open":
            return alarm.state == "open" and not alarm.in_limits
        case "returned":
            return alarm.in_limits and alarm.state in ("open", "acknowledged")
        case "acknowledged" | "shelved":
            return alarm.state == query.state
    return True


def _sorted(lines: list[AlarmLine], query: AlarmsQuery) -> list[AlarmLine]:
    """Alarms in the requested sort order; ties begin with the latest violation."""
    keys: dict[Order, Callable[[AlarmLine], Any]] = {
        "last": lambda line: (line.last[1] is None, line.last_ns),
        "severity": lambda line: present_rank(line.alarm),
        "spacecraft": lambda line: line.alarm.spacecraft,
        "quantity": lambda line: (line.alarm.quantity, line.alarm.tracker or ""),
        "times": lambda line: len(line.times),
        "duration": lambda line: line.duration_s,
        "raised": lambda line: recorded_utc(line.alarm.raised.time).tai_ns,
    }
    ordered = sorted(lines, key=keys["last"], reverse=True)
    is_down = query.sort not in NAMES if query.descending is None else query.descending
    return sorted(ordered, key=keys[query.sort], reverse=is_down)


def _grouped(lines: list[AlarmLine], grouping: Grouping) -> list[AlarmGroup]:
    """Group sorted alarms; groups are in the order of their first alarms."""
    groups: dict[Any, list[AlarmLine]] = {}
    if grouping == "time":
        # A group has all alarms raised within `TOGETHER_S` of its first one.
        begun_ns: float = -math.inf
        for line in sorted(lines, key=lambda each: each.last_ns):
            if line.last_ns - begun_ns > TOGETHER_S * 1e9:
                begun_ns = line.last_ns
            groups.setdefault(begun_ns, []).append(line)
        places = {id(line): k for k, line in enumerate(lines)}
        for group in groups.values():
            group.sort(key=lambda line: places[id(line)])
        return [
            AlarmGroup(f"Left limits at {with_day_of_year(group[0].last[0], False)} UTC", group)
            for group in sorted(groups.values(), key=lambda group: places[id(group[0])])
        ]
    for line in lines:
        key = getattr(line.alarm, grouping) if grouping else ""
        groups.setdefault(key, []).append(line)
    return [
        AlarmGroup(quantity_named(key).label if grouping == "quantity" else key, group)
        for key, group in groups.items()
    ]


class AlarmQuery(Query):
    """Query of the page for one alarm; `run` is ignored, since an alarm has a run."""

    run: str | None = None


@console_page("/alarms/{id}", "Alarm", Policy("read", "nothing"), section="/alarms")
def alarm_page(id: str, query: FromQuery[AlarmQuery], context: ContextDep) -> Response:
    """Console page for one alarm: its raise, its usual cause, and the actions of operators."""
    alarm = context.app.part(Alarms).get(id)
    if not context.caller.may_see(alarm.spacecraft):
        # Same answer as for an unknown id: probing must not reveal alarms of other spacecraft.
        raise NotFound(f"there is no alarm with the id {shown_value(id)}")
    is_retired = context.app.part(Alarms).is_retired(alarm.spacecraft, alarm.tracker)
    (line,) = _lines(context, [alarm])
    start = shifted(recorded_utc(alarm.raised.time), -MARGIN_S)
    end = shifted(recorded_utc(line.last[1] or alarm.latest.time), MARGIN_S)
    trend = _trend(context, alarm)
    return context.rendered(
        "alarm.html.jinja",
        alarm.run,
        alarm=alarm,
        line=line,
        is_retired=is_retired,
        found=_found_causes(context, alarm, start, end),
        cause=quantity_named(alarm.quantity).cause,
        related=_related(context, alarm),
        trend=trend,
        means=_means(context, alarm, trend),
        period={"start": start.text, "end": end.text},
        before="day" if end.tai_ns - start.tai_ns <= DAY_S * 1e9 else "week",
        of_tracker={"tracker": alarm.tracker} if _has_tracker(context, alarm) else {},
    )


def _found_causes(context: PageContext, alarm: Alarm, start: Utc, end: Utc) -> list[Panel]:
    """Panels of other features on the cause of an alarm about stars and their attitudes."""
    if alarm.quantity in (SILENCE, REJECTED) or alarm.spacecraft not in context.app.context.known:
        return []
    return context.panels("alarm_page", alarm.spacecraft, alarm.run, start, end)


def _has_tracker(context: PageContext, alarm: Alarm) -> bool:
    """True if the alarm is about a tracker that has, or had, values of its own."""
    known = alarm.spacecraft in context.app.context.known
    return known and alarm.tracker in context.app.context.trackers(alarm.spacecraft)


def _end(alarm: Alarm) -> Utc:
    """End of the period shown for an alarm: after its raise and its latest batch."""
    after = shifted(recorded_utc(alarm.raised.time), MARGIN_S)
    # The end of the period is excluded, so it lies after the latest batch.
    latest = second_after(alarm.latest.time)
    return max(after, latest, key=lambda moment: moment.tai_ns)


def _related(context: PageContext, alarm: AlarmWithActions) -> list[tuple[Alarm, str]]:
    """Active alarms that may share a cause with another alarm, each with the reason.

    The same quantity of other spacecraft, and other quantities of this one, if they left their
    limits at about the same time; and others of the same tracker or
    quantity.
    """
    raised_ns = recorded_utc(alarm.raised.time).tai_ns

    def reason(other: Alarm) -> str:
        is_same = other.spacecraft == alarm.spacecraft
        apart_s = abs(recorded_utc(other.raised.time).tai_ns - raised_ns) * 1e-9
        is_together = apart_s <= (TOGETHER_S if is_same else FLEET_TOGETHER_S)
        if is_together and (is_same or other.quantity == alarm.quantity):
            what = "same spacecraft" if is_same else "same quantity"
            return f"{what}, raised {age(apart_s)} apart" if apart_s else f"{what}, same time"
        if is_same and other.quantity == alarm.quantity:
            return "same quantity"
        is_tracker = is_same and other.tracker == alarm.tracker is not None
        return "same tracker" if is_tracker else ""

    others = [
        (other, reason(other))
        for other in context.app.part(Alarms).active(alarm.run)
        if other.id != alarm.id and context.caller.may_see(other.spacecraft)
    ]
    return [each for each in others if each[1]]


@dataclass(frozen=True)
class AlarmMeans:
    """Number of batches whose mean each value of an alarm is; one if the limit was changed since.

    `worst` has the batch that contributed most to the raised, worst and latest value, if known.
    """

    count: int
    worst: dict[str, str]


def _means(context: PageContext, alarm: Alarm, trend: "AlarmTrend | None") -> AlarmMeans:
    part = context.app.part(Alarms)
    for limit in trend.limits if trend else ():
        settings = LimitSettings.model_validate(limit.settings)
        worst = part.largest_contributions(alarm, settings)
        # A tracker's limit may be that of its spacecraft.
        whole = part.limits.get(alarm.spacecraft, alarm.quantity).limit
        if worst or max(limit.since or "", whole.since or "") <= alarm.raised.at:
            return AlarmMeans(settings.minimum_count, worst)
    return AlarmMeans(1, {})


@dataclass(frozen=True)
class AlarmTrend:
    """Chart of an alarm's quantity, from before its raise until its latest value."""

    start: Utc
    end: Utc
    history: str
    chart: dict[str, Any]
    limits: list[Limit]


def _trend(context: PageContext, alarm: AlarmWithActions) -> AlarmTrend | None:
    """Chart of an alarm's quantity about its raise; None without a history of the quantity."""
    if alarm.quantity not in trend_names() or alarm.spacecraft not in context.app.context.known:
        return None
    if alarm.tracker is not None and not _has_tracker(context, alarm):
        return None
    tracker = alarm.tracker
    start, end = shifted(recorded_utc(alarm.raised.time), -TREND_BEFORE_S), _end(alarm)
    limited = limited_trackers(context.app.context.known[alarm.spacecraft])
    limits = context.app.part(Alarms).limits.all(
        alarm.spacecraft, tracker if tracker in limited else None
    )
    return AlarmTrend(
        start,
        end,
        history_address(alarm.spacecraft, alarm.run, tracker, start, end, quantity=alarm.quantity),
        charts_by_quantity()[alarm.quantity],
        [each for each in limits if each.quantity == alarm.quantity],
    )


PREVIEW_DAYS = (1, 7, 30)


class LimitsQuery(PageQuery):
    """Query of the limits page: limits of the whole spacecraft, or of one tracker."""

    tracker: Key | None = None


@console_page("/spacecraft/{name}/limits", "Limits", Policy("read", "path"), section="/alarms")
def limits_page(name: str, query: FromQuery[LimitsQuery], context: ContextDep) -> Response:
    """Console page to see, preview and change the limits of every quantity, with their history."""
    app, tracker = context.app, query.tracker
    limits = app.part(Alarms).limits.all(name, tracker)
    return context.rendered(
        "limits.html.jinja",
        query.run,
        name=name,
        tracker=tracker,
        trackers=limited_trackers(app.context.known[name]),
        limits=[app.part(Alarms).limits.get(name, each.quantity, tracker) for each in limits],
        severities=SEVERITIES,
        days=PREVIEW_DAYS,
        charts=charts_by_quantity(),
        may_write=context.may_operate,
    )


def limits_of_charts(
    context: PageContext, name: str, run: str, tracker: str | None, shown: ShownPeriod | None
) -> Iterator[DrawnLimits]:
    """Limits of a spacecraft or tracker, and intervals in which alarms were out of limits.

    For a tracker, its own alarms and alarms of all trackers are included.
    """
    alarms, limited = context.app.part(Alarms), limited_trackers(context.app.context.known[name])
    limits = alarms.limits.all(name, tracker if tracker in limited else None)
    out = []
    if shown is not None:
        out = [
            structs.asdict(each)
            for each in alarms.of_period(name, run, shown.start, shown.end)
            if tracker is None or each.tracker in (None, tracker)
        ]
    yield DrawnLimits(limits, out)


PANELS = {"spacecraft_page": limits_of_charts}
