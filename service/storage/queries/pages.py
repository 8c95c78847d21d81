"""Current results in order of their batches' time, a page at a time."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Connection, RowMapping, Select, select

from service.errors import BadBatch, Fault, shown_value
from service.storage.recording.ids import is_ulid
from service.storage.recording.unsaved_result import AHEAD_NS, LIVE
from service.storage.sql.tables import batches, results
from service.times import Utc, recorded_utc

Place = tuple[int, str]
"""The time of a batch, and its id."""

QUATERNION = ("q1", "q2", "q3", "qc")
COVARIANCE = ("p11", "p12", "p13", "p22", "p23", "p33")
"""Columns of `solutions`."""

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


def covariance_of(upper: Sequence[float]) -> list[list[float]]:
    """The covariance matrix of what its columns `COVARIANCE` hold."""
    p11, p12, p13, p22, p23, p33 = upper
    return [[p11, p12, p13], [p12, p22, p23], [p13, p23, p33]]


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


def newest_first(query: Select[Any]) -> Select[Any]:
    """The query in descending order of time."""
    return query.order_by(*(column.desc() for column in PLACE))


def latest_time(connection: Connection, selected: ResultFilter, now: Utc) -> Utc | None:
    """The time of the newest batch; None without any."""
    query = select(batches.c.time).join_from(results, batches, results.c.batch_id == batches.c.id)
    row = newest(connection, query, selected, now)
    return None if row is None else recorded_utc(row["time"])


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
