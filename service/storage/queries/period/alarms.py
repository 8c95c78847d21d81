"""When alarms of a spacecraft were out of their limits within a period."""

from collections.abc import Sequence

from sqlalchemy import Connection, or_, select

from service.storage.models.alarms import Alarm, AlarmSpan
from service.storage.queries.alarms import shown_alarm
from service.storage.sql.alarm_tables import alarm_actions, alarms
from service.times import Utc, recorded_utc, utc_now

MOST = 200
"""Alarms of a period that are read, the newest: more could not be told apart on a chart."""
_LEFT, _RETURNED = ("raised", "left_again"), "returned"
TimeOut = tuple[str, str | None]
"""From when to when; None: it still is."""


def alarm_spans(
    connection: Connection, run: str, spacecraft: str, start: Utc, end: Utc
) -> list[AlarmSpan]:
    """The spans of telemetry time in which alarms were out of their limits, oldest first.

    Those that touch the period from `start` to before `end`, of the newest alarms.
    """
    # Texts are in the order of time but for the length of their fractions.
    chosen = (
        select(alarms)
        .where(
            alarms.c.run == run,
            alarms.c.spacecraft == spacecraft,
            alarms.c.raised_time <= end.text,
            or_(alarms.c.current_severity.is_not(None), alarms.c.latest_time >= start.text[:19]),
        )
        .order_by(alarms.c.id.desc())
        .limit(MOST)
    )
    found = [shown_alarm(row, utc_now().text) for row in connection.execute(chosen).mappings()]
    spans = [
        AlarmSpan(
            id=alarm.id,
            quantity=alarm.quantity,
            tracker=alarm.tracker,
            severity=alarm.severity,
            start=begin,
            end=until,
        )
        for alarm, times in zip(found, times_out(connection, found), strict=True)
        for begin, until in times
    ]
    return sorted((each for each in spans if _touches(each, start, end)), key=lambda s: s.start)


def times_out(connection: Connection, found: Sequence[Alarm]) -> list[list[TimeOut]]:
    """For each alarm, from when to when it was out of its limits, in telemetry time."""
    actions: dict[str, list[tuple[str, str | None]]] = {alarm.id: [] for alarm in found}
    noted = (
        select(alarm_actions.c.alarm_id, alarm_actions.c.action, alarm_actions.c.time)
        .where(
            alarm_actions.c.alarm_id.in_(list(actions)),
            alarm_actions.c.action.in_((*_LEFT, _RETURNED)),
        )
        .order_by(alarm_actions.c.id)
    )
    for id, action, time in connection.execute(noted):
        actions[id].append((action, time))
    return [_times_out(alarm, actions[alarm.id]) for alarm in found]


def _times_out(alarm: Alarm, actions: Sequence[tuple[str, str | None]]) -> list[TimeOut]:
    spans: list[TimeOut] = [(alarm.raised.time, None)]
    for action, time in actions:
        begin, until = spans[-1]
        if action == _RETURNED:
            spans[-1] = begin, until or time
        elif action == "left_again" and time is not None:
            spans.append((time, None))
    if alarm.in_limits and spans[-1][1] is None:
        spans[-1] = spans[-1][0], alarm.latest.time
    return spans


def _touches(span: AlarmSpan, start: Utc, end: Utc) -> bool:
    is_over = span.end is not None and recorded_utc(span.end).tai_ns < start.tai_ns
    return not is_over and recorded_utc(span.start).tai_ns < end.tai_ns
