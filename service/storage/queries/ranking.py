"""The worst batches of a period by a quantity, found without reading all batches.

The rollups have the greatest value of every hour.  Hours are read in descending
order of it until no batch of the remaining hours can be worse than those found.
"""

from collections.abc import Iterator
from typing import Any

from sqlalchemy import Case, ColumnElement, Connection, Select, Table, case, func, select

from service.alarms.quantities import QUANTITIES, RankedName
from service.storage.models.trends import RankedBatch
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.queries.results import summary_fields, summary_query
from service.storage.recording.rollup_sql import OF_TRACKERS, value_sql
from service.storage.sql.rollup_tables import rollups_hourly, tracker_rollups_hourly
from service.storage.sql.tables import results, tracker_values
from service.times import HOUR_S, Utc, bucket_start

RankedRow = tuple[float, int, str, str]
"""(how bad, time_ns, batch_id, result id): in this order one batch is worse than another."""


def worst_batches(
    connection: Connection,
    selected: ResultFilter,
    by: RankedName,
    limit: int,
    tracker: str | None = None,
) -> list[RankedBatch]:
    """The `limit` batches with the greatest value, the worst first, of equals the newest.

    Of an offset its size counts, whichever its sign.  With a tracker, of a spacecraft with
    several, the values are the tracker's.
    """
    badness = _badness(by, results if tracker is None else tracker_values)
    found: list[RankedRow] = []
    for begin, end, most in _hours(connection, selected, by, limit, tracker):
        if len(found) == limit and (most, end) < (found[-1][0], found[-1][1]):
            break
        query = (
            select(badness, *PLACE, results.c.id)
            .where(
                results.c.current,
                results.c.spacecraft == selected.spacecraft,
                results.c.run == selected.run,
                results.c.time_ns >= begin,
                results.c.time_ns < end,
                badness.is_not(None),
            )
            .order_by(badness.desc(), *(column.desc() for column in PLACE))
            .limit(limit)
        )
        query = _of_tracker(query, tracker)
        found += [(float(row[0]), row[1], row[2], row[3]) for row in connection.execute(query)]
        found = sorted(found, reverse=True)[:limit]
    return _shown(connection, [each[-1] for each in found], by, tracker)


def _of_tracker(query: Select[Any], tracker: str | None) -> Select[Any]:
    """The query over `results` with the values of a tracker beside them, if there is one."""
    if tracker is None:
        return query
    return query.select_from(OF_TRACKERS).where(tracker_values.c.tracker == tracker)


def _hours(
    connection: Connection,
    selected: ResultFilter,
    by: RankedName,
    limit: int,
    tracker: str | None,
) -> Iterator[tuple[int, int, float]]:
    """The hours of a period as (begin, end, the greatest value in it), the greatest first.

    An hour that the period cuts is narrowed; its greatest value may lie outside.
    """
    rollup = rollups_hourly if tracker is None else tracker_rollups_hourly
    table = rollup.c
    most = _greatest(by, rollup)
    query = select(table.bucket, most).where(
        table.spacecraft == selected.spacecraft, table.run == selected.run, most.is_not(None)
    )
    if tracker is not None:
        query = query.where(table.tracker == tracker)
    if selected.start is not None:
        query = query.where(table.bucket >= selected.start.bucket(HOUR_S))
    if selected.end is not None:
        query = query.where(table.bucket <= selected.end.bucket(HOUR_S))
    # Of `limit` whole hours each holds a batch at least as bad as any in the hours beyond them;
    # two more, because the ends of the period may cut away what made an hour one of the worst.
    query = query.order_by(most.desc(), table.bucket.desc()).limit(limit + 2)
    rows = connection.execute(query).all()
    return _narrowed(rows, selected.start, selected.end)


def _narrowed(rows: Any, start: Utc | None, end: Utc | None) -> Iterator[tuple[int, int, float]]:
    for bucket, most in rows:
        begin, over = (bucket_start(bucket + ahead, HOUR_S).tai_ns for ahead in (0, 1))
        if start is not None:
            begin = max(begin, start.tai_ns)
        if end is not None:
            over = min(over, end.tai_ns)
        if begin < over:
            yield begin, over, float(most)


def _badness(by: RankedName, of: Table) -> ColumnElement[Any]:
    value = value_sql(QUANTITIES[by], of)
    return func.abs(value) if QUANTITIES[by].worse == "size" else value


def _greatest(by: RankedName, of: Table) -> ColumnElement[Any] | Case[Any]:
    high: ColumnElement[Any] = of.c[f"{by}_max"]
    if QUANTITIES[by].worse == "high":
        return high
    low = -of.c[f"{by}_min"]
    return case((low > high, low), else_=high)


def _shown(
    connection: Connection, ids: list[str], by: RankedName, tracker: str | None
) -> list[RankedBatch]:
    query = summary_query().where(results.c.id.in_(ids))
    rows = {row["id"]: dict(row) for row in connection.execute(query).mappings()}
    values = rows
    if tracker is not None:
        chosen = select(results.c.id, tracker_values)
        own = _of_tracker(chosen.where(results.c.id.in_(ids)), tracker)
        values = {row["id"]: dict(row) for row in connection.execute(own).mappings()}
    value_of: Any = QUANTITIES[by].value_of
    return [RankedBatch(**summary_fields(rows[id]), value=value_of(values[id])) for id in ids]
