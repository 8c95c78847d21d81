"""The worst batches of a stretch, found without looking at all of them.

The rollups tell the greatest value of every hour.  Hours are opened in
descending order of it until nothing in the hours that are left could be worse
than what was found.
"""

from collections.abc import Iterator
from typing import Any

from sqlalchemy import Case, ColumnElement, Connection, Float, case, cast, func, select

from service.alarms.quantities import QuantityName
from service.records.draft import Row
from service.records.pages import PLACE, Stretch
from service.records.reading import summaries, summary_of
from service.records.tables import results, rollups_hourly
from service.records.trends import value_of
from service.times import HOUR_S, Utc, bucket_start

Found = tuple[float, int, str, str]
"""(how bad, time_ns, batch_id, result id): in this order one batch is worse than another."""


def worst_batches(
    connection: Connection, stretch: Stretch, by: QuantityName, limit: int
) -> list[Row]:
    """The `limit` batches with the greatest value, the worst first, of equals the newest.

    Of an offset its size counts, whichever its sign.
    """
    badness = _badness(by)
    found: list[Found] = []
    for begin, end, most in _hours(connection, stretch, by, limit):
        if len(found) == limit and (most, end) < (found[-1][0], found[-1][1]):
            break
        query = (
            select(badness, *PLACE, results.c.id)
            .where(
                results.c.current,
                results.c.spacecraft == stretch.spacecraft,
                results.c.run == stretch.run,
                results.c.time_ns >= begin,
                results.c.time_ns < end,
                badness.is_not(None),
            )
            .order_by(badness.desc(), *(column.desc() for column in PLACE))
            .limit(limit)
        )
        found += [(float(row[0]), row[1], row[2], row[3]) for row in connection.execute(query)]
        found = sorted(found, reverse=True)[:limit]
    return _shown(connection, [each[-1] for each in found], by)


def _hours(
    connection: Connection, stretch: Stretch, by: QuantityName, limit: int
) -> Iterator[tuple[int, int, float]]:
    """The hours of a stretch as (begin, end, the greatest value in it), the greatest first.

    An hour that the stretch cuts is narrowed; its greatest value may lie outside.
    """
    table = rollups_hourly.c
    most = _greatest(by)
    query = select(table.bucket, most).where(
        table.spacecraft == stretch.spacecraft, table.run == stretch.run, most.is_not(None)
    )
    if stretch.start is not None:
        query = query.where(table.bucket >= stretch.start.bucket(HOUR_S))
    if stretch.end is not None:
        query = query.where(table.bucket <= stretch.end.bucket(HOUR_S))
    # Of `limit` whole hours each holds a batch at least as bad as any in the hours beyond them;
    # two more, because the ends of the stretch may cut away what made an hour one of the worst.
    query = query.order_by(most.desc(), table.bucket.desc()).limit(limit + 2)
    rows = connection.execute(query).all()
    return _narrowed(rows, stretch.start, stretch.end)


def _narrowed(rows: Any, start: Utc | None, end: Utc | None) -> Iterator[tuple[int, int, float]]:
    for bucket, most in rows:
        begin, over = (bucket_start(bucket + ahead, HOUR_S).tai_ns for ahead in (0, 1))
        if start is not None:
            begin = max(begin, start.tai_ns)
        if end is not None:
            over = min(over, end.tai_ns)
        if begin < over:
            yield begin, over, float(most)


def _badness(by: QuantityName) -> ColumnElement[Any]:
    columns = results.c
    observed = columns.unique + columns.ambiguous + columns.unmatched
    match by:
        case "ambiguous_share":
            return cast(columns.ambiguous, Float) / func.nullif(observed, 0)
        case "unmatched_share":
            return cast(columns.unmatched, Float) / func.nullif(observed, 0)
        case "residual_ratio":
            return columns.residual_rms_arcsec / func.nullif(columns.predicted_rms_arcsec, 0.0)
        case "magnitude_offset_mag":
            return func.abs(columns.magnitude_offset_mag)
        case _:
            column: ColumnElement[Any] = columns[by]
            return column


def _greatest(by: QuantityName) -> ColumnElement[Any] | Case[Any]:
    table = rollups_hourly.c
    if by != "magnitude_offset_mag":
        column: ColumnElement[Any] = table[f"{by}_max"]
        return column
    low, high = -table.magnitude_offset_mag_min, table.magnitude_offset_mag_max
    return case((low > high, low), else_=high)


def _shown(connection: Connection, ids: list[str], by: QuantityName) -> list[Row]:
    query = summaries().where(results.c.id.in_(ids))
    rows = {row["id"]: row for row in connection.execute(query).mappings()}
    return [summary_of(rows[id]) | {"value": value_of(rows[id], by)} for id in ids]
