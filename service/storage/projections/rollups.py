"""Trends: sums and extremes per spacecraft, run and UTC hour or day, by the time of the batch.

Spacecraft with several trackers have them per tracker as well.

They always equal a count of the current results whose `seq` is at most the position of the
projector, which passes new results in the order of the record.
"""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

from msgspec import Struct
from sqlalchemy import (
    ColumnElement,
    Connection,
    bindparam,
    delete,
    func,
    insert,
    literal_column,
    select,
)

from service.observations.schema import LIVE
from service.storage.queries.time_buckets import TRENDS, Bucket, Trend
from service.storage.recording import result_metrics
from service.storage.recording.unsaved_result import AHEAD_NS
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.storage.sql.statements import add_rollups, insert_all, prepared
from service.storage.sql.tables import (
    COUNTED,
    COUNTS,
    MEASURED,
    batches,
    projector,
    results,
    tracker_values,
)
from service.times import HOUR_S, bucket_start, parse_utc, recorded_utc

_TAKEN = (
    *("id", "batch_id", "current", "seq", "spacecraft", "run", "time_ns", "mission_digest"),
    *COUNTED,
    *("status", "reason", *MEASURED, "answer"),
)
_AFTER = prepared(
    select(
        *(results.c[name] for name in _TAKEN),
        *(batches.c.batch, batches.c.time, batches.c.received),
    )
    .join_from(results, batches, results.c.batch_id == batches.c.id)
    .where(results.c.seq > bindparam("position"))
    .order_by(results.c.seq)
    .limit(bindparam("count"))
    .offset(literal_column("0"))
)
_TRACKERS = prepared(
    select(tracker_values)
    .join_from(tracker_values, results, tracker_values.c.batch_id == results.c.id)
    .where(results.c.seq > bindparam("position"), results.c.seq <= bindparam("last"))
)


class RecordedResult(Struct, eq=False, dict=True):
    """Rows of a recorded result and its batch, and those of its trackers if there are several."""

    result: Row
    """Columns of `results`, with the batch's name, time and moment of receipt."""
    trackers: Sequence[Row] = ()

    @property
    def seq(self) -> int:
        """Place of the result in the record."""
        return int(self.result["seq"])

    @property
    def is_first(self) -> bool:
        """True for the first result of a batch, False for a what-if."""
        return bool(self.result["id"] == self.result["batch_id"])

    @property
    def owner(self) -> tuple[str, str]:
        """Run and spacecraft to which the result belongs."""
        return self.result["run"], self.result["spacecraft"]

    @property
    def hour(self) -> tuple[str, str, int]:
        """Hour of the batch: (spacecraft, run, number of the UTC hour)."""
        row = self.result
        return row["spacecraft"], row["run"], recorded_utc(row["time"]).bucket(HOUR_S)

    @cached_property
    def received_ns(self) -> int:
        """Time of the batch's receipt, as `Utc.tai_ns`."""
        return recorded_utc(self.result["received"]).tai_ns

    @property
    def is_ahead(self) -> bool:
        """True for a live batch dated too far in the future for its time to be trusted."""
        row = self.result
        return bool(row["run"] == LIVE and row["time_ns"] > self.received_ns + AHEAD_NS)


def recorded_after(connection: Connection, position: int, count: int) -> list[RecordedResult]:
    """Results after a place in the record, in order, at most `count`."""
    rows = _AFTER.read(connection, {"position": position, "count": count})
    if not rows:
        return []
    trackers: dict[str, list[Row]] = {}
    for row in _TRACKERS.read(connection, {"position": position, "last": rows[-1]["seq"]}):
        trackers.setdefault(row["batch_id"], []).append(row)
    return [RecordedResult(row, trackers.get(row["id"], ())) for row in rows]


