"""Pages of current results in order of their batches' time, from the record and the archive.

The database knows the archive parts that overlap a period.  A query runs on the record and then on
one row group of the archive after another, until the first rows in order are certain.
"""

import base64
import heapq
import itertools
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import ColumnElement, Connection, RowMapping, Select, func, select, tuple_

from service.contract.base import Page
from service.errors import BadBatch, Fault, shown_value
from service.observations.schema import LIVE
from service.storage.archived import Archive, Block, PlacedPart, parts_between
from service.storage.recording.ids import is_ulid
from service.storage.recording.unsaved_result import AHEAD_NS
from service.storage.sql.tables import batches, results
from service.times import Utc, recorded_utc

Place = tuple[int, str]
"""Position in the order of time: the time of a batch in ns of TAI, and its id."""

QUATERNION = ("q1", "q2", "q3", "qc")
COVARIANCE = ("p11", "p12", "p13", "p22", "p23", "p33")
"""Columns of `solutions` with the upper triangle of the covariance matrix."""

PLACE = (results.c.time_ns, results.c.batch_id)
"""Columns that order a list.  Both belong to the batch: an adopted result changes no order."""


@dataclass(frozen=True)
class ResultFilter:
    """Filter for current results of a run and a spacecraft, from `start` to before `end`.

    None for the run or the spacecraft selects all.
    """

    run: str | None
    spacecraft: str | None = None
    start: Utc | None = None
    end: Utc | None = None

    def conditions(self) -> list[ColumnElement[bool]]:
        """Convert the filter of results to SQL conditions."""
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


def covariance_of(upper: Sequence[float]) -> list[list[float]]:
    """Covariance matrix from its upper triangle, in the order of `COVARIANCE`."""
    p11, p12, p13, p22, p23, p33 = upper
    return [[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]]


def newest(
    connection: Connection, query: Select[Any], selected: ResultFilter, now: Utc
) -> RowMapping | None:
    """Newest row of a query over current results.

    A live batch that is dated far in the future is skipped unless there are no others: one wrong
    date must not hide all later batches.  Times of other runs are not compared with the clock.
    """
    chosen = query.where(*selected.conditions())
    if selected.run == LIVE:
        near = chosen.where(results.c.time_ns <= now.tai_ns + AHEAD_NS)
        row = connection.execute(newest_first(near).limit(1)).mappings().first()
        if row is not None:
            return row
    return connection.execute(newest_first(chosen).limit(1)).mappings().first()


def newest_first(query: Select[Any]) -> Select[Any]:
    """Sort a query by descending time."""
    return query.order_by(*(column.desc() for column in PLACE))


def latest_time(connection: Connection, selected: ResultFilter, now: Utc) -> Utc | None:
    """Time of the newest selected batch; None without any."""
    query = select(batches.c.time).join_from(results, batches, results.c.batch_id == batches.c.id)
    row = newest(connection, query, selected, now)
    return None if row is None else recorded_utc(row["time"])


def cursor_of(place: Place) -> str:
    """Encode a position in the order of time as the cursor of a list."""
    text = f"{place[0]}.{place[1]}"
    return base64.urlsafe_b64encode(text.encode()).decode().rstrip("=")


def read_cursor(cursor: str) -> Place:
    """Decode the cursor of a list to a position; raises `BadBatch` for an invalid text."""
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


T = TypeVar("T")
Reading = Callable[[], AbstractContextManager[Connection]]

MOST_OPENED = 40
"""Largest number of row groups opened for a page of a list: about a second's work."""
FIRST_ID, LAST_ID = "0" * 26, "7" + "Z" * 25
"""Result ids that sort before and after every real one."""


@dataclass(frozen=True)
class Found:
    """Row of a query, with True if it comes from the archive."""

    row: Any
    archived: bool

    @property
    def place(self) -> Place:
        """Position of the row in the order of time."""
        return self.row.time_ns, self.row.batch_id

    @property
    def shown(self) -> dict[str, Any]:
        """Row as values by column name, with `archived` added."""
        return {**self.row._mapping, "archived": self.archived}


@dataclass(frozen=True)
class Merged:
    """Rows in order; `resume` is the position where the search stopped early, None if complete."""

    rows: list[Found]
    resume: Place | None = None


