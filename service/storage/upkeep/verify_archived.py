"""Checks what a database says of its archive; the files are checked by `acquire archive verify`."""

from collections.abc import Iterator

from sqlalchemy import Engine, and_, func, select

from service.storage.sql.archive_tables import archived_batches, archived_parts
from service.storage.sql.tables import batches


def of_the_archived(engine: Engine) -> Iterator[str]:
    """The faults: batches in no part, in fewer than their part has, and recorded ones."""
    counted = select(archived_batches.c.part_id, func.count()).group_by(archived_batches.c.part_id)
    both = select(batches.c.id).join(
        archived_batches,
        and_(*(archived_batches.c[name] == batches.c[name] for name in _IDENTITY)),
    )
    with engine.begin() as connection:
        found = dict(map(tuple, connection.execute(counted)))
        parts = connection.execute(select(archived_parts)).mappings().all()
        recorded = list(connection.scalars(both)) if found else []
    for part in parts:
        if found.pop(part["id"], 0) != part["batches"]:
            yield f"archived part {part['path']}: its batches are not all noted as archived"
    for part_id in found:
        yield f"archived batches are noted of a part that is not there: {part_id}"
    for id in recorded:
        yield f"batch {id}: it is recorded and archived"


_IDENTITY = ("spacecraft", "run", "batch")
