"""Alarms in the records: lists, one with all that was done about it, and what people do."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

from sqlalchemy import ColumnElement, Connection, and_, insert, or_, select, update

from service.alarms.latch import Action, Changes, Step, state_of
from service.alarms.limits import Severity
from service.alarms.quantities import QUANTITIES
from service.errors import BadBatch, Fault, NotFound, shown_value
from service.records import events
from service.records.draft import Row
from service.records.ids import is_ulid
from service.records.pages import Page
from service.records.tables import alarm_actions, alarms

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
) -> Page:
    """Alarms, the newest first; without a run those of every run."""
    chosen = _in_state(state, now)
    if run is not None:
        chosen.append(alarms.c.run == run)
    if spacecraft is not None:
        chosen.append(alarms.c.spacecraft == spacecraft)
    if cursor is not None:
        if not is_ulid(cursor):
            raise BadBatch(Fault("cursor", "is none that a page gave", shown_value(cursor)))
        chosen.append(alarms.c.id < cursor)
    query = select(alarms).where(*chosen).order_by(alarms.c.id.desc()).limit(limit + 1)
    rows = list(connection.execute(query).mappings())
    more = len(rows) > limit
    items = [alarm_row(row, now) for row in rows[:limit]]
    return Page(items, items[-1]["id"] if more else None)


def active_alarms(connection: Connection, run: str, now: str) -> list[Row]:
    """The alarms of a run that are not cleared, the worst first."""
    query = select(alarms).where(alarms.c.run == run, _ACTIVE).order_by(alarms.c.id.desc())
    found = [alarm_row(row, now) for row in connection.execute(query).mappings()]
    return sorted(found, key=lambda each: -Severity[each["severity"].upper()])


def summary(found: Sequence[Row]) -> Row:
    """How many active alarms there are by state, and the worst of those not shelved."""
    states = ("open", "acknowledged", "shelved")
    worst = [each["severity"] for each in found if each["state"] != "shelved"]
    return {
        **{state: sum(each["state"] == state for each in found) for state in states},
        "worst": max(worst, key=lambda word: Severity[word.upper()], default=None),
    }


def one_alarm(connection: Connection, id: str, now: str) -> Row:
    """An alarm with all that was noted of it, oldest first; raises `NotFound`."""
    alarm = _stored(connection, id)
    query = select(alarm_actions).where(alarm_actions.c.alarm_id == id).order_by(alarm_actions.c.id)
    shown = ("at", "action", "who", "comment", "severity", "value", "time")
    actions = [{name: row[name] for name in shown} for row in connection.execute(query).mappings()]
    return alarm_row(alarm, now) | {"actions": actions}


def act(
    connection: Connection,
    id: str,
    step: Callable[[Row], Step],
    *,
    who: str,
    comment: str | None,
    now: str,
) -> Row:
    """Let somebody do something about an alarm (see `latch`), and note who, and what they said."""
    alarm = _stored(connection, id, lock=True)
    changes, actions = step(alarm)
    change(connection, alarm, changes, actions, now, who=who, comment=comment)
    return one_alarm(connection, id, now)


def change(
    connection: Connection,
    alarm: Row,
    changes: Changes,
    actions: Sequence[Action],
    now: str,
    *,
    who: str | None = None,
    comment: str | None = None,
) -> Row:
    """Change a stored alarm, note what was done and tell of it; the alarm as it is then."""
    if changes:
        connection.execute(update(alarms).where(alarms.c.id == alarm["id"]).values(changes))
    whole = {**alarm, **changes}
    note(connection, whole, actions, now, who=who, comment=comment)
    return whole


def note(
    connection: Connection,
    alarm: Row,
    actions: Sequence[Action],
    now: str,
    *,
    who: str | None = None,
    comment: str | None = None,
) -> None:
    """Write down what was done about an alarm, and tell of it."""
    if not actions:
        return
    point = {"value": alarm["latest_value"], "time": alarm["latest_time"]}
    severity = {"severity": alarm["current_severity"]}
    # Of several things at once the first is what somebody did; the others follow from it.
    by = [{"who": who, "comment": comment}] + [{"who": None, "comment": None}] * len(actions)
    rows = [
        {"alarm_id": alarm["id"], "at": now, "action": action, **point, **severity, **whom}
        for action, whom in zip(actions, by, strict=False)
    ]
    connection.execute(insert(alarm_actions), rows)
    shown = alarm_row(alarm, now)
    events.note(connection, "alarm", shown, run=alarm["run"], spacecraft=alarm["spacecraft"])


def alarm_row(alarm: Any, now: str) -> Row:
    """An alarm as the interface shows it."""
    return {
        **{name: alarm[name] for name in ("id", "spacecraft", "run", "quantity")},
        "unit": QUANTITIES[alarm["quantity"]].unit,
        "state": state_of(alarm, now),
        "severity": alarm["severity"],
        "current_severity": alarm["current_severity"],
        "in_limits": alarm["current_severity"] is None,
        "raised": {"at": alarm["raised_at"], "bound": alarm["bound"], **_point(alarm, "raised")},
        "worst": _point(alarm, "worst"),
        "latest": _point(alarm, "latest"),
        "returned_at": alarm["returned_at"],
        "acknowledged": _by(alarm, "acknowledged"),
        "shelved": _shelf(alarm),
        "cleared_at": alarm["cleared_at"],
    }


def _point(alarm: Any, which: str) -> Row:
    return {name: alarm[f"{which}_{name}"] for name in ("value", "time", "batch_id")}


def _by(alarm: Any, which: str) -> Row | None:
    at = alarm[f"{which}_at"]
    return None if at is None else {"at": at, "who": alarm[f"{which}_by"]}


def _shelf(alarm: Any) -> Row | None:
    shelf = _by(alarm, "shelved")
    return shelf and shelf | {"until": alarm["shelved_until"]}


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
