"""Sums and extremes over a period, read as coarsely as requested and exact at both ends.

A bucket is a day, an hour or a part of one, with the columns of a rollup.  Whole days and hours
come from the rollups; smaller buckets, and the parts of buckets at the ends of a period, are summed
up by the database from the batches themselves.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Literal

import numpy as np
from sqlalchemy import (
    BigInteger,
    ColumnElement,
    Connection,
    Select,
    Table,
    bindparam,
    case,
    func,
    select,
)

from service.contract.spacecraft import Rates
from service.errors import BadInput, Fault
from service.storage.recording.result_metrics import OF_TRACKERS, SUMMED, SUMMED_OF_TRACKERS
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.storage.sql.tables import results
from service.times import DAY_S, HOUR_S, UNIX_DAY, Utc, bucket_start, unix_seconds
from service.vectors import Vector

Bucket = Literal["hour", "day"]
Columns = dict[str, Vector]
"""Columns of time buckets by name: `unix_s`, at which each begins, and sums of a rollup."""
Names = tuple[str, ...]
"""Names of the summed columns of a rollup table."""
MAX_BATCHES_SUMMED = 10_000
"""Largest number of batches summed for an answer over hours; above it, rollups are read."""


MAX_RATES = 20_000
"""Largest number of buckets in an answer: two years of hours, or half a century of days."""


@dataclass(frozen=True)
class Trend:
    """Rollup tables of one bucket width: of spacecraft, and of their trackers."""

    table: Table
    tracker_table: Table
    width_s: int


TRENDS: dict[Bucket, Trend] = {
    "hour": Trend(tables.rollups_hourly, tables.tracker_rollups_hourly, HOUR_S),
    "day": Trend(tables.rollups_daily, tables.tracker_rollups_daily, DAY_S),
}


@dataclass(frozen=True)
class BucketFilter:
    """Filter for a spacecraft's current results in a run, from `start` to before `end`.

    With a tracker, its values only.
    """

    spacecraft: str
    run: str
    start: Utc
    end: Utc
    tracker: str | None = None


def batches_about(connection: Connection, span: BucketFilter) -> int:
    """Count the batches of all hours that a span overlaps: an upper bound for the span."""
    table = tables.rollups_hourly.c
    query = select(func.sum(table.batches)).where(
        table.spacecraft == span.spacecraft,
        table.run == span.run,
        table.bucket >= span.start.bucket(HOUR_S),
        table.bucket <= span.end.bucket(HOUR_S),
    )
    return int(connection.execute(query).scalar() or 0)


def read_buckets(
    connection: Connection, span: BucketFilter, level: Bucket, names: Names = tables.ROLLED_UP
) -> Columns:
    """Sums by hour or day of a span in order of time, exact at its ends; without empty buckets."""
    width_s = TRENDS[level].width_s
    first = span.start.bucket(width_s)
    first += bucket_start(first, width_s).tai_ns < span.start.tai_ns
    last = span.end.bucket(width_s)
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


def _finer(connection: Connection, span: BucketFilter, level: Bucket, names: Names) -> Columns:
    """Sums over part of a day from its hours, or over part of an hour from its batches."""
    if level == "day":
        return read_buckets(connection, span, "hour", names)
    return read_steps(connection, span, HOUR_S, names)


def read_steps(
    connection: Connection, span: BucketFilter, width_s: int, names: Names = tables.ROLLED_UP
) -> Columns:
    """Buckets of `width_s` seconds of a UTC day, summed up by the database from the batches.

    The width divides a day.  However many batches there are, only one row for each bucket is held
    in memory.
    """
    parts = [_steps_of([], span.start, width_s, names)]
    query = _steps_query(names, span.tracker is not None)
    for midnight, asked in steps_by_day(span.start, span.end, width_s):
        rows = connection.execute(query, _owner(span) | asked).all()
        parts.append(_steps_of(rows, midnight, width_s, names))
    return _joined(parts)


def steps_by_day(start: Utc, end: Utc, width_s: int) -> Iterator[tuple[Utc, Row]]:
    """Midnight of each day in a period, each with the named values for the queries of its batches.

    Each day is read by itself: between two days there may be a leap second.
    """
    day, begin_ns = start.bucket(DAY_S), start.tai_ns
    while begin_ns < end.tai_ns:
        midnight = bucket_start(day, DAY_S)
        day += 1
        end_ns = min(bucket_start(day, DAY_S).tai_ns, end.tai_ns)
        yield (
            midnight,
            {
                "start_ns": begin_ns,
                "end_ns": end_ns,
                "midnight_ns": midnight.tai_ns,
                "width_ns": width_s * 10**9,
                "last": DAY_S // width_s - 1,
            },
        )
        begin_ns = end_ns


def _step() -> ColumnElement[int]:
    since_ns = results.c.time_ns - bindparam("midnight_ns", type_=BigInteger)
    number = since_ns // bindparam("width_ns", type_=BigInteger)
    # A leap second belongs to the step that it ends, as with its hour and day.
    last = bindparam("last", type_=BigInteger)
    return case((number > last, last), else_=number).label("step")


STEP = _step()
"""SQL for the number of a result's bucket within its day."""
IN_PERIOD = (
    results.c.current,
    results.c.run == bindparam("run"),
    results.c.time_ns >= bindparam("start_ns"),
    results.c.time_ns < bindparam("end_ns"),
)
"""SQL conditions for the current results of a run in a period."""


