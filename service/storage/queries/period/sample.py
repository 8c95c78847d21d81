"""A bounded sample of the batches of a period, spread evenly over them."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from sqlalchemy import Connection, select

from service.missions.mission import Mission
from service.storage.queries.attitude_rows import count_results
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.queries.recorded_batch import recorded_mission, rows_at_ranks
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, results
from service.times import recorded_utc

MOST_READ = 600
"""Batches that are read in full: their stars take about a second."""
MOST_COUNTED = 200_000
"""Batches of which those are chosen: to count as many takes a tenth of a second."""

_SHOWN = (results.c.answer, results.c.mission_digest, results.c.time_ns, batches.c.input)


@dataclass(frozen=True)
class PeriodSample:
    """Rows of batches in order of time, with the missions of their results by digest.

    They are chosen of `total` batches, the latest of more where `is_cut`.  `rank` (b,) are
    their places among these, from 1.
    """

    total: int
    is_cut: bool
    rank: npt.NDArray[np.int64]
    rows: tuple[Row, ...]
    missions: dict[str, Mission]


def sample_period(
    connection: Connection,
    selected: ResultFilter,
    most: int = MOST_READ,
    most_counted: int = MOST_COUNTED,
) -> PeriodSample:
    """All batches of a period, or pairs of neighbours spread evenly, at most `most` batches.

    Each pair is drawn from one of equal parts, so that nothing periodic is met always
    or never, and has neighbours, so that a rate can be formed.
    """
    total = count_results(connection, selected, most_counted + 1)
    is_cut = total > most_counted
    if is_cut:
        selected, total = _latest(connection, selected, most_counted), most_counted
    rank = _ranks(total, most)
    rows = rows_at_ranks(connection, selected, rank.tolist(), _SHOWN)
    digests = {row["mission_digest"] for row in rows}
    return PeriodSample(
        total=total,
        is_cut=is_cut,
        rank=rank[: len(rows)],
        rows=tuple(rows),
        missions={digest: recorded_mission(connection, digest) for digest in digests},
    )


def _ranks(total: int, most: int) -> npt.NDArray[np.int64]:
    if total <= most:
        return np.arange(1, total + 1)
    pairs = most // 2
    drawn = np.random.default_rng(0).random(pairs)
    first = 1 + np.floor((np.arange(pairs) + drawn) * (total - 1) / pairs).astype(np.int64)
    return np.union1d(first, first + 1)


def _latest(connection: Connection, selected: ResultFilter, count: int) -> ResultFilter:
    """The same from the earliest of the latest `count` batches on."""
    earliest = (
        select(results.c.batch_id)
        .where(*selected.conditions())
        .order_by(*(column.desc() for column in PLACE))
        .offset(count - 1)
        .limit(1)
    )
    time = connection.execute(
        select(batches.c.time).where(batches.c.id == earliest.scalar_subquery())
    ).scalar_one()
    return replace(selected, start=recorded_utc(time))
