"""State machine of an alarm: raised, latched, acknowledged, shelved, cleared.

        out of limits                 acknowledged and back in limits
    ───────────────────► ACTIVE ─────────────────────────────────────► CLEARED
                           │  open ◄──── worse than it was ──┐
                           │    └── acknowledge ──► acknowledged
                           └  shelved until a time: either of them, set aside

An alarm is cleared when both are true, in either order: somebody acknowledged
it, and the quantity is back in limits.  An alarm that becomes worse than ever is
open again.  Shelving has an end and does not keep an alarm from clearing.

Each function returns the columns of the alarm that change and the actions to
note; nothing is changed in place.
"""

from collections.abc import Mapping
from typing import Any

from service.contract.alarms import AlarmActionName, AlarmState
from service.errors import WrongState
from service.features.alarms.windows import Point
from service.trends.limits import LimitSettings, Severity

AlarmColumns = Mapping[str, Any]
Changes = dict[str, Any]
AlarmUpdate = tuple[Changes, list[AlarmActionName]]


def state_of(alarm: AlarmColumns, now: str) -> AlarmState:
    """State of an alarm at a time; times are UTC texts of one format."""
    if alarm["cleared_at"] is not None:
        return "cleared"
    if alarm["shelved_until"] is not None and alarm["shelved_until"] > now:
        return "shelved"
    return "open" if alarm["acknowledged_at"] is None else "acknowledged"


def raised(
    severity: Severity, limits: LimitSettings, point: Point, now: str, worst: Point | None = None
) -> AlarmUpdate:
    """Columns and actions of a new alarm; `worst` is the worst value since limits were left."""
    columns = {
        "severity": severity.word,
        "current_severity": severity.word,
        "raised_at": now,
        "bound": limits.bound(severity, point.value),
        **_at("raised", point),
        **_at("worst", worst or point),
        **_at("latest", point),
        "returned_at": None,
        "acknowledged_at": None,
        "acknowledged_by": None,
        "shelved_at": None,
        "shelved_by": None,
        "shelved_until": None,
        "cleared_at": None,
    }
    return columns, ["raised"]


def observed(
    alarm: AlarmColumns,
    severity: Severity | None,
    limits: LimitSettings,
    point: Point,
    now: str,
    worst: Point | None = None,
) -> AlarmUpdate:
    """Columns and actions for a new value of an active alarm; `severity` is None within limits.

    `worst` is the worst value since limits were left, if that is not `point`.
    """
    was = _severity(alarm["current_severity"])
    changes: Changes = _at("latest", point)
    if severity is None:
        if was is None:
            return changes, []
        changes |= {"current_severity": None, "returned_at": now}
        return _cleared(alarm, changes, ["returned"], now)
    changes |= {"current_severity": severity.word, "returned_at": None}
    worst = worst or point
    if limits.beyond(severity, worst.value) > limits.beyond(severity, alarm["worst_value"]):
        changes |= _at("worst", worst)
    actions: list[AlarmActionName] = []
    if severity > Severity[alarm["severity"].upper()]:
        changes |= {"severity": severity.word, "bound": limits.bound(severity, point.value)}
        changes |= {"acknowledged_at": None, "acknowledged_by": None}
        actions = ["escalated"]
    elif was is None:
        actions = ["left_again"]
    elif severity < was:
        actions = ["eased"]
    return changes, actions


def acknowledged(
    alarm: AlarmColumns, who: str, now: str, *, is_retired: bool = False
) -> AlarmUpdate:
    """Acknowledge an alarm for `who`; raises `WrongState` if acknowledged before, or cleared.

    The alarm of a retired subject, which gets no more values, is cleared as well.
    """
    _require_active(alarm)
    if alarm["acknowledged_at"] is not None and not is_retired:
        raise WrongState(f"the alarm is already acknowledged by {alarm['acknowledged_by']}")
    changes: Changes = {"acknowledged_at": now, "acknowledged_by": who}
    if is_retired:
        changes["current_severity"] = None
    return _cleared({**alarm, **changes}, changes, ["acknowledged"], now)


def shelved(alarm: AlarmColumns, who: str, until: str, now: str) -> AlarmUpdate:
    """Shelve an alarm until a time; shelving again replaces the time."""
    _require_active(alarm)
    return {"shelved_at": now, "shelved_by": who, "shelved_until": until}, ["shelved"]


def unshelved(alarm: AlarmColumns) -> AlarmUpdate:
    """End the shelving of an alarm; raises `WrongState` if the alarm is not shelved."""
    _require_active(alarm)
    if alarm["shelved_until"] is None:
        raise WrongState("the alarm is not shelved")
    return {"shelved_at": None, "shelved_by": None, "shelved_until": None}, ["unshelved"]


def expired(alarm: AlarmColumns, now: str) -> AlarmUpdate:
    """End the shelving of an alarm if its time is over; otherwise change nothing."""
    over = alarm["cleared_at"] is None and (alarm["shelved_until"] or "~") <= now
    changes: Changes = {"shelved_at": None, "shelved_by": None, "shelved_until": None}
    return (changes, ["shelf_expired"]) if over else ({}, [])


def _cleared(
    alarm: AlarmColumns, changes: Changes, actions: list[AlarmActionName], now: str
) -> AlarmUpdate:
    whole = {**alarm, **changes}
    if whole["acknowledged_at"] is not None and whole["current_severity"] is None:
        return changes | {"cleared_at": now}, [*actions, "cleared"]
    return changes, actions


def _require_active(alarm: AlarmColumns) -> None:
    if alarm["cleared_at"] is not None:
        raise WrongState(f"the alarm was cleared at {alarm['cleared_at']}")


def _at(which: str, point: Point) -> Changes:
    return {
        f"{which}_value": point.value,
        f"{which}_time": point.time,
        f"{which}_batch_id": point.batch_id,
    }


def _severity(word: str | None) -> Severity | None:
    return None if word is None else Severity[word.upper()]
