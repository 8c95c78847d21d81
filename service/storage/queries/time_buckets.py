"""Sums and extremes over a period, read as coarsely as requested and exact at both ends.

A bucket is a day, an hour or a part of one, with the columns of a rollup.  Whole
days and hours come from the rollups; smaller buckets, and what a period cuts
off at its ends, are summed up by the database from the batches themselves.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np
from sqlalchemy import BigInteger, Connection, Select, Table, bindparam, case, func, select

from service.storage.recording.result_metrics import OF_TRACKERS, SUMMED, SUMMED_OF_TRACKERS
from service.storage.sql.columns import Row
from service.storage.sql.tables import (
    COUNTS,
    ROLLED_UP,
    archived_parts,
    results,
    rollups_daily,
    rollups_hourly,
    tracker_rollups_daily,
    tracker_rollups_hourly,
    tracker_values,
)
from service.times import DAY_S, HOUR_S, UNIX_DAY, Utc, bucket_start, unix_seconds
from service.vectors import Matrix, Vector

Level = Literal["hour", "day"]
Columns = dict[str, Vector]
"""`unix_s`, at which each bucket begins, and columns of a rollup."""
Names = tuple[str, ...]
"""Names of columns of a rollup."""
MAX_BATCHES_SUMMED = 10_000
"""The most batches of a period of hours in one answer; a longer one is shown by the hour."""

_WIDTH_S: dict[Level, int] = {"hour": HOUR_S, "day": DAY_S}
_ROLLUPS: dict[Level, Table] = {"hour": rollups_hourly, "day": rollups_daily}
_TRACKER_ROLLUPS: dict[Level, Table] = {
    "hour": tracker_rollups_hourly,
    "day": tracker_rollups_daily,
}


@dataclass(frozen=True)
class BucketFilter:
    """A spacecraft's current results in a run, from `start` to before `end`.

    Or those of one of its trackers, if it has several.
    """

    spacecraft: str
    run: str
    start: Utc
    end: Utc
    tracker: str | None = None


def batches_about(connection: Connection, span: BucketFilter) -> int:
    """The batches of all hours that a span touches: at least as many as it holds."""
    table = rollups_hourly.c
    query = select(func.sum(table.batches)).where(
        table.spacecraft == span.spacecraft,
        table.run == span.run,
        table.bucket >= span.start.bucket(HOUR_S),
        table.bucket <= span.end.bucket(HOUR_S),
    )
    return int(connection.execute(query).scalar() or 0)


def has_archived(connection: Connection, span: BucketFilter) -> bool:
    """True if a span has archived batches, which only the rollups count."""
    c = archived_parts.c
    query = select(c.id).where(
        c.spacecraft == span.spacecraft,
        c.run == span.run,
        c.last_ns >= span.start.tai_ns,
        c.first_ns < span.end.tai_ns,
    )
    return connection.execute(query.limit(1)).first() is not None


def read_buckets(
    connection: Connection, span: BucketFilter, level: Level, names: Names = ROLLED_UP
) -> Columns:
    """The buckets of a span, in order of time; those without a batch are left out."""
    width_s = _WIDTH_S[level]
    first, last = (_at_or_after(span.start, width_s), span.end.bucket(width_s))
    if first > last:
        return _finer(connection, span, level, names)
    begin, end = bucket_start(first, width_s), bucket_start(last, width_s)
    return _joined(
        [
            _finer(connection, replace(span, end=begin), level, names),
            _whole(connection, span, level, names, first, last),
            _finer(connection, replace(span, start=end), level, names),
        ]
    )


def _finer(connection: Connection, span: BucketFilter, level: Level, names: Names) -> Columns:
    """Buckets of less than an hour or day, which the span does not fill or leave."""
    if level == "day":
        return read_buckets(connection, span, "hour", names)
    return read_steps(connection, span, HOUR_S, names)


def read_steps(
    connection: Connection, span: BucketFilter, width_s: int, names: Names = ROLLED_UP
) -> Columns:
    """Buckets of so much of a UTC day each, summed up by the database from the batches.

    The width divides a day.  However many batches there are, no more is held
    of them than a row for each bucket.
    """
    parts = [_steps_of([], span.start, width_s, names)]
    day, begin = span.start.bucket(DAY_S), span.start
    while begin.tai_ns < span.end.tai_ns:
        # Each day by itself: between two of them there may be a leap second.
        midnight, next_midnight = bucket_start(day, DAY_S), bucket_start(day + 1, DAY_S)
        end = next_midnight if next_midnight.tai_ns < span.end.tai_ns else span.end
        asked = _asked(replace(span, start=begin, end=end)) | {
            "midnight_ns": midnight.tai_ns,
            "width_ns": width_s * 10**9,
            "last": DAY_S // width_s - 1,
        }
        query = _steps_query(names, span.tracker is not None)
        rows = connection.execute(query, asked).all()
        parts.append(_steps_of(rows, midnight, width_s, names))
        day, begin = day + 1, end
    return _joined(parts)


@cache
def _steps_query(names: Names, of_tracker: bool) -> Select[Any]:
    since_ns = results.c.time_ns - bindparam("midnight_ns", type_=BigInteger)
    number = since_ns // bindparam("width_ns", type_=BigInteger)
    # A leap second is of the step that it ends, as of its hour and day.
    last = bindparam("last", type_=BigInteger)
    step = case((number > last, last), else_=number).label("step")
    summed = SUMMED_OF_TRACKERS if of_tracker else SUMMED
    query = select(step, *(summed[name] for name in names))
    if of_tracker:
        query = query.select_from(OF_TRACKERS).where(_OF_TRACKER)
    return query.where(*_IN_SPAN).group_by(step).order_by(step)


def _steps_of(rows: Sequence[Any], midnight: Utc, width_s: int, names: Names) -> Columns:
    read = _table(rows, names)
    begin_ns = midnight.tai_ns + read[0].astype(np.int64) * width_s * 10**9
    return {"unix_s": unix_seconds(begin_ns), **dict(zip(names, read[1:], strict=True))}


def _joined(parts: Sequence[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _table(rows: Sequence[Any], names: Names) -> Matrix:
    """Rows as columns, the key's first."""
    # As tuples: numpy would ask each of SQLAlchemy's rows for more than its values.
    return np.array([tuple(row) for row in rows], dtype=float).reshape(-1, 1 + len(names)).T


