"""Trends: sums and extremes per spacecraft, run and UTC hour or day, by the time of the batch.

They are changed in the transaction that records a result or adopts one, and so
are at every moment what a count of the current results would give.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from sqlalchemy import ColumnElement, Connection, Table, and_, delete, select, update

from service.errors import BadInput, Fault
from service.storage.recording.result_metrics import merge, rolled_up
from service.storage.recording.rollup_sql import SUMMED
from service.storage.recording.unsaved_result import Buckets, Row
from service.storage.sql.rollup_tables import COUNTS, rollups_daily, rollups_hourly
from service.storage.sql.statements import add_rollups
from service.storage.sql.tables import batches, results
from service.times import DAY_S, HOUR_S, Utc, bucket_start, parse_utc

Bucket = Literal["hour", "day"]
Key = tuple[str, str, int]
"""(spacecraft, run, bucket)."""
Rollups = dict[Key, Row]
_KEY = ("spacecraft", "run", "bucket")
MAX_RATES = 20_000
"""Of one answer: two years of hours, or half a century of days."""


@dataclass(frozen=True)
class _Trend:
    table: Table
    width_s: int


_TRENDS: dict[Bucket, _Trend] = {
    "hour": _Trend(rollups_hourly, HOUR_S),
    "day": _Trend(rollups_daily, DAY_S),
}


def add(connection: Connection, new: Iterable[tuple[Buckets, Row]]) -> None:
    """Add new current results, rows of theirs, to the hours and days that they belong to."""
    of_hour: dict[Key, list[Row]] = {}
    for buckets, result in new:
        of_hour.setdefault((buckets.spacecraft, buckets.run, buckets.hour), []).append(result)
    hourly = {key: rolled_up(found) for key, found in of_hour.items()}
    daily: Rollups = {}
    for (spacecraft, run, hour), row in hourly.items():
        _put(daily, (spacecraft, run, hour // 24), row)
    for table, found in ((rollups_hourly, hourly), (rollups_daily, daily)):
        # In one order everywhere, so that two writers wait for each other but never cross.
        add_rollups(connection, table, [_keyed(key, found[key]) for key in sorted(found)])


def renew(connection: Connection, hours: Iterable[Key]) -> None:
    """Count hours anew in which a current result was replaced or taken out, and their days.

    An extreme that is gone cannot be subtracted.  A row is locked before what it
    is made of is read: what another process adds is then either in both or comes
    after.  Where nothing is left of an hour or a day, its row goes too.
    """
    # Hours before days, and each in order: as `add` does it.
    changed = sorted(set(hours))
    for key in changed:
        _put_back(connection, rollups_hourly, key, _of_hour(connection, key))
    for spacecraft, run, day in sorted({(key[0], key[1], key[2] // 24) for key in changed}):
        row = _of_day(connection, (spacecraft, run, day))
        _put_back(connection, rollups_daily, (spacecraft, run, day), row)


def _of_hour(connection: Connection, key: Key) -> Row | None:
    """What the current results of an hour come to."""
    _lock(connection, rollups_hourly, key)
    spacecraft, run, hour = key
    query = select(*SUMMED.values()).where(
        results.c.current,
        results.c.spacecraft == spacecraft,
        results.c.run == run,
        results.c.time_ns >= bucket_start(hour, HOUR_S).tai_ns,
        results.c.time_ns < bucket_start(hour + 1, HOUR_S).tai_ns,
    )
    row = dict(connection.execute(query).mappings().one())
    return row if row["batches"] else None


def _of_day(connection: Connection, key: Key) -> Row | None:
    """What the hours of a day come to."""
    _lock(connection, rollups_daily, key)
    spacecraft, run, day = key
    query = select(rollups_hourly).where(
        rollups_hourly.c.spacecraft == spacecraft,
        rollups_hourly.c.run == run,
        rollups_hourly.c.bucket >= 24 * day,
        rollups_hourly.c.bucket < 24 * (day + 1),
    )
    found: Rollups = {}
    for row in connection.execute(query.order_by(rollups_hourly.c.bucket)).mappings():
        _put(found, key, {name: row[name] for name in row if name not in _KEY})
    return found.get(key)


def _lock(connection: Connection, table: Table, key: Key) -> None:
    connection.execute(select(table.c.bucket).where(_place(table, key)).with_for_update())


def _put_back(connection: Connection, table: Table, key: Key, row: Row | None) -> None:
    place = _place(table, key)
    connection.execute(
        delete(table).where(place) if row is None else update(table).where(place).values(row)
    )


def _put(found: Rollups, key: Key, row: Row) -> None:
    if key in found:
        merge(found[key], row)
    else:
        # A copy: what is merged into it belongs to nobody else.
        found[key] = dict(row)


def _place(table: Table, key: Key) -> ColumnElement[bool]:
    spacecraft, run, number = key
    return and_(table.c.spacecraft == spacecraft, table.c.run == run, table.c.bucket == number)


def _keyed(key: Key, row: Row) -> Row:
    return {"spacecraft": key[0], "run": key[1], "bucket": key[2], **row}


def rates(
    connection: Connection,
    spacecraft: str,
    *,
    run: str,
    start: Utc | None,
    end: Utc | None,
    bucket: Bucket,
) -> list[Row]:
    """The buckets that begin at or after `start`'s own and before `end`, oldest first.

    Raises `BadInput` where there are more than `MAX_RATES`.
    """
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
    rows = connection.execute(query.order_by(table.c.bucket).limit(MAX_RATES + 1)).all()
    if len(rows) > MAX_RATES:
        given = "nothing" if start is None else start.text
        shorter = "ask for a shorter stretch" + (", or for days" if bucket == "hour" else "")
        wrong = f"from then on more than {MAX_RATES} {bucket}s hold batches: {shorter}"
        raise BadInput(Fault("start", wrong, given))
    return [
        {
            "start": bucket_start(number, trend.width_s).text,
            **dict(zip(COUNTS, counts, strict=True)),
        }
        for number, *counts in rows
    ]


def stored(connection: Connection, bucket: Bucket) -> Rollups:
    """The trends as they are kept."""
    return {
        (row["spacecraft"], row["run"], row["bucket"]): {
            name: row[name] for name in row if name not in _KEY
        }
        for row in connection.execute(select(_TRENDS[bucket].table)).mappings()
    }


def recount(connection: Connection, bucket: Bucket) -> Rollups:
    """The trends counted anew from the current results: what `stored` must equal."""
    width_s = _TRENDS[bucket].width_s
    found: Rollups = {}
    query = select(results, batches.c.time).join_from(results, batches).where(results.c.current)
    for row in connection.execute(query).mappings():
        key = row["spacecraft"], row["run"], parse_utc(row["time"]).bucket(width_s)
        _put(found, key, rolled_up([dict(row)]))
    return found
