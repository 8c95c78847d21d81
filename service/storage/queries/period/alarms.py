"""When alarms of a spacecraft were out of their limits within a period."""

from collections.abc import Sequence

from sqlalchemy import Connection, or_, select

from service.storage.models.alarms import AlarmSpan
from service.storage.sql.alarm_tables import alarm_actions, alarms
from service.storage.sql.columns import Row
from service.times import Utc, recorded_utc

MOST = 200
"""Alarms of a period that are read, the newest: more could not be told apart on a chart."""
_LEFT, _RETURNED = ("raised", "left_again"), "returned"


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
    found = [dict(row) for row in connection.execute(chosen).mappings()]
    actions: dict[str, list[Row]] = {row["id"]: [] for row in found}
    noted = (
        select(alarm_actions.c.alarm_id, alarm_actions.c.action, alarm_actions.c.time)
        .where(
            alarm_actions.c.alarm_id.in_(list(actions)),
            alarm_actions.c.action.in_((*_LEFT, _RETURNED)),
        )
        .order_by(alarm_actions.c.id)
    )
    for row in connection.execute(noted).mappings():
        actions[row["alarm_id"]].append(dict(row))
    spans = [
        AlarmSpan(
            id=alarm["id"],
            quantity=alarm["quantity"],
            tracker=alarm["tracker"] or None,
            severity=alarm["severity"],
            start=begin,
            end=until,
        )
        for alarm in found
        for begin, until in _out_of_limits(alarm, actions[alarm["id"]])
    ]
    return sorted((each for each in spans if _touches(each, start, end)), key=lambda s: s.start)


def _out_of_limits(alarm: Row, actions: Sequence[Row]) -> list[tuple[str, str | None]]:
    """From when to when it was out of its limits; None: it still is."""
    spans: list[tuple[str, str | None]] = [(alarm["raised_time"], None)]
    for each in actions:
        begin, until = spans[-1]
        if each["action"] == _RETURNED:
            spans[-1] = begin, until or each["time"]
        elif each["action"] == "left_again":
            spans.append((each["time"], None))
    if alarm["current_severity"] is None and spans[-1][1] is None:
        spans[-1] = spans[-1][0], alarm["latest_time"]
    return spans


def _touches(span: AlarmSpan, start: Utc, end: Utc) -> bool:
    is_over = span.end is not None and recorded_utc(span.end).tai_ns < start.tai_ns
    return not is_over and recorded_utc(span.start).tai_ns < end.tai_ns
