"""Stored limits and alarms: reading, listing and changing them in the database.

Limits: those in force, and every one that was set before.  Alarms: lists, one with its history,
what people do, and times out of limits.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, Literal

from sqlalchemy import ColumnElement, Connection, and_, bindparam, insert, or_, select, update

from service.contract import alarms as models
from service.contract.alarms import AlarmActionName, Limit
from service.contract.base import Page
from service.errors import BadBatch, Fault, NotFound, shown_value
from service.features.alarms import records
from service.features.alarms.state_machine import AlarmUpdate, Changes, state_of
from service.features.alarms.tables import alarm_actions, alarms, limits
from service.missions.mission import Mission
from service.storage.queries.fleet import present_rank
from service.storage.recording import events
from service.storage.recording.ids import is_ulid
from service.storage.sql.columns import Row
from service.storage.sql.statements import prepared
from service.times import Utc, recorded_utc, utc_now
from service.trends import quantities
from service.trends.limits import LimitSettings
from service.trends.quantities import QuantityName, quantity_named

LimitsInForce = Mapping[quantities.Subject, LimitSettings]

_SHIPPED: dict[tuple[str, tuple[str, ...]], Mapping[QuantityName, LimitSettings]] = {}
# This query runs with every batch of a live spacecraft.
_IN_FORCE = prepared(
    select(limits).where(
        limits.c.spacecraft == bindparam("of_spacecraft"), limits.c.until.is_(None)
    )
)


def limits_of(connection: Connection, mission: Mission) -> LimitsInForce:
    """Limits in force for a spacecraft and its trackers: shipped defaults unless set."""
    # Limits are read with every batch; a process has few missions.
    key = mission.digest, quantities.limited_names()
    shipped = _SHIPPED.get(key)
    if shipped is None:
        shipped = _SHIPPED[key] = quantities.default_limits(mission)
    own = {
        quantities.subject_of(row["quantity"], row["tracker"]): _read(row["settings"])
        for row in _in_force(connection, mission.name)
        if row["settings"] is not None
    }
    return quantities.limits_of_subjects(mission, shipped, own)


@lru_cache(maxsize=256)
def _read(settings: str) -> LimitSettings:
    # Equal texts give one object: a window compares its limits by identity.
    return LimitSettings.model_validate_json(settings)


def list_limits(connection: Connection, mission: Mission, tracker: str = "") -> list[Limit]:
    """Limits of all quantities of a spacecraft or tracker, with their time and author."""
    rows = {
        row["quantity"]: row
        for row in _in_force(connection, mission.name)
        if row["tracker"] == tracker
    }
    return [
        shown_limit(mission.name, name, settings, rows.get(name), tracker)
        for name, settings in _inherited(connection, mission, tracker).items()
    ]


def limit_history(
    connection: Connection, mission: Mission, quantity: QuantityName, tracker: str = ""
) -> records.LimitHistory:
    """Limit in force for a quantity, its shipped default, and all earlier ones, newest first."""
    shipped = _inherited(connection, mission, tracker)[quantity]
    query = select(limits).where(*_place(mission, quantity, tracker)).order_by(limits.c.id.desc())
    rows = [dict(row) for row in connection.execute(query).mappings()]
    latest = next((row for row in rows if row["until"] is None), None)
    return records.LimitHistory(
        limit=shown_limit(mission.name, quantity, shipped, latest, tracker),
        default=shipped.model_dump(mode="json"),
        history=[shown_limit(mission.name, quantity, shipped, row, tracker) for row in rows],
    )


def _place(mission: Mission, quantity: str, tracker: str) -> tuple[ColumnElement[bool], ...]:
    c = limits.c
    return c.spacecraft == mission.name, c.quantity == quantity, c.tracker == tracker


def _inherited(
    connection: Connection, mission: Mission, tracker: str
) -> Mapping[QuantityName, LimitSettings]:
    """Limits that hold unless set: shipped defaults, for a tracker those of its spacecraft."""
    shipped = quantities.default_limits(mission)
    if not tracker:
        return shipped
    whole = limits_of(connection, mission)
    return {name: whole[name] for name in shipped if name in quantities.tracker_names()}


def set_limit(
    connection: Connection,
    mission: Mission,
    quantity: QuantityName,
    settings: LimitSettings | None,
    *,
    who: str,
    comment: str | None,
    now: str,
    tracker: str = "",
) -> Limit:
    """Set a limit from now on, None for the shipped default; the old one stays in the history."""
    before = *_place(mission, quantity, tracker), limits.c.until.is_(None)
    connection.execute(update(limits).where(*before).values(until=now))
    row = {
        "spacecraft": mission.name,
        "quantity": quantity,
        "tracker": tracker,
        "settings": None if settings is None else settings.model_dump_json(),
        "who": who,
        "comment": comment,
        "since": now,
        "until": None,
    }
    connection.execute(insert(limits), row)
    inherited = _inherited(connection, mission, tracker)[quantity]
    shown = shown_limit(mission.name, quantity, inherited, row, tracker)
    events.add_event(connection, "limit", shown, spacecraft=mission.name)
    return shown


def shown_limit(
    spacecraft: str,
    quantity: QuantityName,
    shipped: LimitSettings,
    row: Any | None,
    tracker: str = "",
) -> Limit:
    """Limit as an API record; without a database row the shipped default."""
    own = None if row is None else row["settings"]
    return Limit(
        spacecraft=spacecraft,
        quantity=quantity,
        tracker=tracker or None,
        unit=quantities.QUANTITIES[quantity].unit,
        is_default=own is None,
        since=row and row["since"],
        who=row and row["who"],
        comment=row and row["comment"],
        settings=shipped.model_dump(mode="json") if own is None else json.loads(own),
    )


def _in_force(connection: Connection, spacecraft: str) -> list[Row]:
    return _IN_FORCE.read(connection, {"of_spacecraft": spacecraft})


StateFilter = Literal["open", "acknowledged", "shelved", "active", "cleared", "all"]

_ACTIVE = alarms.c.cleared_at.is_(None)


def list_alarms(
    connection: Connection,
    *,
    run: str | None,
    spacecraft: str | None,
    state: StateFilter,
    limit: int,
    cursor: str | None,
    now: str,
) -> Page[models.Alarm]:
    """One page of alarms in a state, newest first; of all runs if `run` is None."""
    chosen = _in_state(state, now)
    if run is not None:
        chosen.append(alarms.c.run == run)
    if spacecraft is not None:
        chosen.append(alarms.c.spacecraft == spacecraft)
    if cursor is not None:
        if not is_ulid(cursor):
            raise BadBatch(Fault("cursor", "is not a cursor of this list", shown_value(cursor)))
        chosen.append(alarms.c.id < cursor)
    query = select(alarms).where(*chosen).order_by(alarms.c.id.desc()).limit(limit + 1)
    rows = list(connection.execute(query).mappings())
    more = len(rows) > limit
    items = [shown_alarm(row, now) for row in rows[:limit]]
    return Page(items, items[-1].id if more else None)


def active_alarms(connection: Connection, run: str, now: str) -> list[models.Alarm]:
    """Alarms of a run that are not cleared, sorted by `present_rank`, then newest first."""
    query = select(alarms).where(alarms.c.run == run, _ACTIVE).order_by(alarms.c.id.desc())
    found = [shown_alarm(row, now) for row in connection.execute(query).mappings()]
    return sorted(found, key=present_rank, reverse=True)


def read_alarm(connection: Connection, id: str, now: str) -> records.AlarmWithActions:
    """An alarm with all its recorded actions, oldest first; raises `NotFound`."""
    alarm = _stored(connection, id)
    query = select(alarm_actions).where(alarm_actions.c.alarm_id == id).order_by(alarm_actions.c.id)
    shown = ("at", "action", "who", "comment", "severity", "value", "time")
    actions = [
        records.AlarmAction(**{name: row[name] for name in shown})
        for row in connection.execute(query).mappings()
    ]
    return records.AlarmWithActions(**_fields(alarm, now), actions=actions)


def act(
    connection: Connection,
    id: str,
    step: Callable[[Row], AlarmUpdate],
    *,
    who: str,
    comment: str | None,
    now: str,
) -> records.AlarmWithActions:
    """Apply a transition of the state machine to an alarm, and record its author and comment."""
    alarm = _stored(connection, id, lock=True)
    changes, actions = step(alarm)
    change(connection, alarm, changes, actions, now, who=who, comment=comment)
    return read_alarm(connection, id, now)


def change(
    connection: Connection,
    alarm: Row,
    changes: Changes,
    actions: Sequence[AlarmActionName],
    now: str,
    *,
    who: str | None = None,
    comment: str | None = None,
) -> Row:
    """Update a stored alarm, record the actions and add an event; returns the changed alarm."""
    if changes:
        connection.execute(update(alarms).where(alarms.c.id == alarm["id"]).values(changes))
    alarm = {**alarm, **changes}
    if actions:
        row = {
            "alarm_id": alarm["id"],
            "at": now,
            "value": alarm["latest_value"],
            "time": alarm["latest_time"],
            "severity": alarm["current_severity"],
            "who": None,
            "comment": None,
        }
        rows = [row | {"action": action} for action in actions]
        # The first action is the user's; the others follow from it.
        rows[0] |= {"who": who, "comment": comment}
        connection.execute(insert(alarm_actions), rows)
        shown, run, spacecraft = shown_alarm(alarm, now), alarm["run"], alarm["spacecraft"]
        events.add_event(connection, "alarm", shown, run=run, spacecraft=spacecraft)
    return alarm


def shown_alarm(alarm: Any, now: str) -> models.Alarm:
    """Convert a database row of an alarm to an API record."""
    return models.Alarm(**_fields(alarm, now))


def _fields(alarm: Any, now: str) -> Row:
    raised = {"at": alarm["raised_at"], "bound": alarm["bound"]}
    return {
        **{name: alarm[name] for name in ("id", "spacecraft", "run", "quantity")},
        "tracker": alarm["tracker"] or None,
        "unit": quantity_named(alarm["quantity"]).unit,
        "state": state_of(alarm, now),
        "severity": alarm["severity"],
        "current_severity": alarm["current_severity"],
        "in_limits": alarm["current_severity"] is None,
        "raised": models.AlarmRaised(**_value(alarm, "raised"), **raised),
        "worst": models.AlarmValue(**_value(alarm, "worst")),
        "latest": models.AlarmValue(**_value(alarm, "latest")),
        "returned_at": alarm["returned_at"],
        "acknowledged": _acted(alarm, "acknowledged"),
        "shelved": _shelved(alarm),
        "cleared_at": alarm["cleared_at"],
    }


def _value(alarm: Any, which: str) -> Row:
    return {name: alarm[f"{which}_{name}"] for name in ("value", "time", "batch_id")}


def _acted(alarm: Any, which: str) -> models.Acted | None:
    at = alarm[f"{which}_at"]
    return None if at is None else models.Acted(at=at, who=alarm[f"{which}_by"])


def _shelved(alarm: Any) -> models.Shelved | None:
    at = alarm["shelved_at"]
    if at is None:
        return None
    return models.Shelved(at=at, who=alarm["shelved_by"], until=alarm["shelved_until"])


def _stored(connection: Connection, id: str, lock: bool = False) -> Row:
    query = select(alarms).where(alarms.c.id == id)
    row = connection.execute(query.with_for_update() if lock else query).mappings().first()
    if row is None:
        raise NotFound(f"there is no alarm with the id {shown_value(id)}")
    return dict(row)


def _in_state(state: StateFilter, now: str) -> list[ColumnElement[bool]]:
    until, seen = alarms.c.shelved_until, alarms.c.acknowledged_at
    off_shelf = or_(until.is_(None), until <= now)
    match state:
        case "all":
            return []
        case "cleared":
            return [alarms.c.cleared_at.is_not(None)]
        case "active":
            return [_ACTIVE]
        case "shelved":
            return [_ACTIVE, until > now]
        case "open":
            return [and_(_ACTIVE, off_shelf, seen.is_(None))]
        case "acknowledged":
            return [and_(_ACTIVE, off_shelf, seen.is_not(None))]


MOST = 200
"""Greatest number of alarms read for a period, the newest; more would be illegible on a chart."""
_LEFT, _RETURNED = ("raised", "left_again"), "returned"
TimeOut = tuple[str, str | None]
"""Start and end of an interval as UTC texts; the end is None while the interval lasts."""


def alarm_spans(
    connection: Connection, run: str, spacecraft: str, start: Utc, end: Utc
) -> list[records.AlarmSpan]:
    """Intervals of telemetry time in which alarms were out of limits, oldest first.

    Only intervals that touch the period from `start` up to `end` count, and only the newest alarms.
    """
    # Texts of times sort correctly except for different lengths of their fractions.
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
        records.AlarmSpan(
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


def times_out(connection: Connection, found: Sequence[models.Alarm]) -> list[list[TimeOut]]:
    """Intervals of telemetry time in which the value of each alarm was out of limits."""
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


def _times_out(alarm: models.Alarm, actions: Sequence[tuple[str, str | None]]) -> list[TimeOut]:
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


def _touches(span: records.AlarmSpan, start: Utc, end: Utc) -> bool:
    is_over = span.end is not None and recorded_utc(span.end).tai_ns < start.tai_ns
    return not is_over and recorded_utc(span.start).tai_ns < end.tai_ns
