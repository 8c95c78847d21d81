"""A bounded sample of the batches of a period, spread evenly over them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from sqlalchemy import BigInteger, Connection, Select, bindparam, select

from service.missions.mission import Mission
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.queries.recorded_batch import recorded_mission
from service.storage.queries.time_buckets import BucketFilter, read_buckets
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, results
from service.times import HOUR_S, utc_of_unix

MOST_READ = 600
"""Batches that are read in full: their stars take less than a second."""

_SHOWN: Select[tuple[str, str, int, str, str]] = select(
    results.c.answer,
    results.c.mission_digest,
    results.c.time_ns,
    results.c.batch_id,
    batches.c.input,
).join_from(results, batches, results.c.batch_id == batches.c.id)
_FROM_NS = bindparam("from_ns", type_=BigInteger)


@dataclass(frozen=True)
class PeriodSample:
    """Rows of some of `total` batches in order of time, with their missions by digest.

    `follows` (b,) says whether no other batch lies between one and that before it.
    """

    total: int
    follows: npt.NDArray[np.bool_]
    rows: tuple[Row, ...]
    missions: dict[str, Mission]


def sample_period(
    connection: Connection, span: BucketFilter, most: int = MOST_READ
) -> PeriodSample:
    """All batches of a period, or pairs of neighbours spread evenly, at most `most` batches.

    Where the pairs are is drawn, one from each of equal parts of the batches, so that
    nothing periodic is met always or never.  The batches of an hour count as spread evenly
    over it.  Of a long period its hours are read, and no more batches than of a short one.
    """
    hours = read_buckets(connection, span, "hour", ("batches",))
    total = int(hours["batches"].sum())
    selected = ResultFilter(span.run, span.spacecraft, span.start, span.end)
    query = _SHOWN.order_by(*PLACE)
    if total <= most:
        rows = _rows(connection, query.where(*selected.conditions()).limit(most))
        follows = np.arange(len(rows)) > 0
    else:
        drawn = _drawn_times_ns(hours["unix_s"], hours["batches"], most // 2)
        # The first hour may begin before the period.
        pairs = _pairs(connection, selected, [max(each, span.start.tai_ns) for each in drawn])
        chosen = {id for pair in pairs for id in pair}
        # Without the period, through which the ids would be looked for one after another.
        own = (results.c.current, results.c.batch_id.in_(chosen))
        rows = _rows(connection, query.where(*own))
        ids = [row["batch_id"] for row in rows]
        follows = np.array([False, *(pair in pairs for pair in pairwise(ids))])
    digests = {row["mission_digest"] for row in rows}
    missions = {digest: recorded_mission(connection, digest) for digest in digests}
    return PeriodSample(total, follows, tuple(rows), missions)


def _drawn_times_ns(
    unix_s: npt.NDArray[np.float64], count: npt.NDArray[np.float64], pairs: int
) -> list[int]:
    """A moment in each of so many parts that have equally many of the hours' batches."""
    rng = np.random.default_rng(0)
    rank = (np.arange(pairs) + rng.random(pairs)) * count.sum() / pairs
    before = np.concatenate([[0.0], np.cumsum(count)])
    place = np.clip(np.searchsorted(before, rank, side="right") - 1, 0, len(count) - 1)
    at_s = unix_s[place] + (rank - before[place]) / count[place] * HOUR_S
    return [utc_of_unix(each).tai_ns for each in at_s.tolist()]


def _pairs(
    connection: Connection, selected: ResultFilter, begins_ns: Sequence[int]
) -> set[tuple[str, str]]:
    """The first two batches from each moment on; near the end of the period the last two."""
    forward = (
        select(results.c.batch_id)
        # With one lower bound alone the index is entered at it.
        .where(*replace(selected, start=None).conditions(), results.c.time_ns >= _FROM_NS)
        .order_by(*PLACE)
        .limit(2)
    )
    backward = (
        select(results.c.batch_id)
        .where(*selected.conditions())
        .order_by(*(column.desc() for column in PLACE))
        .limit(2)
    )
    found = set()
    for begin_ns in begins_ns:
        pair = [row[0] for row in connection.execute(forward, {"from_ns": begin_ns})]
        if len(pair) < 2:
            pair = [row[0] for row in connection.execute(backward)][::-1]
        found.add((pair[0], pair[1]))
    return found


def _rows(connection: Connection, query: Select[tuple[str, str, int, str, str]]) -> list[Row]:
    return [dict(row) for row in connection.execute(query).mappings()]
