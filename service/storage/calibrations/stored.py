"""Calibrations in the records: begun, ended, read, and adopted."""

import json
from collections.abc import Collection

import msgspec
from sqlalchemy import Connection, Select, func, insert, select, update

from service.errors import NotFound, shown_value
from service.storage.calibrations.models import (
    Calibration,
    CalibrationAdoption,
    CalibrationResult,
    CalibrationSummary,
    TrackerGeometry,
)
from service.storage.models.base import Page
from service.storage.recording.ids import following_ulid
from service.storage.sql.calibration_tables import calibration_adoptions, calibrations
from service.storage.sql.columns import Row
from service.storage.sql.statements import execute

_GEOMETRIES = msgspec.json.Decoder(list[TrackerGeometry])
_RESULT = msgspec.json.Decoder(CalibrationResult)
UNFINISHED = ("queued", "running")
_NEWEST_ADOPTION = "SELECT max(id) FROM calibration_adoptions"
_PLAIN = (
    "id",
    "spacecraft",
    "version",
    "run",
    "state",
    "who",
    "created",
    "ended",
    "done",
    "total",
    "fault",
)
_SUMMARY = tuple(calibrations.c[name] for name in (*_PLAIN, "mission_digest", "result"))


def add_calibration(connection: Connection, row: Row) -> None:
    """Record a calibration that begins, as the next version of its spacecraft."""
    latest = select(func.max(calibrations.c.version)).where(
        calibrations.c.spacecraft == row["spacecraft"]
    )
    version = int(connection.scalar(latest) or 0) + 1
    connection.execute(insert(calibrations), row | {"version": version})


def change_calibration(connection: Connection, id: str, changes: Row) -> None:
    """Note the progress of a calibration, or its end."""
    connection.execute(update(calibrations).where(calibrations.c.id == id).values(changes))


def unfinished_calibrations(connection: Connection) -> set[str]:
    """The ids of the calibrations that are computed, or wait for that."""
    unfinished = calibrations.c.state.in_(UNFINISHED)
    return set(connection.scalars(select(calibrations.c.id).where(unfinished)))


def interrupt_calibrations(
    connection: Connection, now: str, only: Collection[str] | None = None
) -> None:
    """Close the calibrations that a stopped process left unfinished; with `only`, of these alone.

    One that another process is at work on is set to what it came to when that process ends it.
    """
    left = [calibrations.c.state.in_(UNFINISHED)]
    if only is not None:
        left.append(calibrations.c.id.in_(only))
    connection.execute(update(calibrations).where(*left).values(state="interrupted", ended=now))


def read_calibration(connection: Connection, id: str) -> Calibration:
    """One calibration with all that was found; raises `NotFound`."""
    row = connection.execute(select(calibrations).where(calibrations.c.id == id)).mappings().first()
    if row is None:
        raise NotFound(f"there is no calibration with the id {shown_value(id)}")
    return Calibration(
        **{name: row[name] for name in _PLAIN},
        mission=row["mission_digest"],
        request=json.loads(row["request"]),
        result=None if row["result"] is None else _RESULT.decode(row["result"]),
        covariance=None if row["covariance"] is None else json.loads(row["covariance"]),
    )


def list_calibrations(
    connection: Connection, spacecraft: str | None, limit: int, cursor: str | None
) -> Page[CalibrationSummary]:
    """Calibrations, newest first; a cursor is the id of the last one shown."""
    query = select(*_SUMMARY).order_by(calibrations.c.id.desc()).limit(limit + 1)
    if spacecraft is not None:
        query = query.where(calibrations.c.spacecraft == spacecraft)
    if cursor is not None:
        query = query.where(calibrations.c.id < cursor)
    rows = [_summary(dict(row)) for row in connection.execute(query).mappings()]
    return Page(rows[:limit], rows[limit - 1].id if len(rows) > limit else None)


def _summary(row: Row) -> CalibrationSummary:
    found = None if row["result"] is None else _RESULT.decode(row["result"])
    return CalibrationSummary(
        **{name: row[name] for name in _PLAIN},
        mission=row["mission_digest"],
        residual_over_sigma=None if found is None else found.residual_over_sigma,
        degree=None if found is None else found.degree,
        first=None if found is None else found.batches.first,
        last=None if found is None else found.batches.last,
        unknowns=found.unknowns if found else [],
        trackers=found.trackers if found else [],
    )


def add_adoption(connection: Connection, row: Row) -> None:
    """Record a change of the calibration in force."""
    connection.execute(insert(calibration_adoptions), row)


def list_adoptions(connection: Connection, spacecraft: str) -> list[CalibrationAdoption]:
    """What a spacecraft's calibration was from when on, newest first."""
    query = _adoptions().where(calibration_adoptions.c.spacecraft == spacecraft)
    return [_adoption(dict(row)) for row in connection.execute(query).mappings()]


def newest_adoption(connection: Connection) -> str:
    """The id of the last change of any spacecraft; empty where there was none."""
    ((newest,),) = execute(connection, _NEWEST_ADOPTION)
    return newest or ""


def begin_adoption(connection: Connection, id: str) -> str:
    """An id for a change, at least this one: it follows all others, whatever clocks say.

    Until the end of the transaction no other process adds one.
    """
    if connection.dialect.name == "postgresql":
        connection.exec_driver_sql("LOCK TABLE calibration_adoptions IN SHARE ROW EXCLUSIVE MODE")
    newest = newest_adoption(connection)
    return id if id > newest else following_ulid(newest)


def latest_adoptions(connection: Connection) -> list[CalibrationAdoption]:
    """The last change of every spacecraft."""
    latest = select(func.max(calibration_adoptions.c.id)).group_by(
        calibration_adoptions.c.spacecraft
    )
    query = _adoptions().where(calibration_adoptions.c.id.in_(latest))
    return [_adoption(dict(row)) for row in connection.execute(query).mappings()]


def _adoptions() -> Select[tuple[object, ...]]:
    return (
        select(calibration_adoptions, calibrations.c.version)
        .join_from(
            calibration_adoptions,
            calibrations,
            calibration_adoptions.c.calibration_id == calibrations.c.id,
            isouter=True,
        )
        .order_by(calibration_adoptions.c.id.desc())
    )


def _adoption(row: Row) -> CalibrationAdoption:
    trackers = row["trackers"]
    return CalibrationAdoption(
        id=row["id"],
        spacecraft=row["spacecraft"],
        adopted=row["adopted"],
        who=row["who"],
        note=row["note"],
        calibration=row["calibration_id"],
        version=row["version"],
        file=row["file_digest"],
        mission=row["mission_digest"],
        trackers=None if trackers is None else _GEOMETRIES.decode(trackers),
    )
