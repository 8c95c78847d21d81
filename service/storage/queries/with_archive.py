"""Queries over current results, recorded and archived ones in one order of time.

The database knows which parts of the archive reach into a period.  The same query then runs on the
record and on one row group of the archive after another, until it is certain what comes first.
"""

import heapq
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, TypeVar

from sqlalchemy import Connection, Select, func, select, tuple_

from service.storage.archive.reading import Archive, Block, PlacedPart, parts_between
from service.storage.models.base import Page
from service.storage.queries.pages import PLACE, Place, ResultFilter, cursor_of, read_cursor
from service.storage.sql.tables import results

T = TypeVar("T")
Reading = Callable[[], AbstractContextManager[Connection]]

MOST_OPENED = 40
"""Row groups that a page of a list opens: about a second's work."""
FIRST_ID, LAST_ID = "0" * 26, "7" + "Z" * 25
"""Ids before and after any other."""


@dataclass(frozen=True)
class Found:
    """A row, and whether it is of the archive."""

    row: Any
    archived: bool

    @property
    def place(self) -> Place:
        """Its place in the order of time."""
        return self.row.time_ns, self.row.batch_id

    @property
    def shown(self) -> dict[str, Any]:
        """The row by column, with `archived`."""
        return {**self.row._mapping, "archived": self.archived}


@dataclass(frozen=True)
class Merged:
    """Rows in order; `resume` is the place where the next ones begin if not all were looked for."""

    rows: list[Found]
    resume: Place | None = None


@dataclass(frozen=True)
class ArchiveUse:
    """The archive, and what a query needs of it beside the columns of results and batches."""

    archive: Archive
    needs: Collection[str] = ()
    """Names of `opened.WHOLE`."""
    most_opened: int | None = None
    parts: Collection[int] | None = None
    """The ids of the only parts to look in."""


def first_rows(
    connection: Connection,
    use: ArchiveUse,
    query: Select[Any],
    selected: ResultFilter,
    limit: int,
    *,
    newest_first: bool = False,
    beyond: Place | None = None,
) -> Merged:
    """The first `limit` rows of a query whose columns include `PLACE`, beyond a place.

    The query has no order and, of the filter, all conditions.
    """
    if beyond is not None:
        place, bound = tuple_(*PLACE), tuple_(*beyond)
        query = query.where(place < bound if newest_first else place > bound)
    order = [column.desc() if newest_first else column for column in PLACE]
    query = query.order_by(*order).limit(limit)
    found = [Found(row, False) for row in connection.execute(query)]
    sign = -1 if newest_first else 1
    last_ns = found[limit - 1].place[0] if len(found) >= limit else None
    waiting = _Waiting(parts_of(connection, use, selected, newest_first, beyond, last_ns), sign)
    opened = 0
    while waiting.any_left:
        begins = waiting.begins
        if len(found) >= limit and sign * found[limit - 1].place[0] < begins:
            break
        next_up = waiting.pop()
        if isinstance(next_up, PlacedPart):
            blocks = use.archive.blocks(next_up)
            waiting.add(each for each in blocks if _reaches(each, selected, newest_first, beyond))
            continue
        # Row groups that begin where the page does are all opened: the next page would begin there.
        is_further = beyond is None or sign * beyond[0] < begins
        if use.most_opened is not None and opened >= use.most_opened and is_further:
            certain = [each for each in found if sign * each.place[0] < begins]
            border = LAST_ID if newest_first else FIRST_ID
            return Merged(certain, (sign * begins, border))
        opened += 1
        with use.archive.open(next_up, use.needs).reading() as connection_of_block:
            rows = connection_of_block.execute(query).all()
        found += [Found(row, True) for row in rows]
        found.sort(key=lambda each: each.place, reverse=newest_first)
        del found[limit:]
    return Merged(found)


def page_of(
    connection: Connection,
    use: ArchiveUse,
    query: Select[Any],
    selected: ResultFilter,
    limit: int,
    shown: Callable[[Any], T],
    *,
    newest_first: bool = False,
    cursor: str | None = None,
) -> Page[T]:
    """The first `limit` rows beyond a cursor, each as `shown` makes it of a row as a dictionary.

    The dictionary says by `archived` where the row is from.  A page over many parts of the archive
    may have fewer rows, or none, and a cursor all the same.
    """
    beyond = None if cursor is None else read_cursor(cursor)
    # One row more than asked for tells whether there is another page.
    found = first_rows(
        connection, use, query, selected, limit + 1, newest_first=newest_first, beyond=beyond
    )
    rows, resume = found.rows, found.resume
    if len(rows) > limit:
        rows = rows[:limit]
        resume = rows[-1].place
    items = [shown(each.shown) for each in rows]
    return Page(items, None if resume is None else cursor_of(resume))


