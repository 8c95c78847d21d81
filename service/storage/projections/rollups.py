"""Trends: sums and extremes per spacecraft, run and UTC hour or day, by the time of the batch.

Of spacecraft with several trackers also per tracker.

They always equal a count of the current results whose `seq` is at most the position of the
projector.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from sqlalchemy import ColumnElement, Connection, Select, Table, and_, delete, func, insert, select

from service.errors import BadInput, Fault
from service.storage.projections.recorded import RecordedResult
from service.storage.recording.result_metrics import (
    OF_TRACKERS,
    SUMMED,
    SUMMED_OF_TRACKERS,
    merge,
    rolled_up,
)
from service.storage.sql.columns import Row
from service.storage.sql.statements import add_rollups, insert_all
from service.storage.sql.tables import (
    COUNTS,
    MAXIMA,
    MINIMA,
    SUMS,
    archived_hours,
    batches,
    projector,
    results,
    rollups_daily,
    rollups_hourly,
    tracker_rollups_daily,
    tracker_rollups_hourly,
    tracker_values,
)
from service.times import DAY_S, HOUR_S, Utc, bucket_start, parse_utc, recorded_utc

Bucket = Literal["hour", "day"]
BucketKey = tuple[str, str, int]
"""(spacecraft, run, bucket)."""
TrackerKey = tuple[str, str, str, int]
"""(spacecraft, run, tracker, bucket)."""
Rollups = dict[Any, Row]
"""Rows by `BucketKey`, or by `TrackerKey`."""
_KEY = ("spacecraft", "run", "bucket")
_TRACKER_KEY = ("spacecraft", "run", "tracker", "bucket")
ROWS_AT_ONCE = 500
"""Rows of results, with their answers, that a recount holds."""
MAX_RATES = 20_000
"""The most buckets of one answer: two years of hours, or half a century of days."""


@dataclass(frozen=True)
class _Trend:
    table: Table
    tracker_table: Table
    width_s: int


_TRENDS: dict[Bucket, _Trend] = {
    "hour": _Trend(rollups_hourly, tracker_rollups_hourly, HOUR_S),
    "day": _Trend(rollups_daily, tracker_rollups_daily, DAY_S),
}


def apply(connection: Connection, new: Sequence[RecordedResult]) -> None:
    """Add new batches to their hours and days, and count anew the hours of adopted what-ifs.

    A batch whose first result is superseded already comes with the what-if that is current.
    """
    current = [each for each in new if each.result["current"]]
    firsts = [each for each in current if each.is_first]
    add(connection, ((each.hour, each.result) for each in firsts))
    add_trackers(connection, ((each.hour, row) for each in firsts for row in each.trackers))
    renew(connection, [each.hour for each in current if not each.is_first])


def add(connection: Connection, new: Iterable[tuple[BucketKey, Row]]) -> None:
    """Add current results, each with its spacecraft, run and hour, to their hours and days."""
    of_hour: dict[BucketKey, list[Row]] = {}
    for key, result in new:
        of_hour.setdefault(key, []).append(result)
    _add(connection, of_hour, (rollups_hourly, rollups_daily), _KEY)


def add_trackers(connection: Connection, new: Iterable[tuple[BucketKey, Row]]) -> None:
    """Add rows of `tracker_values` to the hours and days of their trackers."""
    of_hour: dict[TrackerKey, list[Row]] = {}
    for (spacecraft, run, hour), row in new:
        of_hour.setdefault((spacecraft, run, row["tracker"], hour), []).append(row)
    _add(connection, of_hour, (tracker_rollups_hourly, tracker_rollups_daily), _TRACKER_KEY)


def add_shares(
    connection: Connection, spacecraft: str, run: str, of_hour: Mapping[int, Mapping[str, Row]]
) -> None:
    """Add rollups that are there already, by hour and by tracker; `WHOLE` is the spacecraft's."""
    lock_position(connection)
    whole: Rollups = {}
    of_trackers: Rollups = {}
    for hour, shares in of_hour.items():
        for tracker, share in shares.items():
            if tracker == WHOLE:
                whole[spacecraft, run, hour] = share
            else:
                of_trackers[spacecraft, run, tracker, hour] = share
    _add_hours(connection, whole, (rollups_hourly, rollups_daily), _KEY)
    tables = tracker_rollups_hourly, tracker_rollups_daily
    _add_hours(connection, of_trackers, tables, _TRACKER_KEY)


