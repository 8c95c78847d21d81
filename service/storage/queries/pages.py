"""Current results in order of their batches' time, a page at a time."""

import base64
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, Connection, RowMapping, Select, tuple_

from service.errors import BadBatch, Fault, shown_value
from service.storage.models.base import Page
from service.storage.recording.ids import is_ulid
from service.storage.recording.unsaved_result import AHEAD_NS, LIVE
from service.storage.sql.tables import results
from service.times import Utc

T = TypeVar("T")

Place = tuple[int, str]
"""The time of a batch, and its id."""

PLACE = (results.c.time_ns, results.c.batch_id)
"""The order of a list.  Columns of the batch, not of the result: adopting changes no order."""


@dataclass(frozen=True)
class ResultFilter:
    """Selects current results of a run and perhaps a spacecraft, from `start` to before `end`.

    Without a run it selects those of every run.
    """

    run: str | None
    spacecraft: str | None = None
    start: Utc | None = None
    end: Utc | None = None

    def conditions(self) -> list[ColumnElement[bool]]:
        """The filter as SQL over `results`."""
        chosen: list[ColumnElement[bool]] = [results.c.current]
        if self.run is not None:
            chosen.append(results.c.run == self.run)
        if self.spacecraft is not None:
            chosen.append(results.c.spacecraft == self.spacecraft)
        if self.start is not None:
            chosen.append(results.c.time_ns >= self.start.tai_ns)
        if self.end is not None:
            chosen.append(results.c.time_ns < self.end.tai_ns)
        return chosen


def newest(
    connection: Connection, query: Select[Any], selected: ResultFilter, now: Utc
) -> RowMapping | None:
    """The newest row of a query over current results.

    A live batch that is dated far in the future is skipped unless there are no
    others: one wrong date must not hide all later batches.  Times of other runs
    are not compared with the clock.
    """
    chosen = query.where(*selected.conditions())
    if selected.run == LIVE:
        near = chosen.where(results.c.time_ns <= now.tai_ns + AHEAD_NS)
        row = connection.execute(newest_first(near).limit(1)).mappings().first()
        if row is not None:
            return row
    return connection.execute(newest_first(chosen).limit(1)).mappings().first()


def newest_first(query: Select[Any], cursor: str | None = None) -> Select[Any]:
    """The query in descending order of time, from beyond the cursor."""
    if cursor is not None:
        query = query.where(tuple_(*PLACE) < tuple_(*read_cursor(cursor)))
    return query.order_by(*(column.desc() for column in PLACE))


def oldest_first(query: Select[Any], cursor: str | None = None) -> Select[Any]:
    """The query in ascending order of time, from beyond the cursor."""
    if cursor is not None:
        query = query.where(tuple_(*PLACE) > tuple_(*read_cursor(cursor)))
    return query.order_by(*PLACE)


def page_of(
    connection: Connection, query: Select[Any], limit: int, shown: Callable[[Any], T]
) -> Page[T]:
    """The first `limit` rows of a query, each as `shown` makes it."""
    # One row more than asked for tells whether there is another page.
    rows = list(connection.execute(query.limit(limit + 1)).mappings())
    more = len(rows) > limit
    rows = rows[:limit]
    return Page(
        [shown(row) for row in rows], cursor_of(_place_of(rows[-1])) if more and rows else None
    )


def _place_of(row: Any) -> Place:
    return row["time_ns"], row["batch_id"]


def cursor_of(place: Place) -> str:
    """The cursor of a list that goes on beyond a place."""
    text = f"{place[0]}.{place[1]}"
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def read_cursor(cursor: str) -> Place:
    """The place of a cursor; raises `BadBatch` for a text that is none."""
    try:
        padded = cursor.encode("ascii") + b"=" * (-len(cursor) % 4)
        time_ns, _, batch_id = base64.urlsafe_b64decode(padded).decode("ascii").partition(".")
        place = int(time_ns)
        if not is_ulid(batch_id) or abs(place) >= 1 << 63:
            raise ValueError(cursor)
    except ValueError:
        fault = Fault("cursor", "is not a cursor of this list", shown_value(cursor))
        raise BadBatch(fault) from None
    return place, batch_id
