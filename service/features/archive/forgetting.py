"""Removal of wrongly recorded batches from an archive."""

from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path

from sqlalchemy import ColumnElement, Connection, func, select

from service.errors import BadConfiguration
from service.features.archive.archiving import forget_part, put_back
from service.features.archive.folder import (
    Part,
    claim,
    locked,
    manifest_of,
    parts_of,
    remove_part,
)
from service.features.archive.rows import Rows, read_part
from service.storage.projections import rollups
from service.storage.sql.columns import Row
from service.storage.sql.statements import rows_of
from service.storage.sql.tables import archived_batches, archived_hours, archived_parts
from service.storage.store import Store


def forget_archived(
    store: Store,
    folder: Path,
    chosen: Collection[ColumnElement[bool]],
    forget_recorded: Callable[[Connection], object],
) -> int:
    """Remove archived batches, given by SQL conditions on `archived_batches`; returns their number.

    A part whose batches are all selected is deleted.  The batches of any other part are recorded
    again, and `forget_recorded` deletes the selected ones there; `acquire archive` archives the
    rest.
    """

    def forget_some(connection: Connection, part: Part, rows: Rows) -> None:
        put_back(connection, folder, part, rows)
        forget_recorded(connection)

    with locked(folder):
        with store.reading() as connection:
            claim(connection, folder)
            query = select(archived_batches.c.part_id, func.count()).where(*chosen)
            grouped = connection.execute(query.group_by(archived_batches.c.part_id))
            counts = dict(map(tuple, grouped))
            parts = select(archived_parts).where(archived_parts.c.id.in_(counts))
            known = {row["path"]: row for row in rows_of(connection, parts)}
        named = {
            path: (manifest, part) for path, manifest, part in parts_of(folder) if path in known
        }
        if missing := sorted(set(known) - set(named)):
            raise BadConfiguration(f"{folder / missing[0]}: no manifest of the archive names it")
        for path, (manifest, part) in named.items():
            row = known[path]
            if counts[row["id"]] == row["batches"]:
                store.writer.change(partial(_forget_whole, row=row))
            else:
                rows = read_part(folder, path, part.sha256)
                store.writer.change(partial(forget_some, part=part, rows=rows))
            # Delete files after the database rows: `archive verify` names a surplus file; a missing
            # one is lost.
            remove_part(folder, manifest_of(folder, manifest.spacecraft, manifest.day), part)
    return sum(counts.values())


def _forget_whole(connection: Connection, row: Row) -> None:
    own = archived_hours.c.spacecraft == row["spacecraft"], archived_hours.c.run == row["run"]
    query = select(archived_hours.c.bucket).where(*own, archived_hours.c.part_id == row["id"])
    hours = set(connection.scalars(query))
    rollups.lock_position(connection)
    named = archived_batches.c.part_id == row["id"]
    ids = connection.scalars(select(archived_batches.c.id).where(named)).all()
    forget_part(connection, row["id"], row["spacecraft"], row["run"], ids)
    rollups.renew(connection, ((row["spacecraft"], row["run"], hour) for hour in hours))
