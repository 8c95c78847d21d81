"""Two runs side by side: what became of the same stars, and how far the attitudes differ."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from sqlalchemy import Connection, Subquery, and_, case, func, or_, select

from service.storage.archive.reading import Archive
from service.storage.models.compare import (
    AngleStatistics,
    OutcomeCounts,
    RunAttitudes,
    RunChange,
    RunChangeSide,
    RunComparison,
    RunStars,
    RunTransition,
    StatusCounts,
)
from service.storage.queries.pages import ResultFilter
from service.storage.queries.with_archive.both_runs import both_runs, is_archived_in_part
from service.storage.sql.tables import COUNTED, batches, results, solutions, star_results
from service.vectors import ARCSEC_PER_RADIAN, Vector

_READ_AT_ONCE = 10_000
_QUATERNION = ("q1", "q2", "q3", "qc")


def compare_runs(
    connection: Connection,
    archive: Archive,
    selected: ResultFilter,
    other: str,
    latest: int | None = None,
) -> RunComparison:
    """The current results of a period beside those of the same batches in another run.

    `stars` counts what became of each, from the one run (`before`) to the other
    (`after`); `same_star` tells whether both name it, and alike.  `attitudes`
    compares what both have.  With `latest`, of the period's latest batches alone.
    """
    tally = _Tally()
    if not is_archived_in_part(connection, selected, other):
        tally.add(connection, _pairs(selected, other, latest))
    else:
        for group in both_runs(connection, archive, selected, other, latest):
            with group.reading() as of_group:
                tally.add(of_group, _pairs(selected, other))
    return tally.comparison(selected.run, other)


def changed_batches(
    connection: Connection,
    archive: Archive,
    selected: ResultFilter,
    other: str,
    latest: int,
    limit: int,
) -> list[RunChange]:
    """The batches whose counts of stars or whose status differ in the other run, latest first.

    At most `limit` of the period's `latest` batches.
    """
    if not is_archived_in_part(connection, selected, other):
        return _changed(connection, _pairs(selected, other, latest), limit)
    found: list[RunChange] = []
    for group in both_runs(connection, archive, selected, other, latest):
        with group.reading() as of_group:
            found += _changed(of_group, _pairs(selected, other), limit)
        if len(found) >= limit:
            break
    return found[:limit]


def _changed(connection: Connection, pairs: Subquery, limit: int) -> list[RunChange]:
    old, new = results.alias("old"), results.alias("changed")
    differ = or_(
        *(old.c[name] != new.c[name] for name in (*COUNTED, "status")),
        # Without an attitude the status is null.
        old.c.status.is_(None) != new.c.status.is_(None),
    )
    sides = [
        each.c[name].label(f"{side}_{name}")
        for side, each in (("before", old), ("after", new))
        for name in ("id", *COUNTED, "status")
    ]
    query = (
        select(batches.c.batch, batches.c.time, *sides)
        .select_from(pairs)
        .join(old, old.c.id == pairs.c.before)
        .join(new, new.c.id == pairs.c.after)
        .join(batches, batches.c.id == old.c.batch_id)
        .where(differ)
        .order_by(old.c.time_ns.desc(), old.c.batch_id.desc())
        .limit(limit)
    )
    return [
        RunChange(
            batch=row["batch"],
            time=row["time"],
            before=_side(row, "before"),
            after=_side(row, "after"),
        )
        for row in connection.execute(query).mappings()
    ]


def _side(row: Any, side: str) -> RunChangeSide:
    counts = {name: row[f"{side}_{name}"] for name in ("unique", "ambiguous", "unmatched")}
    return RunChangeSide(
        id=row[f"{side}_id"], counts=OutcomeCounts(**counts), status=row[f"{side}_status"]
    )


def _pairs(selected: ResultFilter, other: str, latest: int | None = None) -> Subquery:
    """The ids and states of the two current results of each batch that is in both runs."""
    again, new = batches.alias("again"), results.alias("new")
    of_run = selected.conditions()
    if latest is not None:
        # The limit comes first: to look for partners of millions of batches takes minutes.
        chosen = select(results.c.id).where(*of_run)
        chosen = chosen.order_by(results.c.time_ns.desc(), results.c.batch_id.desc())
        of_run = [results.c.id.in_(select(chosen.limit(latest).subquery().c.id))]
    return (
        select(
            results.c.id.label("before"),
            new.c.id.label("after"),
            results.c.status.label("status_before"),
            new.c.status.label("status_after"),
        )
        .join_from(results, batches, results.c.batch_id == batches.c.id)
        .join(
            again,
            and_(
                again.c.spacecraft == batches.c.spacecraft,
                again.c.run == other,
                again.c.batch == batches.c.batch,
            ),
        )
        .join(new, and_(new.c.batch_id == again.c.id, new.c.current))
        .where(*of_run)
        .subquery()
    )


class _Tally:
    """Both runs so far, over the groups of batches that were compared."""

    def __init__(self) -> None:
        self.batches = 0
        self.stars: Counter[tuple[str, str, bool]] = Counter()
        self.before: Counter[str] = Counter()
        self.after: Counter[str] = Counter()
        self.angles_arcsec: list[Vector] = []

    def add(self, connection: Connection, pairs: Subquery) -> None:
        """Take the pairs of a group."""
        self.batches += int(connection.scalar(select(func.count()).select_from(pairs)) or 0)
        self.stars.update(_transitions(connection, pairs))
        states = select(pairs.c.status_before, pairs.c.status_after, func.count()).group_by(
            pairs.c.status_before, pairs.c.status_after
        )
        for old, new, count in connection.execute(states):
            self.before[old or "none"] += int(count)
            self.after[new or "none"] += int(count)
        self.angles_arcsec += _angles_arcsec(connection, pairs)

    def comparison(self, run: str | None, other: str) -> RunComparison:
        """The whole; of the transitions the most frequent first."""
        transitions = [
            RunTransition(before=before, after=after, same_star=alike, stars=stars)
            for (before, after, alike), stars in self.stars.items()
        ]
        transitions.sort(key=lambda each: (-each.stars, each.before, each.after))
        angles = np.concatenate([np.empty(0), *self.angles_arcsec])
        statistics = None
        if len(angles):
            median, p95 = np.quantile(angles, (0.5, 0.95)).tolist()
            statistics = AngleStatistics(median=median, p95=p95, max=float(angles.max()))
        return RunComparison(
            run=run,
            other=other,
            batches=self.batches,
            stars=RunStars(
                observed=sum(each.stars for each in transitions),
                before=_sums((each.before, each.stars) for each in transitions),
                after=_sums((each.after, each.stars) for each in transitions),
                transitions=transitions,
            ),
            attitudes=RunAttitudes(
                before=StatusCounts(**self.before),
                after=StatusCounts(**self.after),
                in_both=len(angles),
                angle_arcsec=statistics,
            ),
        )


def _transitions(connection: Connection, pairs: Subquery) -> dict[tuple[str, str, bool], int]:
    """How many stars went from which outcome to which, and whether they name the same star."""
    old, new = star_results.alias("old_star"), star_results.alias("new_star")
    same = case((old.c.star_id == new.c.star_id, 1), else_=0)
    query = (
        select(old.c.outcome, new.c.outcome, same, func.count())
        .select_from(pairs)
        .join(old, old.c.result_id == pairs.c.before)
        .join(
            new,
            and_(
                new.c.result_id == pairs.c.after,
                new.c.tracker == old.c.tracker,
                new.c.position == old.c.position,
            ),
        )
        .group_by(old.c.outcome, new.c.outcome, same)
    )
    return {
        (before, after, bool(alike)): int(stars)
        for before, after, alike, stars in connection.execute(query)
    }


def _sums(stars: Iterable[tuple[str, int]]) -> OutcomeCounts:
    counts: Counter[str] = Counter()
    for outcome, number in stars:
        counts[outcome] += number
    return OutcomeCounts(**{name: counts[name] for name in OutcomeCounts.__struct_fields__})


def _angles_arcsec(connection: Connection, pairs: Subquery) -> list[Vector]:
    """The angles between the attitudes that both have, in arrays."""
    old, new = solutions.alias("old_solution"), solutions.alias("new_solution")
    query = (
        select(*(each.c[name] for each in (old, new) for name in _QUATERNION))
        .select_from(pairs)
        .join(old, old.c.result_id == pairs.c.before)
        .join(new, new.c.result_id == pairs.c.after)
    )
    read: Any = connection.execution_options(yield_per=_READ_AT_ONCE).execute(query)
    return [_between(np.array(rows, dtype=float)) for rows in read.partitions(_READ_AT_ONCE)]


def _between(rows: Vector) -> Vector:
    """The angle between the attitudes of each row, eight numbers: accurate near zero."""
    one, other = rows[:, :4], rows[:, 4:]
    apart = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    return np.asarray(4.0 * np.arcsin(np.minimum(1.0, apart / 2.0)) * ARCSEC_PER_RADIAN)
