"""The rollups: sums and extremes of current results by hour and day, for trends.

Of spacecraft, and of the trackers of spacecraft that have several.
"""

from sqlalchemy import BigInteger, Column, Double, Integer, Table, text

from service.alarms.quantities import QUANTITIES
from service.storage.sql.columns import Id, Name, RunName, metadata

COUNTS = ("batches", "observed", "unique", "ambiguous", "unmatched", "solved", "suspect")
_ROLLED_UP = [each for each in QUANTITIES.values() if each.rolled_up]
SHARES = tuple(each.name for each in _ROLLED_UP if each.is_share)
"""Shares of a batch's stars; their means follow from the counts."""
VALUES = tuple(each.name for each in _ROLLED_UP if not each.is_share)
SUMS = tuple(f"{name}_{part}" for name in VALUES for part in ("n", "sum"))
MINIMA = tuple(f"{name}_min" for name in (*SHARES, *VALUES))
MAXIMA = tuple(f"{name}_max" for name in (*SHARES, *VALUES))
ROLLED_UP = (*COUNTS, *SUMS, *MINIMA, *MAXIMA)
"""The columns of a rollup without its key."""


def _rollup(name: str, *trackers: Column[str]) -> Table:
    """Sums and extremes over the current results of each spacecraft, run, tracker and bucket.

    A bucket is a UTC hour or day (see `Utc.bucket`).  `_n` batches have the
    value whose `_sum` stands beside it; an extreme of none is null.
    """
    return Table(
        name,
        metadata,
        Column("spacecraft", Name, primary_key=True),
        Column("run", RunName, primary_key=True),
        *trackers,
        Column("bucket", Integer, primary_key=True, autoincrement=False),
        *(Column(count, BigInteger, nullable=False) for count in COUNTS),
        *(Column(each, _type_of(each), nullable=False, server_default=text("0")) for each in SUMS),
        *(Column(each, Double) for each in (*MINIMA, *MAXIMA)),
        sqlite_with_rowid=False,
    )


def _type_of(sum_name: str) -> type[BigInteger] | type[Double[float]]:
    return BigInteger if sum_name.endswith("_n") else Double


rollups_hourly = _rollup("rollups_hourly")
rollups_daily = _rollup("rollups_daily")
tracker_rollups_hourly = _rollup(
    "tracker_rollups_hourly", Column("tracker", Name, primary_key=True)
)
tracker_rollups_daily = _rollup("tracker_rollups_daily", Column("tracker", Name, primary_key=True))

tracker_splits = Table(
    "tracker_splits",
    metadata,
    # A run of a spacecraft whose older batches are not split by tracker yet; no row: all are.
    Column("spacecraft", Name, primary_key=True),
    Column("run", RunName, primary_key=True),
    # Batches before this one, in order of time, are still to be split; null: none was.
    Column("time_ns", BigInteger),
    Column("batch_id", Id),
    sqlite_with_rowid=False,
)