def row_pages(
    reading: Reading,
    use: ArchiveUse,
    query: Select[Any],
    selected: ResultFilter,
    page: int,
    *,
    newest_first: bool = False,
) -> Iterator[list[Any]]:
    """All rows of a query over current results, `page` rows at a time.

    Between two pages no connection is held, so that a slow reader keeps none from others.
    """
    beyond: Place | None = None
    while True:
        with reading() as connection:
            found = first_rows(
                connection, use, query, selected, page, newest_first=newest_first, beyond=beyond
            ).rows
        if found:
            yield [each.row for each in found]
        if len(found) < page:
            return
        beyond = found[-1].place


def all_rows(
    connection: Connection, use: ArchiveUse, query: Select[Any], places: Sequence[Place]
) -> list[Any]:
    """Every row of a query over some results, which stand at these places, in order of time.

    The query has its order within a place.
    """
    rows = list(connection.execute(query))
    if not places:
        return rows
    ends = min(places)[0], max(places)[0]
    for part in parts_between(connection, None, None, ends[0], ends[1] + 1):
        if use.parts is not None and part.id not in use.parts:
            continue
        for block in use.archive.blocks(part):
            if block.first_ns <= ends[1] and block.last_ns >= ends[0]:
                with use.archive.open(block, use.needs).reading() as connection_of_block:
                    rows += connection_of_block.execute(query)
    rows.sort(key=lambda row: (row.time_ns, row.batch_id))
    return rows


def count(connection: Connection, archive: Archive, selected: ResultFilter, most: int) -> int:
    """How many current results are selected; no more than `most` are counted."""
    bounded = select(results.c.batch_id).where(*selected.conditions()).limit(most).subquery()
    query = select(func.count()).select_from(bounded)
    found = int(connection.scalar(query) or 0)
    for part in parts_of(connection, ArchiveUse(archive), selected):
        if found >= most:
            return most
        found += count_of_part(archive, part, selected)
    return min(found, most)


def count_of_part(archive: Archive, part: PlacedPart, selected: ResultFilter) -> int:
    """How many batches of a part are selected."""
    start_ns, end_ns = bounds_of(selected)
    if (start_ns is None or part.first_ns >= start_ns) and (
        end_ns is None or part.last_ns < end_ns
    ):
        return part.batches
    return len(archive.current_ids(part, start_ns, end_ns))


def bounds_of(selected: ResultFilter) -> tuple[int | None, int | None]:
    """Start and end of a filter in nanoseconds; None where it is open."""
    return (
        None if selected.start is None else selected.start.tai_ns,
        None if selected.end is None else selected.end.tai_ns,
    )


class _Waiting:
    """Parts and row groups that are not read yet, the one that begins first first."""

    def __init__(self, parts: Iterable[PlacedPart], sign: int) -> None:
        self._sign = sign
        self._heap: list[tuple[int, int, PlacedPart | Block]] = []
        self._count = 0
        self.add(parts)

    @property
    def any_left(self) -> bool:
        return bool(self._heap)

    @property
    def begins(self) -> int:
        """The begin of the first, in the order of the list: no row of any comes before it."""
        return self._heap[0][0]

    def add(self, more: Iterable[PlacedPart | Block]) -> None:
        for each in more:
            begins = each.first_ns if self._sign > 0 else -each.last_ns
            self._count += 1
            heapq.heappush(self._heap, (begins, self._count, each))

    def pop(self) -> PlacedPart | Block:
        return heapq.heappop(self._heap)[2]


def parts_of(
    connection: Connection,
    use: ArchiveUse,
    selected: ResultFilter,
    newest_first: bool = False,
    beyond: Place | None = None,
    last_ns: int | None = None,
) -> list[PlacedPart]:
    """The parts that may have selected rows beyond a place and not after `last_ns`."""
    if use.parts is not None and not use.parts:
        return []
    first_ns, end_ns = bounds_of(selected)
    if last_ns is not None and newest_first:
        first_ns = last_ns if first_ns is None else max(first_ns, last_ns)
    elif last_ns is not None:
        end_ns = last_ns + 1 if end_ns is None else min(end_ns, last_ns + 1)
    found = parts_between(connection, selected.spacecraft, selected.run, first_ns, end_ns)
    return [
        each
        for each in found
        if (use.parts is None or each.id in use.parts)
        and _reaches(each, selected, newest_first, beyond)
    ]


def _reaches(
    each: PlacedPart | Block, selected: ResultFilter, newest_first: bool, beyond: Place | None
) -> bool:
    """True if it may have rows of the filter beyond a place."""
    if selected.start is not None and each.last_ns < selected.start.tai_ns:
        return False
    if selected.end is not None and each.first_ns >= selected.end.tai_ns:
        return False
    if beyond is None:
        return True
    return each.first_ns <= beyond[0] if newest_first else each.last_ns >= beyond[0]