def lock_position(connection: Connection) -> int:
    """Lock the projector's place in the record, and with it all rollups; returns the place.

    Every change of a rollup begins with this.
    """
    query = select(projector.c.seq).with_for_update()
    return int(connection.execute(query).scalar_one())


def _add(
    connection: Connection,
    of_hour: Mapping[Any, list[Row]],
    tables: tuple[Table, Table],
    names: tuple[str, ...],
) -> None:
    _add_hours(connection, {key: rolled_up(found) for key, found in of_hour.items()}, tables, names)


def _add_hours(
    connection: Connection, hourly: Rollups, tables: tuple[Table, Table], names: tuple[str, ...]
) -> None:
    daily: Rollups = {}
    for (*owner, hour), row in hourly.items():
        _put(daily, (*owner, hour // 24), row)
    for table, found in zip(tables, (hourly, daily), strict=True):
        rows = [dict(zip(names, key, strict=True)) | row for key, row in found.items()]
        add_rollups(connection, table, rows)


def renew(connection: Connection, hours: Iterable[BucketKey]) -> None:
    """Count hours anew in which a current result was replaced or taken out, and their days.

    An extreme that is gone cannot be subtracted.  The projector's place in the record is
    locked before anything is read: what comes after it will be added, and is not counted here.
    Where nothing is left of an hour or a day, its row goes too.
    """
    changed = sorted(set(hours))
    if not changed:
        return
    lock_position(connection)
    for key in changed:
        _put_back(connection, rollups_hourly, key, _of_hour(connection, key))
    for spacecraft, run, day in sorted({(key[0], key[1], key[2] // 24) for key in changed}):
        row = _of_day(connection, (spacecraft, run, day))
        _put_back(connection, rollups_daily, (spacecraft, run, day), row)
    _renew_trackers(connection, changed)


def _renew_trackers(connection: Connection, changed: Iterable[BucketKey]) -> None:
    """Count the same hours and days anew for each tracker; those of the spacecraft are locked."""
    tracker = tracker_values.c.tracker
    for key in changed:
        query = select(tracker, *SUMMED_OF_TRACKERS.values()).select_from(OF_TRACKERS)
        found = connection.execute(_within_hour(query, key).group_by(tracker)).mappings()
        of_hour: Rollups = {row["tracker"]: dict(row) for row in found}
        for name, share in shares_of_hour(connection, *key).items():
            if name != WHOLE:
                _put(of_hour, name, share)
        _replace(connection, tracker_rollups_hourly, key, of_hour)
    for spacecraft, run, day in sorted({(key[0], key[1], key[2] // 24) for key in changed}):
        hours = _hours_of_day(connection, tracker_rollups_hourly, (spacecraft, run, day))
        of_day: Rollups = {}
        for row in hours:
            _put(of_day, row["tracker"], row)
        _replace(connection, tracker_rollups_daily, (spacecraft, run, day), of_day)


def _replace(
    connection: Connection,
    table: Table,
    key: BucketKey,
    of_tracker: Mapping[str, Mapping[str, Any]],
) -> None:
    """Replace the rows of all trackers of an hour or a day."""
    connection.execute(delete(table).where(_place(table, key)))
    own = dict(zip(_KEY, key, strict=True))
    rows = [dict(row) | own | {"tracker": tracker} for tracker, row in sorted(of_tracker.items())]
    insert_all(connection, table, rows)


def _of_hour(connection: Connection, key: BucketKey) -> Row | None:
    """The rollup of the current results of an hour, archived ones included."""
    query = _within_hour(select(*SUMMED.values()), key)
    row = dict(connection.execute(query).mappings().one())
    archived = shares_of_hour(connection, *key).get(WHOLE)
    if archived is not None:
        merge(row, archived)
    return row if row["batches"] else None


def _within_hour(query: Select[Any], key: BucketKey) -> Select[Any]:
    """The query over the current results of an hour."""
    spacecraft, run, hour = key
    return query.where(
        results.c.current,
        results.c.seq <= select(projector.c.seq).scalar_subquery(),
        results.c.spacecraft == spacecraft,
        results.c.run == run,
        results.c.time_ns >= bucket_start(hour, HOUR_S).tai_ns,
        results.c.time_ns < bucket_start(hour + 1, HOUR_S).tai_ns,
    )


def _of_day(connection: Connection, key: BucketKey) -> Row | None:
    """The rollup of the hours of a day."""
    found: Rollups = {}
    for row in _hours_of_day(connection, rollups_hourly, key):
        _put(found, key, {name: row[name] for name in row if name not in _KEY})
    return found.get(key)


def _hours_of_day(connection: Connection, table: Table, key: BucketKey) -> list[Row]:
    """The rows of a rollup by hour that belong to a day, in order of time."""
    spacecraft, run, day = key
    query = select(table).where(
        table.c.spacecraft == spacecraft,
        table.c.run == run,
        table.c.bucket >= 24 * day,
        table.c.bucket < 24 * (day + 1),
    )
    return [dict(row) for row in connection.execute(query.order_by(table.c.bucket)).mappings()]


def _put_back(connection: Connection, table: Table, key: BucketKey, row: Row | None) -> None:
    # The row may be missing: that of a first result that was superseded at once.
    connection.execute(delete(table).where(_place(table, key)))
    if row is not None:
        insert_all(connection, table, [row | dict(zip(_KEY, key, strict=True))])


def _put(found: Rollups, key: Any, row: Row) -> None:
    if key in found:
        merge(found[key], row)
    else:
        # A copy: merging changes it in place.
        found[key] = dict(row)


def _place(table: Table, key: BucketKey) -> ColumnElement[bool]:
    spacecraft, run, number = key
    return and_(table.c.spacecraft == spacecraft, table.c.run == run, table.c.bucket == number)


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
        value = "nothing" if start is None else start.text
        shorter = "ask for a shorter stretch" + (", or for days" if bucket == "hour" else "")
        wrong = f"from then on more than {MAX_RATES} {bucket}s hold batches: {shorter}"
        raise BadInput(Fault("start", wrong, value))
    return [
        {
            "start": bucket_start(number, trend.width_s).text,
            **dict(zip(COUNTS, counts, strict=True)),
        }
        for number, *counts in rows
    ]


def stored(connection: Connection, bucket: Bucket, *, of_trackers: bool = False) -> Rollups:
    """The trends as they are kept: of spacecraft, or of their trackers."""
    trend = _TRENDS[bucket]
    table, names = (trend.tracker_table, _TRACKER_KEY) if of_trackers else (trend.table, _KEY)
    return {
        tuple(row[name] for name in names): {name: row[name] for name in row if name not in names}
        for row in connection.execute(select(table)).mappings()
    }


def recount(connection: Connection, bucket: Bucket, *, of_trackers: bool = False) -> Rollups:
    """The trends counted anew from the current results: what `stored` must equal.

    Of archived batches, from what was kept of them when they were archived.
    """
    place = results.c.spacecraft, results.c.run, batches.c.time
    query = select(results, batches.c.time).join_from(
        results, batches, results.c.batch_id == batches.c.id
    )
    if of_trackers:
        source = OF_TRACKERS.join(batches, batches.c.id == results.c.batch_id)
        query = select(tracker_values, *place).select_from(source)
    width_s = _TRENDS[bucket].width_s
    found: Rollups = {}
    # PostgreSQL's client would hold all rows at once.
    read = connection.execute(
        query.where(results.c.current), execution_options={"yield_per": ROWS_AT_ONCE}
    )
    for row in read.mappings():
        tracker = (row["tracker"],) if of_trackers else ()
        number = parse_utc(row["time"]).bucket(width_s)
        key = row["spacecraft"], row["run"], *tracker, number
        _put(found, key, rolled_up([dict(row)]))
    for spacecraft, run, name, hour, share in every_share(connection):
        if (name != WHOLE) == of_trackers:
            owner = (spacecraft, run, name) if of_trackers else (spacecraft, run)
            _put(found, (*owner, hour * HOUR_S // width_s), share)
    return found


def hours_of_all(connection: Connection) -> set[BucketKey]:
    """Every hour with batches, recorded or archived, and every hour that has a trend."""
    hour = func.substr(batches.c.time, 1, len("2026-11-27T12"))
    columns = batches.c.spacecraft, batches.c.run
    query = select(*columns, func.min(batches.c.time)).group_by(*columns, hour)
    found = {
        (spacecraft, run, recorded_utc(time).bucket(HOUR_S))
        for spacecraft, run, time in connection.execute(query)
    }
    for table in (rollups_hourly, archived_hours):
        query = select(*(table.c[name] for name in _KEY)).distinct()
        found.update((row[0], row[1], row[2]) for row in connection.execute(query))
    return found


def waiting(connection: Connection, bucket: Bucket) -> set[BucketKey]:
    """The hours or days of results that the projector has not come to."""
    query = select(results.c.spacecraft, results.c.run, batches.c.time).join_from(
        results, batches, results.c.batch_id == batches.c.id
    )
    query = query.where(results.c.seq > select(projector.c.seq).scalar_subquery())
    width_s = _TRENDS[bucket].width_s
    return {
        (spacecraft, run, parse_utc(time).bucket(width_s))
        for spacecraft, run, time in connection.execute(query)
    }


# The share of archived batches in the trends, hour by hour.
#
# A trend holds recorded and archived batches alike.  Where an hour is counted anew from the
# recorded ones, the share that is kept here is added.

WHOLE = ""
"""The tracker that stands for the spacecraft as a whole."""
_NOTHING: Row = dict.fromkeys((*COUNTS, *SUMS), 0) | dict.fromkeys((*MINIMA, *MAXIMA))


def keep_share(
    connection: Connection,
    part_id: int,
    spacecraft: str,
    run: str,
    of_hour: Mapping[int, Sequence[str]],
) -> None:
    """Note what the current results of recorded batches add to each hour.

    `of_hour` has the ids of the batches by the number of their hour.
    """
    found: dict[int, dict[str, Row]] = {}
    for hour, batch_ids in of_hour.items():
        chosen = results.c.current, results.c.batch_id.in_(batch_ids)
        whole = connection.execute(select(*SUMMED.values()).where(*chosen)).mappings().one()
        of_trackers = (
            select(tracker_values.c.tracker, *SUMMED_OF_TRACKERS.values())
            .select_from(OF_TRACKERS)
            .where(*chosen)
            .group_by(tracker_values.c.tracker)
        )
        found[hour] = {WHOLE: dict(whole)}
        for row in connection.execute(of_trackers).mappings():
            share = dict(row)
            found[hour][share.pop("tracker")] = share
    insert_share(connection, part_id, spacecraft, run, found)


def insert_share(
    connection: Connection,
    part_id: int,
    spacecraft: str,
    run: str,
    of_hour: Mapping[int, Mapping[str, Row]],
) -> None:
    """Note the share of a part in each hour, by tracker and for the `WHOLE`."""
    own = {"spacecraft": spacecraft, "run": run, "part_id": part_id}
    rows = [
        own | {"bucket": hour, "tracker": tracker, "sums": json.dumps(share)}
        for hour, shares in of_hour.items()
        for tracker, share in shares.items()
    ]
    if rows:
        connection.execute(insert(archived_hours), rows)


def forget_share(connection: Connection, part_id: int, spacecraft: str, run: str) -> None:
    """Delete the share of a part whose batches are recorded again."""
    c = archived_hours.c
    own = c.spacecraft == spacecraft, c.run == run, c.part_id == part_id
    connection.execute(delete(archived_hours).where(*own))


def shares_of_hour(connection: Connection, spacecraft: str, run: str, hour: int) -> dict[str, Row]:
    """The share of all archived batches of an hour, by tracker and for the `WHOLE`."""
    c = archived_hours.c
    query = select(c.tracker, c.sums).where(
        c.spacecraft == spacecraft, c.run == run, c.bucket == hour
    )
    found: dict[str, Row] = {}
    for tracker, sums in connection.execute(query):
        merge(found.setdefault(tracker, dict(_NOTHING)), _NOTHING | json.loads(sums))
    return found


def every_share(connection: Connection) -> Iterator[tuple[str, str, str, int, Row]]:
    """Every share as (spacecraft, run, tracker, hour, columns)."""
    c = archived_hours.c
    query = select(c.spacecraft, c.run, c.tracker, c.bucket, c.sums)
    for spacecraft, run, tracker, hour, sums in connection.execute(query):
        yield spacecraft, run, tracker, hour, _NOTHING | json.loads(sums)