@cache
def _steps_query(names: Names, of_tracker: bool) -> Select[Any]:
    summed = SUMMED_OF_TRACKERS if of_tracker else SUMMED
    query = select(STEP, *(summed[name] for name in names))
    if of_tracker:
        of_one = tables.tracker_values.c.tracker == bindparam("tracker")
        query = query.select_from(OF_TRACKERS).where(of_one)
    own = results.c.spacecraft == bindparam("spacecraft")
    return query.where(*IN_PERIOD, own).group_by(STEP).order_by(STEP)


def _steps_of(rows: Sequence[Any], midnight: Utc, width_s: int, names: Names) -> Columns:
    columns = _columns(rows, names)
    begin_ns = midnight.tai_ns + columns["unix_s"].astype(np.int64) * width_s * 10**9
    return columns | {"unix_s": unix_seconds(begin_ns)}


def _joined(parts: Sequence[Columns]) -> Columns:
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def _columns(rows: Sequence[Any], names: Names) -> Columns:
    """Arrays by column name from rows; the first, `unix_s`, holds the number of the bucket."""
    # Convert to tuples: numpy would ask SQLAlchemy's rows for more than their values.
    table = np.array([tuple(row) for row in rows], dtype=float).reshape(-1, 1 + len(names))
    return dict(zip(("unix_s", *names), table.T, strict=True))


def totals(buckets: Columns) -> Row:
    """Sum the counts of all buckets."""
    return {name: int(buckets[name].sum()) for name in tables.COUNTS}


@cache
def _whole_query(table: Table, names: Names) -> Select[Any]:
    """Query for the rows of a rollup in a period; cached, since building it is slow."""
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
    connection: Connection, span: BucketFilter, level: Bucket, names: Names, first: int, last: int
) -> Columns:
    trend = TRENDS[level]
    table = trend.table if span.tracker is None else trend.tracker_table
    asked = _owner(span) | {"first": first, "last": last}
    columns = _columns(connection.execute(_whole_query(table, names), asked).all(), names)
    return columns | {"unix_s": columns["unix_s"] * trend.width_s - UNIX_DAY * DAY_S}


def _owner(span: BucketFilter) -> Row:
    owner = {"spacecraft": span.spacecraft, "run": span.run}
    return owner if span.tracker is None else owner | {"tracker": span.tracker}


def buckets_between(
    bucket: ColumnElement[int], start: Utc | None, end: Utc | None, width_s: int
) -> list[ColumnElement[bool]]:
    """SQL conditions for the hours or days that a period from `start` to before `end` overlaps."""
    chosen = []
    if start is not None:
        chosen.append(bucket >= start.bucket(width_s))
    if end is not None:
        last = end.bucket(width_s)
        # A bucket that begins exactly at the end of the period lies outside it.
        last -= bucket_start(last, width_s).tai_ns == end.tai_ns
        chosen.append(bucket <= last)
    return chosen


def rates(
    connection: Connection,
    spacecraft: str,
    *,
    run: str,
    start: Utc | None,
    end: Utc | None,
    bucket: Bucket,
) -> list[Rates]:
    """Counts of stars and batches in the hours or days of a period, oldest first.

    The first bucket is that of `start`; the last begins before `end`.  Raises `BadInput` where
    there are more than `MAX_RATES`.
    """
    trend = TRENDS[bucket]
    table = trend.table
    query = select(table.c.bucket, *(table.c[name] for name in tables.COUNTS)).where(
        table.c.spacecraft == spacecraft,
        table.c.run == run,
        *buckets_between(table.c.bucket, start, end, trend.width_s),
    )
    rows = connection.execute(query.order_by(table.c.bucket).limit(MAX_RATES + 1)).all()
    if len(rows) > MAX_RATES:
        value = "nothing" if start is None else start.text
        shorter = "ask for a shorter stretch" + (", or for days" if bucket == "hour" else "")
        wrong = f"from then on more than {MAX_RATES} {bucket}s hold batches: {shorter}"
        raise BadInput(Fault("start", wrong, value))
    return [
        Rates(
            start=bucket_start(number, trend.width_s).text,
            **dict(zip(tables.COUNTS, counts, strict=True)),
        )
        for number, *counts in rows
    ]
