"""Calibrations in force: those that an operator adopted in place of a mission file's settings."""

import msgspec
from sqlalchemy import Connection, Select, func, insert, select

from service.contract.calibration import CalibrationAdoption, TrackerGeometry
from service.storage.recording.ids import following_ulid
from service.storage.sql.columns import Row
from service.storage.sql.dialects import dialect_of
from service.storage.sql.statements import execute, rows_of
from service.storage.sql.tables import calibration_adoptions, calibrations

_GEOMETRIES = msgspec.json.Decoder(list[TrackerGeometry])
_NEWEST_ADOPTION = "SELECT max(id) FROM calibration_adoptions"


def add_adoption(connection: Connection, row: Row) -> None:
    """Record an adoption: a change of the calibration in force of a spacecraft."""
    connection.execute(insert(calibration_adoptions), row)


def list_adoptions(connection: Connection, spacecraft: str) -> list[CalibrationAdoption]:
    """Adoptions of calibrations for a spacecraft, newest first."""
    query = _adoptions().where(calibration_adoptions.c.spacecraft == spacecraft)
    return [_adoption(row) for row in rows_of(connection, query)]


def newest_adoption(connection: Connection) -> str:
    """Id of the newest adoption of a calibration, of any spacecraft; empty without one."""
    ((newest,),) = execute(connection, _NEWEST_ADOPTION)
    return newest or ""


def begin_adoption(connection: Connection, id: str) -> str:
    """Choose the id of a new adoption: `id`, or a later one, so that it follows all others.

    The clock's time does not matter.  Until the end of the transaction no other process adds one.
    """
    dialect_of(connection).lock_table(connection, calibration_adoptions.name)
    newest = newest_adoption(connection)
    return id if id > newest else following_ulid(newest)


def latest_adoptions(connection: Connection) -> list[CalibrationAdoption]:
    """The newest adoption of a calibration of every spacecraft."""
    latest = select(func.max(calibration_adoptions.c.id)).group_by(
        calibration_adoptions.c.spacecraft
    )
    query = _adoptions().where(calibration_adoptions.c.id.in_(latest))
    return [_adoption(row) for row in rows_of(connection, query)]


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
        **{name: row[name] for name in ("id", "spacecraft", "adopted", "who", "note", "version")},
        calibration=row["calibration_id"],
        file=row["file_digest"],
        mission=row["mission_digest"],
        trackers=None if trackers is None else _GEOMETRIES.decode(trackers),
    )
