"""Rates of a spacecraft in two runs over one period, from rollups, which count archived batches."""

import math
from collections.abc import Sequence

import numpy as np
from sqlalchemy import Connection, func, select

from service.storage.models.compare import RatesOfRuns, RunRates
from service.storage.queries.time_buckets import BucketFilter, Columns, Level, read_buckets
from service.storage.sql.rollup_tables import COUNTS, rollups_daily
from service.times import DAY_S, HOUR_S, Utc, bucket_start, unix_seconds
from service.vectors import Vector

_SHOWN_BY_HOUR_S = 30 * DAY_S
"""The longest period with a cell an hour; a longer one has cells of one day or several."""
_MOST_CELLS_OF_DAYS = 732
"""Two years of days."""
_SHARES = ("ambiguous", "unmatched")


def run_rates(
    connection: Connection,
    spacecraft: str,
    runs: Sequence[str],
    start: Utc | None,
    end: Utc | None,
) -> RatesOfRuns | None:
    """What became of all stars of each run, in total and over time.

    The period is that between `start` and `end`, and at most the days that all runs have; None
    where there are none.
    """
    common = _common_days(connection, spacecraft, runs)
    if common is None:
        return None
    start = max(start or common[0], common[0], key=_tai_ns)
    end = min(end or common[1], common[1], key=_tai_ns)
    if start.tai_ns >= end.tai_ns:
        return None
    first_s, end_s = unix_seconds([start.tai_ns, end.tai_ns]).tolist()
    level: Level = "hour" if end_s - first_s <= _SHOWN_BY_HOUR_S else "day"
    width_s = HOUR_S if level == "hour" else DAY_S * _days_of_a_cell(end_s - first_s)
    cells = int(-(-end_s // width_s) - first_s // width_s)
    rates = []
    for run in runs:
        span = BucketFilter(spacecraft, run, start, end)
        buckets = read_buckets(connection, span, level, COUNTS)
        place = (buckets["unix_s"] // width_s - first_s // width_s).astype(int)
        rates.append(
            RunRates(
                run=run,
                totals={name: int(buckets[name].sum()) for name in COUNTS},
                shares={name: _share(buckets, name, place, cells) for name in _SHARES},
            )
        )
    return RatesOfRuns(start=start, end=end, cell_s=width_s, runs=tuple(rates))


def _tai_ns(moment: Utc) -> int:
    return moment.tai_ns


def _days_of_a_cell(length_s: float) -> int:
    return math.ceil(length_s / (DAY_S * _MOST_CELLS_OF_DAYS))


def _common_days(
    connection: Connection, spacecraft: str, runs: Sequence[str]
) -> tuple[Utc, Utc] | None:
    c = rollups_daily.c
    query = (
        select(func.min(c.bucket), func.max(c.bucket))
        .where(c.spacecraft == spacecraft, c.run.in_(runs), c.batches > 0)
        .group_by(c.run)
    )
    days = connection.execute(query).all()
    if len(days) < len({*runs}):
        return None
    first, last = max(day[0] for day in days), min(day[1] for day in days)
    return bucket_start(first, DAY_S), bucket_start(last + 1, DAY_S)


def _share(buckets: Columns, name: str, place: Vector, cells: int) -> Vector:
    """The share of the observed stars in each cell; NaN in one without a star."""
    part, whole = (
        np.bincount(place, weights=buckets[column], minlength=cells)
        for column in (name, "observed")
    )
    return np.asarray(np.divide(part, whole, out=np.full(cells, np.nan), where=whole > 0))