BucketKey = tuple[str, str, int]
"""Key of a rollup: (spacecraft, run, bucket)."""
Rollups = dict[Any, Row]
"""Rollup rows by (spacecraft, run, tracker, bucket), or by a part of it."""
WHOLE = ""
"""Tracker name that stands for the spacecraft as a whole."""
_KEY = ("spacecraft", "run", "bucket")
_TRACKER_KEY = ("spacecraft", "run", "tracker", "bucket")
_NOTHING: Row = dict.fromkeys((*COUNTS, *tables.SUMS), 0) | dict.fromkeys(
    (*tables.MINIMA, *tables.MAXIMA)
)
ROWS_AT_ONCE = 500
"""Number of result rows, with their answers, that a recount holds in memory."""


def apply(connection: Connection, new: Sequence[RecordedResult]) -> None:
    """Add new batches to the trends of their hours and days; recount the hours of adopted what-ifs.

    A batch whose first result is superseded already comes with the what-if that is current.
    """
    current = [each for each in new if each.result["current"]]
    firsts = [each for each in current if each.is_first]
    add(connection, ((each.hour, row) for each in firsts for row in (each.result, *each.trackers)))
    renew(connection, [each.hour for each in current if not each.is_first])


def add(connection: Connection, new: Iterable[tuple[BucketKey, Row]]) -> None:
    """Add current results, or rows of `tracker_values`, to the trends of their hours and days.

    Each row comes with its spacecraft, run and hour.
    """
    of_hour: dict[tuple[str, str, str, int], list[Row]] = {}
    for (spacecraft, run, hour), row in new:
        of_hour.setdefault((spacecraft, run, row.get("tracker", WHOLE), hour), []).append(row)
    _add_hours(connection, {key: result_metrics.rolled_up(rows) for key, rows in of_hour.items()})


def add_shares(
    connection: Connection, spacecraft: str, run: str, of_hour: Mapping[int, Mapping[str, Row]]
) -> None:
    """Add existing rollups to the trends, by hour and tracker; `WHOLE` is the spacecraft itself."""
    lock_position(connection)
    hourly: Rollups = {
        (spacecraft, run, tracker, hour): share
        for hour, shares in of_hour.items()
        for tracker, share in shares.items()
    }
    _add_hours(connection, hourly)


def lock_position(connection: Connection) -> int:
    """Lock the projector's place in the record, and thereby all rollups; returns the place.

    Every change of a rollup begins here.
    """
    query = select(projector.c.seq).with_for_update()
    return int(connection.execute(query).scalar_one())