def totals(buckets: Columns) -> Row:
    """The counts of all buckets together."""
    return {name: int(buckets[name].sum()) for name in COUNTS}


def _at_or_after(moment: Utc, width_s: int) -> int:
    number = moment.bucket(width_s)
    return number + (bucket_start(number, width_s).tai_ns < moment.tai_ns)


@cache
def _whole_query(table: Table, names: Names) -> Select[Any]:
    """The rows of a rollup in a period; made once, for to make it takes longer than to run it."""
    columns = table.c
    query = (
        select(columns.bucket, *(columns[name] for name in names))
        .where(
            columns.spacecraft == bindparam("spacecraft"),
            columns.run == bindparam("run"),
            columns.bucket >= bindparam("first"),
            columns.bucket < bindparam("last"),
            columns.batches > 0,
        )
        .order_by(columns.bucket)
    )
    return query.where(columns.tracker == bindparam("tracker")) if "tracker" in columns else query


def _whole(
    connection: Connection, span: BucketFilter, level: Level, names: Names, first: int, last: int
) -> Columns:
    table = (_ROLLUPS if span.tracker is None else _TRACKER_ROLLUPS)[level]
    asked = _owner(span) | {"first": first, "last": last}
    read = _table(connection.execute(_whole_query(table, names), asked).all(), names)
    return {
        "unix_s": read[0] * _WIDTH_S[level] - UNIX_DAY * DAY_S,
        **dict(zip(names, read[1:], strict=True)),
    }


_IN_SPAN = (
    results.c.current,
    results.c.spacecraft == bindparam("spacecraft"),
    results.c.run == bindparam("run"),
    results.c.time_ns >= bindparam("start_ns"),
    results.c.time_ns < bindparam("end_ns"),
)


_OF_TRACKER = tracker_values.c.tracker == bindparam("tracker")


def _asked(span: BucketFilter) -> Row:
    return _owner(span) | {"start_ns": span.start.tai_ns, "end_ns": span.end.tai_ns}


def _owner(span: BucketFilter) -> Row:
    owner = {"spacecraft": span.spacecraft, "run": span.run}
    return owner if span.tracker is None else owner | {"tracker": span.tracker}
