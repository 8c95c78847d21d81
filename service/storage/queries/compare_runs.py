"""Two runs side by side: what became of the same stars, and how far the attitudes differ."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
from sqlalchemy import Connection, Subquery, and_, case, func, or_, select

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
from service.storage.sql.tables import COUNTED, batches, results, solutions, star_results
from service.vectors import ARCSEC_PER_RADIAN, Vector

_READ_AT_ONCE = 10_000
_QUATERNION = ("q1", "q2", "q3", "qc")


def compare_runs(
    connection: Connection, selected: ResultFilter, other: str, latest: int | None = None
) -> RunComparison:
    """The current results of a period beside those of the same batches in another run.

    `stars` counts what became of each, from the one run (`before`) to the other
    (`after`); `same_star` tells whether both name it, and alike.  `attitudes`
    compares what both have.  With `latest`, of the period's latest batches alone.
    """
    pairs = _pairs(selected, other, latest)
    transitions = _transitions(connection, pairs)
    return RunComparison(
        run=selected.run,
        other=other,
        batches=int(connection.scalar(select(func.count()).select_from(pairs)) or 0),
        stars=RunStars(
            observed=sum(each.stars for each in transitions),
            before=_sums((each.before, each.stars) for each in transitions),
            after=_sums((each.after, each.stars) for each in transitions),
            transitions=transitions,
        ),
        attitudes=_attitudes(connection, pairs),
    )


def changed_batches(
    connection: Connection, selected: ResultFilter, other: str, latest: int, limit: int
) -> list[RunChange]:
    """The batches whose counts of stars or whose status differ in the other run, latest first.

    At most `limit` of the period's `latest` batches.
    """
    pairs = _pairs(selected, other, latest)
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


def _transitions(connection: Connection, pairs: Subquery) -> list[RunTransition]:
    """How many stars went from which outcome to which, the most first."""
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
    found = [
        RunTransition(before=before, after=after, same_star=bool(alike), stars=int(stars))
        for before, after, alike, stars in connection.execute(query)
    ]
    return sorted(found, key=lambda each: (-each.stars, each.before, each.after))


def _sums(stars: Iterable[tuple[str, int]]) -> OutcomeCounts:
    counts: Counter[str] = Counter()
    for outcome, number in stars:
        counts[outcome] += number
    return OutcomeCounts(**{name: counts[name] for name in OutcomeCounts.__struct_fields__})


def _attitudes(connection: Connection, pairs: Subquery) -> RunAttitudes:
    """How many attitudes each has, and the angle between those that both have."""
    states = select(pairs.c.status_before, pairs.c.status_after, func.count()).group_by(
        pairs.c.status_before, pairs.c.status_after
    )
    before: Counter[str] = Counter()
    after: Counter[str] = Counter()
    for old, new, count in connection.execute(states):
        before[old or "none"] += int(count)
        after[new or "none"] += int(count)
    angles = _angles_arcsec(connection, pairs)
    statistics = None
    if len(angles):
        median, p95 = np.quantile(angles, (0.5, 0.95)).tolist()
        statistics = AngleStatistics(median=median, p95=p95, max=float(angles.max()))
    return RunAttitudes(
        before=StatusCounts(**before),
        after=StatusCounts(**after),
        in_both=len(angles),
        angle_arcsec=statistics,
    )


def _angles_arcsec(connection: Connection, pairs: Subquery) -> Vector:
    old, new = solutions.alias("old_solution"), solutions.alias("new_solution")
    query = (
        select(*(each.c[name] for each in (old, new) for name in _QUATERNION))
        .select_from(pairs)
        .join(old, old.c.result_id == pairs.c.before)
        .join(new, new.c.result_id == pairs.c.after)
    )
    read: Any = connection.execution_options(yield_per=_READ_AT_ONCE).execute(query)
    parts = [_between(np.array(rows, dtype=float)) for rows in read.partitions(_READ_AT_ONCE)]
    return np.concatenate(parts) if parts else np.empty(0)


def _between(rows: Vector) -> Vector:
    """The angle between the attitudes of each row, eight numbers: accurate near zero."""
    one, other = rows[:, :4], rows[:, 4:]
    apart = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    return np.asarray(4.0 * np.arcsin(np.minimum(1.0, apart / 2.0)) * ARCSEC_PER_RADIAN)
