"""Alarm changes without a batch: silent spacecraft, and shelving that expires."""

from collections.abc import Mapping
from typing import Any

from sqlalchemy import Connection, select

from service.alarms import state_machine
from service.alarms.limits import LimitSettings, Severity
from service.alarms.quantities import SILENCE
from service.alarms.subjects import Subject
from service.alarms.window import Point
from service.missions.mission import Mission
from service.storage.projections.active_alarms import ActiveAlarms
from service.storage.queries.alarms import change
from service.storage.queries.limits import limits_of
from service.storage.recording.unsaved_result import LIVE
from service.storage.sql.alarm_tables import alarms, watches
from service.times import Utc, recorded_utc


def silence_severity(limits: Mapping[Subject, LimitSettings], gap_s: float) -> Severity | None:
    """The worst severity whose limit a gap between batches exceeds; None within limits."""
    exceeded = limits[SILENCE].severities_out(gap_s)
    return exceeded[-1] if exceeded else None


def evaluate_by_clock(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> None:
    """Raise the alarms of live spacecraft that are silent, and end shelving that has expired."""
    for spacecraft in sorted(_silent(connection, missions, now)):
        row = _locked_watch(connection, spacecraft)
        if row is None:
            continue
        active = ActiveAlarms(connection, spacecraft, LIVE)
        gap_s = _seconds(row["received"], now)
        limits = limits_of(connection, missions[spacecraft])
        severity = silence_severity(limits, gap_s)
        if severity is not None:
            point = Point(gap_s, row["time"], row["batch_id"])
            active.observe(SILENCE, severity, limits[SILENCE], point, now.text)
            active.save()
    expired = connection.execute(_expired(now).with_for_update()).mappings().all()
    for alarm in map(dict, expired):
        changes, actions = state_machine.expired(alarm, now.text)
        change(connection, alarm, changes, actions, now.text)


def is_due_by_clock(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> bool:
    """Whether `evaluate_by_clock` would change anything; it only reads."""
    if connection.execute(_expired(now).limit(1)).first() is not None:
        return True
    return bool(_silent(connection, missions, now))


def _silent(connection: Connection, missions: Mapping[str, Mission], now: Utc) -> set[str]:
    """The live spacecraft whose silence is worse than their alarm says so far."""
    found = set()
    query = select(watches.c.spacecraft, watches.c.received).where(watches.c.run == LIVE)
    for spacecraft, received in connection.execute(query):
        mission = missions.get(spacecraft)
        if mission is None:
            continue
        severity = silence_severity(limits_of(connection, mission), _seconds(received, now))
        if severity is None:
            continue
        noted = select(alarms.c.current_severity).where(
            alarms.c.run == LIVE,
            alarms.c.spacecraft == spacecraft,
            alarms.c.quantity == SILENCE,
            alarms.c.cleared_at.is_(None),
        )
        if connection.execute(noted).scalar() != severity.word:
            found.add(spacecraft)
    return found


def _locked_watch(connection: Connection, spacecraft: str) -> Any:
    query = select(watches).where(watches.c.spacecraft == spacecraft, watches.c.run == LIVE)
    return connection.execute(query.with_for_update()).mappings().first()


def _expired(now: Utc) -> Any:
    return (
        select(alarms)
        .where(alarms.c.cleared_at.is_(None), alarms.c.shelved_until <= now.text)
        .order_by(alarms.c.id)
    )


def _seconds(received: str, now: Utc) -> float:
    return (now.tai_ns - recorded_utc(received).tai_ns) * 1e-9
