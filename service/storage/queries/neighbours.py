"""The results next to one in time."""

from dataclasses import dataclass

from sqlalchemy import Connection, select

from service.errors import Busy
from service.storage.archive.reading import Archive
from service.storage.models.answers import Neighbours, Summary
from service.storage.queries.pages import ResultFilter
from service.storage.queries.results import summary_of, summary_query
from service.storage.queries.with_archive.rows import FIRST_ID, LAST_ID, ArchiveUse, first_rows
from service.storage.sql.tables import results


@dataclass(frozen=True)
class Here:
    """A result: its spacecraft, run and time, and the id of the current one of its batch."""

    spacecraft: str
    run: str
    time_ns: int
    current: str | None


def here_of(connection: Connection, id: str) -> Here:
    """Where a result is."""
    row = connection.execute(select(results).where(results.c.id == id)).one()
    standing = select(results.c.id).where(results.c.batch_id == row.batch_id, results.c.current)
    return Here(row.spacecraft, row.run, row.time_ns, connection.scalar(standing))


def neighbours(connection: Connection, archive: Archive, here: Here) -> Neighbours:
    """The results before and after one in time, of its spacecraft and run."""
    sides = (_next(connection, archive, here, newest_first=side) for side in (True, False))
    return Neighbours(here.current, *sides)


def _next(
    connection: Connection, archive: Archive, here: Here, *, newest_first: bool
) -> Summary | None:
    selected = ResultFilter(here.run, here.spacecraft)
    beyond = here.time_ns, FIRST_ID if newest_first else LAST_ID
    query = summary_query().where(*selected.conditions())
    try:
        found = first_rows(
            connection,
            ArchiveUse(archive),
            query,
            selected,
            1,
            newest_first=newest_first,
            beyond=beyond,
        )
    except Busy:
        # Without the archive the page of a recorded batch is shown all the same.
        return None
    return next((summary_of(each.shown) for each in found.rows), None)