def _add_hours(connection: Connection, hourly: Rollups) -> None:
    daily: Rollups = {}
    for (*owner, hour), row in hourly.items():
        _put(daily, (*owner, hour // 24), row)
    for trend, rollups in zip(TRENDS.values(), (hourly, daily), strict=True):
        rows = [dict(zip(_TRACKER_KEY, key, strict=True)) | row for key, row in rollups.items()]
        add_rollups(connection, trend.table, [row for row in rows if row["tracker"] == WHOLE])
        of_trackers = [row for row in rows if row["tracker"] != WHOLE]
        add_rollups(connection, trend.tracker_table, of_trackers)


def renew(connection: Connection, hours: Iterable[BucketKey]) -> None:
    """Recount the trends of hours, and their days, in which a current result changed or went.

    A deleted extreme cannot be subtracted.  The projector's place in the record is locked before
    anything is read: results after it are added later, and not counted here.  An hour or a day
    without results loses its row.
    """
    changed = sorted(set(hours))
    if not changed:
        return
    lock_position(connection)
    for key in changed:
        _replace(connection, TRENDS["hour"], key, _of_hour(connection, key))
    for spacecraft, run, day in sorted({(key[0], key[1], key[2] // 24) for key in changed}):
        of_day = _of_day(connection, spacecraft, run, day)
        _replace(connection, TRENDS["day"], (spacecraft, run, day), of_day)


def _replace(connection: Connection, trend: Trend, key: BucketKey, of_tracker: Rollups) -> None:
    """Replace the trend rows of a spacecraft and its trackers in one hour or day."""
    own = dict(zip(_KEY, key, strict=True))
    for table, is_whole in ((trend.table, True), (trend.tracker_table, False)):
        connection.execute(delete(table).where(*(table.c[name] == own[name] for name in own)))
        rows = [
            row | own | {"tracker": tracker}
            for tracker, row in sorted(of_tracker.items())
            if (tracker == WHOLE) == is_whole and row["batches"]
        ]
        insert_all(connection, table, rows)


def _of_hour(connection: Connection, key: BucketKey) -> Rollups:
    """Rollups of the current results of an hour by tracker, archived ones included."""
    spacecraft, run, hour = key
    of_tracker = _summed(
        connection,
        results.c.current,
        results.c.seq <= select(projector.c.seq).scalar_subquery(),
        results.c.spacecraft == spacecraft,
        results.c.run == run,
        results.c.time_ns >= bucket_start(hour, HOUR_S).tai_ns,
        results.c.time_ns < bucket_start(hour + 1, HOUR_S).tai_ns,
    )
    for tracker, share in shares_of_hour(connection, *key).items():
        _put(of_tracker, tracker, share)
    return of_tracker


def _summed(connection: Connection, *chosen: ColumnElement[bool]) -> Rollups:
    """Rollups of the chosen results by tracker, with that of the `WHOLE` first."""
    whole = (
        connection.execute(select(*result_metrics.SUMMED.values()).where(*chosen)).mappings().one()
    )
    tracker = tracker_values.c.tracker
    query = select(tracker, *result_metrics.SUMMED_OF_TRACKERS.values()).select_from(
        result_metrics.OF_TRACKERS
    )
    of_tracker: Rollups = {WHOLE: dict(whole)}
    for found in connection.execute(query.where(*chosen).group_by(tracker)).mappings():
        row = dict(found)
        of_tracker[row.pop("tracker")] = row
    return of_tracker


def _of_day(connection: Connection, spacecraft: str, run: str, day: int) -> Rollups:
    """Rollups of a day by tracker, merged from those of its hours."""
    of_tracker: Rollups = {}
    for table in (tables.rollups_hourly, tables.tracker_rollups_hourly):
        query = select(table).where(
            table.c.spacecraft == spacecraft,
            table.c.run == run,
            table.c.bucket >= 24 * day,
            table.c.bucket < 24 * (day + 1),
        )
        for row in connection.execute(query.order_by(table.c.bucket)).mappings():
            hour = {name: row[name] for name in tables.ROLLED_UP}
            _put(of_tracker, row.get("tracker", WHOLE), hour)
    return of_tracker


def _put(found: Rollups, key: Any, row: Row) -> None:
    if key in found:
        result_metrics.merge(found[key], row)
    else:
        # A copy, since merging changes rows in place.
        found[key] = dict(row)


def stored(connection: Connection, bucket: Bucket, *, of_trackers: bool = False) -> Rollups:
    """Stored trends by hour or by day, of all spacecraft or of their trackers."""
    trend = TRENDS[bucket]
    table, names = (trend.tracker_table, _TRACKER_KEY) if of_trackers else (trend.table, _KEY)
    return {
        tuple(row[name] for name in names): {name: row[name] for name in row if name not in names}
        for row in connection.execute(select(table)).mappings()
    }


def recount(connection: Connection, bucket: Bucket, *, of_trackers: bool = False) -> Rollups:
    """Trends counted from the current results, which `stored` must equal.

    Archived batches count by the share kept when they were archived.
    """
    place = results.c.spacecraft, results.c.run, batches.c.time
    query = select(results, batches.c.time).join_from(
        results, batches, results.c.batch_id == batches.c.id
    )
    if of_trackers:
        source = result_metrics.OF_TRACKERS.join(batches, batches.c.id == results.c.batch_id)
        query = select(tracker_values, *place).select_from(source)
    width_s = TRENDS[bucket].width_s
    found: Rollups = {}
    # Otherwise PostgreSQL's client would hold all rows at once.
    in_pieces = {"yield_per": ROWS_AT_ONCE}
    with connection.execute(query.where(results.c.current), execution_options=in_pieces) as read:
        for row in read.mappings():
            tracker = (row["tracker"],) if of_trackers else ()
            number = parse_utc(row["time"]).bucket(width_s)
            key = row["spacecraft"], row["run"], *tracker, number
            _put(found, key, result_metrics.rolled_up([dict(row)]))
    for spacecraft, run, name, hour, share in _shares(connection):
        if (name != WHOLE) == of_trackers:
            owner = (spacecraft, run, name) if of_trackers else (spacecraft, run)
            _put(found, (*owner, hour * HOUR_S // width_s), share)
    return found


def hours_of_all(connection: Connection) -> set[BucketKey]:
    """Keys of all hours with batches, recorded or archived, or with a trend."""
    hour = func.substr(batches.c.time, 1, len("2026-11-27T12"))
    columns = batches.c.spacecraft, batches.c.run
    query = select(*columns, func.min(batches.c.time)).group_by(*columns, hour)
    found = {
        (spacecraft, run, recorded_utc(time).bucket(HOUR_S))
        for spacecraft, run, time in connection.execute(query)
    }
    for table in (tables.rollups_hourly, tables.archived_hours):
        query = select(*(table.c[name] for name in _KEY)).distinct()
        found.update((row[0], row[1], row[2]) for row in connection.execute(query))
    return found


def waiting(connection: Connection, bucket: Bucket) -> set[BucketKey]:
    """Keys of the hours or days with results that the projector has not reached."""
    query = select(results.c.spacecraft, results.c.run, batches.c.time).join_from(
        results, batches, results.c.batch_id == batches.c.id
    )
    query = query.where(results.c.seq > select(projector.c.seq).scalar_subquery())
    width_s = TRENDS[bucket].width_s
    return {
        (spacecraft, run, parse_utc(time).bucket(width_s))
        for spacecraft, run, time in connection.execute(query)
    }


# The share of archived batches in the trends, hour by hour.
#
# A trend covers recorded and archived batches alike.  A recount reads the recorded ones, then adds
# the share that is kept here.


def keep_share(
    connection: Connection,
    part_id: int,
    spacecraft: str,
    run: str,
    of_hour: Mapping[int, Sequence[str]],
) -> None:
    """Store the contribution of recorded batches to the trends of each hour, before archiving.

    `of_hour` has the ids of the batches by the number of their hour.
    """
    found = {
        hour: _summed(connection, results.c.current, results.c.batch_id.in_(batch_ids))
        for hour, batch_ids in of_hour.items()
    }
    insert_share(connection, part_id, spacecraft, run, found)


def insert_share(
    connection: Connection,
    part_id: int,
    spacecraft: str,
    run: str,
    of_hour: Mapping[int, Mapping[str, Row]],
) -> None:
    """Store an archive part's share of the trends of each hour, by tracker and for the `WHOLE`."""
    own = {"spacecraft": spacecraft, "run": run, "part_id": part_id}
    rows = [
        own | {"bucket": hour, "tracker": tracker, "sums": json.dumps(share)}
        for hour, shares in of_hour.items()
        for tracker, share in shares.items()
    ]
    if rows:
        connection.execute(insert(tables.archived_hours), rows)


def forget_share(connection: Connection, part_id: int, spacecraft: str, run: str) -> None:
    """Delete an archive part's share of the trends, since its batches are recorded again."""
    c = tables.archived_hours.c
    own = c.spacecraft == spacecraft, c.run == run, c.part_id == part_id
    connection.execute(delete(tables.archived_hours).where(*own))


def shares_of_hour(connection: Connection, spacecraft: str, run: str, hour: int) -> dict[str, Row]:
    """Share of all archived batches in the trends of an hour, by tracker and for the `WHOLE`."""
    c = tables.archived_hours.c
    found: Rollups = {}
    own = c.spacecraft == spacecraft, c.run == run, c.bucket == hour
    for *_, tracker, _, share in _shares(connection, *own):
        _put(found, tracker, share)
    return found


def _shares(
    connection: Connection, *chosen: ColumnElement[bool]
) -> Iterator[tuple[str, str, str, int, Row]]:
    """Shares of archived batches in the trends, as (spacecraft, run, tracker, hour, columns)."""
    c = tables.archived_hours.c
    query = select(c.spacecraft, c.run, c.tracker, c.bucket, c.sums).where(*chosen)
    for spacecraft, run, tracker, hour, sums in connection.execute(query):
        yield spacecraft, run, tracker, hour, _NOTHING | json.loads(sums)
