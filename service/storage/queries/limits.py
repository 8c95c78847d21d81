"""The limits of spacecraft: those in force, and every one that was set before."""

import json
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from sqlalchemy import ColumnElement, Connection, bindparam, insert, select, update

from service.alarms import quantities, subjects
from service.alarms.limits import LimitSettings, Sample
from service.alarms.quantities import QuantityName
from service.missions.mission import Mission
from service.storage.models.alarms import Limit, LimitHistory
from service.storage.queries.pages import ResultFilter, newest_first
from service.storage.recording import events
from service.storage.sql.alarm_tables import limits
from service.storage.sql.columns import Row
from service.storage.sql.statements import prepared
from service.storage.sql.tables import COUNTED, MEASURED, results, tracker_values

LimitsInForce = Mapping[subjects.Subject, LimitSettings]

_SHIPPED: dict[tuple[str, tuple[str, ...]], Mapping[QuantityName, LimitSettings]] = {}
# Run with every batch of a live spacecraft.
_IN_FORCE = prepared(
    select(limits).where(
        limits.c.spacecraft == bindparam("of_spacecraft"), limits.c.until.is_(None)
    )
)


def limits_of(connection: Connection, mission: Mission) -> LimitsInForce:
    """The limits in force for a spacecraft and its trackers: own ones in place of the shipped."""
    # Read with every batch; a process meets few missions.
    key = mission.digest, quantities.limited_names()
    shipped = _SHIPPED.get(key)
    if shipped is None:
        shipped = _SHIPPED[key] = quantities.default_limits(mission)
    own = {
        subjects.subject_of(row["quantity"], row["tracker"]): _read(row["settings"])
        for row in _in_force(connection, mission.name)
        if row["settings"] is not None
    }
    return subjects.limits_of_subjects(mission, shipped, own)


@lru_cache(maxsize=256)
def _read(settings: str) -> LimitSettings:
    # One object for one text: a window remembers by identity the limits that it is within.
    return LimitSettings.model_validate_json(settings)


def list_limits(connection: Connection, mission: Mission, tracker: str = "") -> list[Limit]:
    """The limit of every quantity, with its time and who set it; or every one of a tracker."""
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
) -> LimitHistory:
    """The limit in force for a quantity, the shipped one, and every one set, newest first."""
    shipped = _inherited(connection, mission, tracker)[quantity]
    query = select(limits).where(*_place(mission, quantity, tracker)).order_by(limits.c.id.desc())
    rows = [dict(row) for row in connection.execute(query).mappings()]
    latest = next((row for row in rows if row["until"] is None), None)
    return LimitHistory(
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
    """The limits that hold where none was set: the shipped ones, or a tracker's spacecraft's."""
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
    """Set a limit from now on; None restores the shipped one.  The one before stays in history."""
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
    """A limit as the interface shows it; without a row the shipped one."""
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


def latest_samples(
    connection: Connection, selected: ResultFilter, subject: subjects.Subject, limit: int
) -> tuple[list[int], list[Sample]]:
    """The times in TAI ns of the latest batches, and their samples of a subject, oldest first."""
    _, tracker = subjects.quantity_and_tracker(subject)
    values = tracker_values if tracker else results
    columns = [values.c[name] for name in (*COUNTED, "status", *MEASURED)]
    query = select(results.c.time_ns, *columns).where(*selected.conditions())
    if tracker:
        same_batch = tracker_values.c.batch_id == results.c.batch_id
        of_tracker = tracker_values.c.tracker == tracker
        query = query.join_from(results, tracker_values, same_batch).where(of_tracker)
    query = newest_first(query).limit(limit)
    sample_of = subjects.sampler(subject)
    rows = [dict(row) for row in connection.execute(query).mappings()][::-1]
    samples = [sample_of(row, {tracker: row}) for row in rows]
    return [row["time_ns"] for row in rows], [each for each in samples if each is not None]
