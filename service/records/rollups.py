"""Trends: outcomes per spacecraft, run and UTC hour or day, by the time of the batch.

They are changed in the transaction that records a result or adopts one, and so
are at every moment the sums over the results that are current.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import Connection, Table, select

from service.records.draft import Buckets, Row, counts_of
from service.records.statements import add_counts
from service.records.tables import COUNTS, batches, results, rollups_daily, rollups_hourly
from service.times import DAY_S, HOUR_S, Utc, bucket_start, parse_utc

Bucket = Literal["hour", "day"]
Changes = Iterable[tuple[Buckets, "Counter[str]"]]
Sums = dict[tuple[str, str, int], "Counter[str]"]


@dataclass(frozen=True)
class _Trend:
    table: Table
    width_s: int
    field: str


_TRENDS: dict[Bucket, _Trend] = {
    "hour": _Trend(rollups_hourly, HOUR_S, "hour"),
    "day": _Trend(rollups_daily, DAY_S, "day"),
}


def add(connection: Connection, changes: Changes) -> None:
    """Add counts, which may be negative, to the hours and days that they belong to."""
    listed = list(changes)
    for trend in _TRENDS.values():
        sums: Sums = defaultdict(Counter)
        for buckets, counts in listed:
            sums[buckets.spacecraft, buckets.run, getattr(buckets, trend.field)].update(counts)
        if sums:
            add_counts(connection, trend.table, list(_rows(sums)))


def _rows(sums: Sums) -> Iterator[Row]:
    # In one order everywhere, so that two writers wait for each other but never cross.
    for (spacecraft, run, bucket), counts in sorted(sums.items()):
        key = {"spacecraft": spacecraft, "run": run, "bucket": bucket}
        yield key | {name: counts[name] for name in COUNTS}


def rates(
    connection: Connection,
    spacecraft: str,
    *,
    run: str,
    start: Utc | None,
    end: Utc | None,
    bucket: Bucket,
) -> list[Row]:
    """The buckets that begin at or after `start`'s own and before `end`, oldest first."""
    trend = _TRENDS[bucket]
    table = trend.table
    query = select(table.c.bucket, *(table.c[name] for name in COUNTS)).where(
        table.c.spacecraft == spacecraft, table.c.run == run
    )
    if start is not None:
        query = query.where(table.c.bucket >= start.bucket(trend.width_s))
    if end is not None:
        last = end.bucket(trend.width_s)
        # A bucket that begins just where the range ends lies outside it.
        last -= bucket_start(last, trend.width_s).tai_ns == end.tai_ns
        query = query.where(table.c.bucket <= last)
    rows = connection.execute(query.order_by(table.c.bucket)).mappings()
    return [
        {"start": bucket_start(row["bucket"], trend.width_s).text}
        | {name: row[name] for name in COUNTS}
        for row in rows
    ]


def stored(connection: Connection, bucket: Bucket) -> Sums:
    """The trends as they are kept, buckets without a batch left out."""
    table = _TRENDS[bucket].table
    return {
        (row["spacecraft"], row["run"], row["bucket"]): Counter({n: row[n] for n in COUNTS})
        for row in connection.execute(select(table)).mappings()
    }


def recount(connection: Connection, bucket: Bucket) -> Sums:
    """The trends counted anew from the current results: what `stored` must equal."""
    width_s = _TRENDS[bucket].width_s
    sums: Sums = defaultdict(Counter)
    query = select(results, batches.c.time).join_from(results, batches).where(results.c.current)
    for row in connection.execute(query).mappings():
        number = parse_utc(row["time"]).bucket(width_s)
        sums[row["spacecraft"], row["run"], number].update(counts_of(dict(row)))
    return dict(sums)
