"""Batches of two runs of which some are archived, in groups that one database in memory takes."""

from collections.abc import Collection, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Table, select, tuple_

from service.storage.archive.reading import Archive, parts_between, places
from service.storage.queries.pages import PLACE, Place, ResultFilter
from service.storage.queries.with_archive.rows import ArchiveUse, bounds_of, first_rows
from service.storage.sql.archive_tables import archived_batches
from service.storage.sql.tables import batches, results

if TYPE_CHECKING:
    from service.storage.archive.opened import Opened

GROUP = 2_000
"""Batches of a run that are compared together."""
_COMPARED = ("solution", "stars")
_AT_ONCE = 1_000


def is_archived_in_part(connection: Connection, selected: ResultFilter, other: str) -> bool:
    """Whether the archive has batches of the period in one of the runs."""
    return any(
        parts_between(connection, selected.spacecraft, run, *bounds_of(selected))
        for run in (selected.run, other)
    )


def both_runs(
    connection: Connection,
    archive: Archive,
    selected: ResultFilter,
    other: str,
    latest: int | None,
) -> Iterator["Opened"]:
    """The selected batches with those of the same names in another run, latest first.

    At most the `latest` of those selected.  Recorded and archived ones are copied into one
    database, so that any of the two may be in either place.
    """
    from service.storage.archive.opened import Opened

    named = (results.c.spacecraft, batches.c.batch)
    query = select(*PLACE, *named).join_from(results, batches, results.c.batch_id == batches.c.id)
    query = query.where(*selected.conditions())
    use, left = ArchiveUse(archive), latest
    beyond: Place | None = None
    while left is None or left > 0:
        limit = GROUP if left is None else min(GROUP, left)
        found = first_rows(
            connection, use, query, selected, limit, newest_first=True, beyond=beyond
        ).rows
        if not found:
            return
        opened = Opened()
        names = [(each.row.spacecraft, each.row.batch) for each in found]
        own: dict[bool, list[str]] = {True: [], False: []}
        for each in found:
            own[each.archived].append(each.row.batch_id)
        _add_recorded(connection, opened, [*own[False], *_named(connection, batches, other, names)])
        archived = [*own[True], *_named(connection, archived_batches, other, names)]
        _add_archived(connection, archive, opened, archived)
        opened.add_indexes()
        yield opened
        beyond = found[-1].place
        left = None if left is None else left - len(found)
        if len(found) < limit:
            return


def _named(
    connection: Connection, table: Table, run: str, names: Sequence[tuple[str, str]]
) -> list[str]:
    """The ids of batches of a run by spacecraft and name."""
    c = table.c
    found: list[str] = []
    for first in range(0, len(names), _AT_ONCE):
        some = names[first : first + _AT_ONCE]
        query = select(c.id).where(c.run == run, tuple_(c.spacecraft, c.batch).in_(some))
        found += connection.scalars(query)
    return found


def _add_recorded(connection: Connection, opened: "Opened", ids: Sequence[str]) -> None:
    from service.storage.archive.rows import read_rows

    if ids:
        opened.add_rows(read_rows(connection, ids))


def _add_archived(
    connection: Connection, archive: Archive, opened: "Opened", ids: Collection[str]
) -> None:
    from service.storage.archive.opened import columns_of

    for path, of_part in _places(connection, list(ids)).items():
        own: Any = [[("id", "in", of_part)], [("batch_id", "in", of_part)]]
        opened.add_partition(archive.read(path, columns_of(_COMPARED), own))


def _places(connection: Connection, ids: Sequence[str]) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for first in range(0, len(ids), _AT_ONCE):
        for path, some in places(connection, ids[first : first + _AT_ONCE]).items():
            found.setdefault(path, []).extend(some)
    return found
