"""Annotations in the records: written, listed and deleted."""

from typing import Any

import msgspec
from sqlalchemy import Connection, delete, insert, or_, select

from service.errors import BadBatch, Fault, NotFound, shown_value
from service.storage.models.alarms import Annotation, AnnotationChange
from service.storage.models.base import Page
from service.storage.recording import events
from service.storage.recording.ids import is_ulid
from service.storage.sql.alarm_tables import annotations
from service.storage.sql.columns import Row
from service.times import Utc

_SHOWN = ("id", "spacecraft", "start", "end", "text", "who", "created")


def add_annotation(connection: Connection, row: Row) -> Annotation:
    """Store an annotation, and add an event."""
    connection.execute(insert(annotations), row)
    shown = _shown(row)
    _add_event(connection, shown, deleted=False)
    return shown


def list_annotations(
    connection: Connection,
    *,
    spacecraft: str | None,
    start: Utc | None,
    end: Utc | None,
    limit: int,
    cursor: str | None,
) -> Page[Annotation]:
    """Annotations that touch the period from `start` to before `end`, the latest written first.

    Those of a spacecraft include those about every spacecraft.
    """
    chosen = []
    if spacecraft is not None:
        of_all = annotations.c.spacecraft.is_(None)
        chosen.append(or_(annotations.c.spacecraft == spacecraft, of_all))
    if start is not None:
        chosen.append(annotations.c.end_ns >= start.tai_ns)
    if end is not None:
        chosen.append(annotations.c.start_ns < end.tai_ns)
    if cursor is not None:
        if not is_ulid(cursor):
            raise BadBatch(Fault("cursor", "is not a cursor of this list", shown_value(cursor)))
        chosen.append(annotations.c.id < cursor)
    query = select(annotations).where(*chosen).order_by(annotations.c.id.desc()).limit(limit + 1)
    rows = [_shown(row) for row in connection.execute(query).mappings()]
    return Page(rows[:limit], rows[limit - 1].id if len(rows) > limit else None)


def read_annotation(connection: Connection, id: str) -> Annotation:
    """One annotation; raises `NotFound`."""
    query = select(annotations).where(annotations.c.id == id)
    row = connection.execute(query).mappings().first()
    if row is None:
        raise NotFound(f"there is no annotation with the id {shown_value(id)}")
    return _shown(row)


def delete_annotation(connection: Connection, id: str) -> Annotation:
    """Delete an annotation, and add an event; raises `NotFound`."""
    found = read_annotation(connection, id)
    connection.execute(delete(annotations).where(annotations.c.id == id))
    _add_event(connection, found, deleted=True)
    return found


def _shown(row: Any) -> Annotation:
    return Annotation(**{name: row[name] for name in _SHOWN})


def _add_event(connection: Connection, shown: Annotation, *, deleted: bool) -> None:
    data = AnnotationChange(**msgspec.structs.asdict(shown), deleted=deleted)
    events.add_event(connection, "annotation", data, spacecraft=shown.spacecraft)
