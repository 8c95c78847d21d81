"""The results next to one in time."""

from typing import Any

from sqlalchemy import Connection, Select, select

from service.storage.models.answers import Neighbours, Summary
from service.storage.queries.pages import ResultFilter, newest_first, oldest_first
from service.storage.queries.results import summary_of, summary_query
from service.storage.sql.tables import results


def neighbours(connection: Connection, id: str) -> Neighbours:
    """The results before and after one in time, of its spacecraft and run."""
    here = connection.execute(select(results).where(results.c.id == id)).one()
    standing = select(results.c.id).where(results.c.batch_id == here.batch_id, results.c.current)
    same = ResultFilter(here.run, here.spacecraft).conditions()
    earlier = newest_first(summary_query().where(*same, results.c.time_ns < here.time_ns))
    later = oldest_first(summary_query().where(*same, results.c.time_ns > here.time_ns))
    return Neighbours(
        connection.execute(standing).scalar(),
        *(_first(connection, query) for query in (earlier, later)),
    )


def _first(connection: Connection, query: Select[Any]) -> Summary | None:
    row = connection.execute(query.limit(1)).mappings().first()
    return None if row is None else summary_of(row)