@dataclass(frozen=True)
class Listing:
    """Query over current results, recorded and archived, in order of time.

    The columns of the query include `PLACE`; the query is unordered and includes all conditions of
    the filter.
    """

    archive: Archive
    query: Select[Any]
    selected: ResultFilter
    newest_first: bool = False
    needs: Collection[str] = ()
    """Further archive columns to read, beyond those of results and batches; see `Archive.open`."""
    most_opened: int | None = None
    parts: Collection[int] | None = None
    """Ids of the only archive parts to search; None for all."""

    def first_rows(self, connection: Connection, limit: int, beyond: Place | None = None) -> Merged:
        """The first `limit` rows after a position, merged from the database and the archive."""
        query = self.query
        if beyond is not None:
            place, bound = tuple_(*PLACE), tuple_(*beyond)
            query = query.where(place < bound if self.newest_first else place > bound)
        order = [column.desc() if self.newest_first else column for column in PLACE]
        query = query.order_by(*order).limit(limit)
        found = [Found(row, False) for row in connection.execute(query)]
        sign = -1 if self.newest_first else 1
        last_ns = found[limit - 1].place[0] if len(found) >= limit else None
        # Unread parts and row groups, by their start in the order of the list.
        heap: list[tuple[int, int, PlacedPart | Block]] = []
        numbers = itertools.count()

        def read_later(more: Iterable[PlacedPart | Block]) -> None:
            for each in more:
                begins = each.first_ns if sign > 0 else -each.last_ns
                heapq.heappush(heap, (begins, next(numbers), each))

        read_later(self._parts(connection, beyond, last_ns))
        opened = 0
        while heap:
            begins, _, next_up = heapq.heappop(heap)
            if len(found) >= limit and sign * found[limit - 1].place[0] < begins:
                break
            if isinstance(next_up, PlacedPart):
                blocks = self.archive.blocks(next_up)
                read_later(each for each in blocks if self._reaches(each, beyond))
                continue
            # Open all row groups that begin where the page does: the next page would begin there.
            is_further = beyond is None or sign * beyond[0] < begins
            if self.most_opened is not None and opened >= self.most_opened and is_further:
                certain = [each for each in found if sign * each.place[0] < begins]
                border = LAST_ID if self.newest_first else FIRST_ID
                return Merged(certain, (sign * begins, border))
            opened += 1
            with self.archive.open(next_up, self.needs).reading() as connection_of_block:
                rows = connection_of_block.execute(query).all()
            found += [Found(row, True) for row in rows]
            found.sort(key=lambda each: each.place, reverse=self.newest_first)
            del found[limit:]
        return Merged(found)

    def page(
        self, connection: Connection, limit: int, cursor: str | None, shown: Callable[[Any], T]
    ) -> Page[T]:
        """Page of the first `limit` rows after a cursor, each converted by `shown`.

        `shown` gets the row as a dictionary, where `archived` tells its origin.  A page over many
        parts of the archive may have fewer rows, or none, and still a cursor.
        """
        beyond = None if cursor is None else read_cursor(cursor)
        # Ask for one row more, which shows if there is another page.
        found = self.first_rows(connection, limit + 1, beyond)
        rows, resume = found.rows, found.resume
        if len(rows) > limit:
            rows = rows[:limit]
            resume = rows[-1].place
        items = [shown(each.shown) for each in rows]
        return Page(items, None if resume is None else cursor_of(resume))

    def row_pages(self, reading: Reading, page: int) -> Iterator[list[Any]]:
        """Read all rows of the query in pages of `page` rows.

        Between two pages no connection is held, so that a slow reader blocks no other.
        """
        beyond: Place | None = None
        while True:
            with reading() as connection:
                found = self.first_rows(connection, page, beyond).rows
            if found:
                yield [each.row for each in found]
            if len(found) < page:
                return
            beyond = found[-1].place

    def _parts(
        self, connection: Connection, beyond: Place | None, last_ns: int | None
    ) -> list[PlacedPart]:
        """Archive parts that may have rows after a position and not after `last_ns`."""
        if self.parts is not None and not self.parts:
            return []
        first_ns, end_ns = bounds_of(self.selected)
        if last_ns is not None and self.newest_first:
            first_ns = last_ns if first_ns is None else max(first_ns, last_ns)
        elif last_ns is not None:
            end_ns = last_ns + 1 if end_ns is None else min(end_ns, last_ns + 1)
        return [
            each
            for each in parts_between(
                connection, self.selected.spacecraft, self.selected.run, first_ns, end_ns
            )
            if (self.parts is None or each.id in self.parts) and self._reaches(each, beyond)
        ]

    def _reaches(self, each: PlacedPart | Block, beyond: Place | None) -> bool:
        """True if an archive part or row group may have rows of the filter after a position."""
        start_ns, end_ns = bounds_of(self.selected)
        if start_ns is not None and each.last_ns < start_ns:
            return False
        if end_ns is not None and each.first_ns >= end_ns:
            return False
        if beyond is None:
            return True
        return each.first_ns <= beyond[0] if self.newest_first else each.last_ns >= beyond[0]


def all_rows(
    connection: Connection,
    archive: Archive,
    needs: Collection[str],
    query: Select[Any],
    places: Sequence[Place],
) -> list[Any]:
    """Read all rows of a query over results at given positions, in order of time.

    The query itself orders the rows of one position.
    """
    rows = list(connection.execute(query))
    if not places:
        return rows
    ends = min(places)[0], max(places)[0]
    for part in parts_between(connection, None, None, ends[0], ends[1] + 1):
        for block in archive.blocks(part):
            if block.first_ns <= ends[1] and block.last_ns >= ends[0]:
                with archive.open(block, needs).reading() as connection_of_block:
                    rows += connection_of_block.execute(query)
    rows.sort(key=lambda row: (row.time_ns, row.batch_id))
    return rows


def count(connection: Connection, archive: Archive, selected: ResultFilter, most: int) -> int:
    """Count the selected current results, up to `most`."""
    bounded = select(results.c.batch_id).where(*selected.conditions()).limit(most).subquery()
    query = select(func.count()).select_from(bounded)
    found = int(connection.scalar(query) or 0)
    for part in parts_of(connection, selected):
        if found >= most:
            return most
        found += count_of_part(archive, part, selected)
    return min(found, most)


def parts_of(connection: Connection, selected: ResultFilter) -> list[PlacedPart]:
    """Archive parts that may hold selected results."""
    return parts_between(connection, selected.spacecraft, selected.run, *bounds_of(selected))


def count_of_part(archive: Archive, part: PlacedPart, selected: ResultFilter) -> int:
    """Count the selected batches of an archive part."""
    start_ns, end_ns = bounds_of(selected)
    if (start_ns is None or part.first_ns >= start_ns) and (
        end_ns is None or part.last_ns < end_ns
    ):
        return part.batches
    return len(archive.current_ids(part, start_ns, end_ns))


def bounds_of(selected: ResultFilter) -> tuple[int | None, int | None]:
    """Start and end of a result filter in ns of TAI; None for an open end."""
    return (
        None if selected.start is None else selected.start.tai_ns,
        None if selected.end is None else selected.end.tai_ns,
    )
