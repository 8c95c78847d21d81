"""The pages of alarms: the list of a run by state, and one with its cause and its history."""

from typing import Annotated, Literal

from fastapi import Path
from fastapi import Query as InQuery
from msgspec import UNSET
from starlette.responses import Response

from service.alarms.causes import CAUSES
from service.alarms.quantities import trend_names
from service.errors import NotFound, shown_value
from service.observations.schema import Key
from service.storage.models.alarms import Alarm, AlarmWithActions
from service.times import Utc, recorded_utc, shifted, unix_seconds
from service.web.console.charts.alarm_trend import AlarmTrend, alarm_trend
from service.web.console.page_context import ContextDep, PageContext, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy
from service.web.requests.query_parameters import Cursor, Query

ROWS = 200
STATES = ("active", "open", "acknowledged", "shelved", "cleared", "all")
BEFORE_S, AFTER_S = 1800.0, 1800.0
"""Around the time at which an alarm was raised: what its links and its trend show."""
TREND_BEFORE_S, TREND_POINTS = 4 * 3600.0, 160
TOGETHER_S = 1800.0
"""Alarms of one spacecraft that were raised within this time are likely to have one cause."""

Clock = Literal["telemetry", "receipt"]
CLOCKS: dict[Clock, str] = {
    "telemetry": "telemetry time, that of the batches",
    "receipt": "receipt time, by the clock of the service",
}


class AlarmsQuery(PageQuery):
    """Which alarms, by which clock; an empty spacecraft stands for every one."""

    state: Literal["active", "open", "acknowledged", "shelved", "cleared", "all"] = "active"
    spacecraft: Key | Literal[""] = ""
    cursor: Cursor = None
    clock: Clock = "telemetry"


class AlarmQuery(Query):
    """By which clock the history of an alarm is shown."""

    run: str | None = None
    clock: Clock = "telemetry"


@console_page("/alarms", "Alarms", Policy("read", "nothing"), position=20)
def alarms_page(query: Annotated[AlarmsQuery, InQuery()], context: ContextDep) -> Response:
    """The alarms of a run, newest first."""
    if query.spacecraft:
        context.caller.require(query.spacecraft)
    elif context.caller.spacecraft is not None:
        query = query.model_copy(update={"spacecraft": context.first_spacecraft})
    page = context.app.alarms.page(
        run=query.run,
        spacecraft=query.spacecraft or None,
        state=query.state,
        limit=ROWS,
        cursor=query.cursor,
    )
    return rendered(
        "alarms.html.jinja",
        context.layout(query.run),
        query=query,
        page=page,
        states=STATES,
        clocks=CLOCKS,
        spacecraft=context.spacecraft,
        is_retired=context.app.alarms.is_retired,
    )


@console_page("/alarms/{id}", "Alarm", Policy("read", "nothing"), section="/alarms")
def alarm_page(
    id: Annotated[str, Path()], query: Annotated[AlarmQuery, InQuery()], context: ContextDep
) -> Response:
    """One alarm: how it was raised, its usual cause, and what operators did about it."""
    alarm = context.app.alarms.get(id)
    if not context.caller.may_see(alarm.spacecraft):
        # As if it did not exist: probing for ids of others must tell nothing.
        raise NotFound(f"there is no alarm with the id {shown_value(id)}")
    raised = recorded_utc(alarm.raised.time)
    around = {"start": shifted(raised, -BEFORE_S).text, "end": shifted(raised, AFTER_S).text}
    of_tracker = {"tracker": alarm.tracker} if _has_tracker(context, alarm) else {}
    is_retired = context.app.alarms.is_retired(alarm.spacecraft, alarm.tracker)
    return rendered(
        "alarm.html.jinja",
        context.layout(alarm.run),
        alarm=alarm,
        clock=query.clock,
        clocks=CLOCKS,
        is_retired=is_retired,
        cause=CAUSES.get(alarm.quantity),
        related=_related(context, alarm),
        trend=_trend(context, alarm),
        around=around,
        trends_around=around | of_tracker,
        since={"start": around["start"], "end": _end(alarm).text, **of_tracker},
    )


def _has_tracker(context: PageContext, alarm: Alarm) -> bool:
    """Whether the alarm is about a tracker that has a history of its own."""
    known = alarm.spacecraft in context.app.context.known
    return known and alarm.tracker in context.app.context.trackers(alarm.spacecraft)


def _end(alarm: Alarm) -> Utc:
    """Some time after the alarm was raised, or its latest batch, whichever is later."""
    after = shifted(recorded_utc(alarm.raised.time), AFTER_S)
    # The latest batch belongs to the period, the end of which does not.
    latest = shifted(recorded_utc(alarm.latest.time), 0.001)
    return max(after, latest, key=lambda moment: moment.tai_ns)


def _related(context: PageContext, alarm: AlarmWithActions) -> list[Alarm]:
    """Active alarms that may have the same cause.

    The same quantity of other spacecraft, and other quantities of this one that
    left their limits at about the same time.
    """
    raised_ns = recorded_utc(alarm.raised.time).tai_ns

    def is_related(other: Alarm) -> bool:
        if other.id == alarm.id or not context.caller.may_see(other.spacecraft):
            return False
        if other.spacecraft != alarm.spacecraft:
            return other.quantity == alarm.quantity
        apart_ns = abs(recorded_utc(other.raised.time).tai_ns - raised_ns)
        return apart_ns <= TOGETHER_S * 1e9

    return [other for other in context.app.alarms.active(alarm.run) if is_related(other)]


def _trend(context: PageContext, alarm: AlarmWithActions) -> AlarmTrend | None:
    """The quantity before and since the raise; None without a history."""
    if alarm.quantity not in trend_names() or alarm.spacecraft not in context.app.context.known:
        return None
    if alarm.tracker is not None and not _has_tracker(context, alarm):
        return None
    raised = recorded_utc(alarm.raised.time)
    start = shifted(raised, -TREND_BEFORE_S)
    end = _end(alarm)
    found = context.app.spacecraft.history(
        alarm.spacecraft,
        run=alarm.run,
        start=start,
        end=end,
        size=TREND_POINTS,
        quantities=[alarm.quantity],
        tracker=alarm.tracker,
    )
    means = found.series[alarm.quantity].mean
    assert means is not UNSET
    start_s, end_s, raised_s = unix_seconds([each.tai_ns for each in (start, end, raised)]).tolist()
    return alarm_trend(
        found.unix_s,
        means,
        start_s=start_s,
        end_s=end_s,
        step_s=float(found.bucket_s or 1),
        bound=alarm.raised.bound,
        raised_s=raised_s,
    )
