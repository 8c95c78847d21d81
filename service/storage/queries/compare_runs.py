"""Comparison of two runs of one spacecraft: batch by batch, and their rates over time."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
from sqlalchemy import Connection, Subquery, Table, and_, case, func, or_, select, tuple_

from service.contract import runs as models
from service.storage.archived import Archive, OpenedBatches, parts_between
from service.storage.queries import pages
from service.storage.queries.time_buckets import Bucket, BucketFilter, Columns, read_buckets
from service.storage.sql import tables
from service.storage.sql.tables import batches, results
from service.times import DAY_S, HOUR_S, Utc, bucket_start, unix_seconds
from service.vectors import ARCSEC_PER_RADIAN, Vector

_READ_AT_ONCE = 10_000


def compare_runs(
    connection: Connection,
    archive: Archive,
    selected: pages.ResultFilter,
    other: str,
    latest: int | None = None,
) -> models.RunComparison:
    """Compare the current results of a period with those of the same batches in another run.

    `stars` counts the stars by outcome in the first run (`before`) and in the other one (`after`);
    `same_star` is True if both name the same catalog star.  `attitudes` compares the attitudes that
    both have.  With `latest`, only the latest batches of the period are compared.
    """
    stars: Counter[tuple[str, str, bool]] = Counter()
    before: Counter[str] = Counter()
    after: Counter[str] = Counter()
    angles_arcsec = [np.empty(0)]
    for of_group, pairs in _groups(connection, archive, selected, other, latest):
        stars.update(_transitions(of_group, pairs))
        states = pairs.c.status_before, pairs.c.status_after
        for old, new, count in of_group.execute(select(*states, func.count()).group_by(*states)):
            before[old or "none"] += int(count)
            after[new or "none"] += int(count)
        angles_arcsec += _angles_arcsec(of_group, pairs)
    transitions = [
        models.RunTransition(before=old, after=new, same_star=alike, stars=number)
        for (old, new, alike), number in stars.items()
    ]
    # Order by frequency, the highest first.
    transitions.sort(key=lambda each: (-each.stars, each.before, each.after))
    angles = np.concatenate(angles_arcsec)
    statistics = None
    if len(angles):
        median, p95 = np.quantile(angles, (0.5, 0.95)).tolist()
        statistics = models.AngleStatistics(median=median, p95=p95, max=float(angles.max()))
    return models.RunComparison(
        run=selected.run,
        other=other,
        batches=before.total(),
        stars=models.RunStars(
            observed=stars.total(),
            before=_sums((each.before, each.stars) for each in transitions),
            after=_sums((each.after, each.stars) for each in transitions),
            transitions=transitions,
        ),
        attitudes=models.RunAttitudes(
            before=models.StatusCounts(**before),
            after=models.StatusCounts(**after),
            in_both=len(angles),
            angle_arcsec=statistics,
        ),
    )


def changed_batches(
    connection: Connection,
    archive: Archive,
    selected: pages.ResultFilter,
    other: str,
    latest: int,
    limit: int,
) -> list[models.RunChange]:
    """Batches whose counts of stars or whose status differ in the other run, latest first.

    At most `limit` of the period's `latest` batches.
    """
    found: list[models.RunChange] = []
    for of_group, pairs in _groups(connection, archive, selected, other, latest):
        found += _changed(of_group, pairs, limit)
        if len(found) >= limit:
            break
    return found[:limit]


def _groups(
    connection: Connection,
    archive: Archive,
    selected: pages.ResultFilter,
    other: str,
    latest: int | None,
) -> Iterator[tuple[Connection, Subquery]]:
    """Pairs of results of both runs, in groups with the database that holds them, latest first.

    Without an archive there is one group.
    """
    is_archived = any(
        parts_between(connection, selected.spacecraft, run, *pages.bounds_of(selected))
        for run in (selected.run, other)
    )
    if not is_archived:
        yield connection, _pairs(selected, other, latest)
        return
    for group in both_runs(connection, archive, selected, other, latest):
        with group.reading() as of_group:
            yield of_group, _pairs(selected, other)


def _changed(connection: Connection, pairs: Subquery, limit: int) -> list[models.RunChange]:
    old, new = results.alias("old"), results.alias("changed")
    differ = or_(
        *(old.c[name] != new.c[name] for name in (*tables.COUNTED, "status")),
        # Status is null without an attitude.
        old.c.status.is_(None) != new.c.status.is_(None),
    )
    sides = [
        each.c[name].label(f"{side}_{name}")
        for side, each in (("before", old), ("after", new))
        for name in ("id", *tables.COUNTED, "status")
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
        models.RunChange(
            batch=row["batch"],
            time=row["time"],
            before=_side(row, "before"),
            after=_side(row, "after"),
        )
        for row in connection.execute(query).mappings()
    ]


def _side(row: Any, side: str) -> models.RunChangeSide:
    counts = {name: row[f"{side}_{name}"] for name in ("unique", "ambiguous", "unmatched")}
    return models.RunChangeSide(
        id=row[f"{side}_id"], counts=models.OutcomeCounts(**counts), status=row[f"{side}_status"]
    )


def _pairs(selected: pages.ResultFilter, other: str, latest: int | None = None) -> Subquery:
    """Query for the ids and statuses of the two current results of each batch in both runs."""
    again, new = batches.alias("again"), results.alias("new")
    of_run = selected.conditions()
    if latest is not None:
        # Limit first: to look for partners of millions of batches takes minutes.
        chosen = pages.newest_first(select(results.c.id).where(*of_run))
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


def _transitions(connection: Connection, pairs: Subquery) -> dict[tuple[str, str, bool], int]:
    """Number of stars by outcome in one run and in the other, and by equality of catalog star."""
    old, new = tables.star_results.alias("old_star"), tables.star_results.alias("new_star")
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


def _sums(stars: Iterable[tuple[str, int]]) -> models.OutcomeCounts:
    counts: Counter[str] = Counter()
    for outcome, number in stars:
        counts[outcome] += number
    return models.OutcomeCounts(
        **{name: counts[name] for name in models.OutcomeCounts.__struct_fields__}
    )


def _angles_arcsec(connection: Connection, pairs: Subquery) -> list[Vector]:
    """Angles in arcsec between the attitudes of result pairs that both have one, in arrays."""
    old, new = tables.solutions.alias("old_solution"), tables.solutions.alias("new_solution")
    query = (
        select(*(each.c[name] for each in (old, new) for name in pages.QUATERNION))
        .select_from(pairs)
        .join(old, old.c.result_id == pairs.c.before)
        .join(new, new.c.result_id == pairs.c.after)
    )
    with connection.execute(query, execution_options={"yield_per": _READ_AT_ONCE}) as read:
        return [_between(np.array(rows, dtype=float)) for rows in read.partitions()]


def _between(rows: Vector) -> Vector:
    """Angles (n,) in arcsec between the two quaternions in each row (n, 8); accurate near zero."""
    one, other = rows[:, :4], rows[:, 4:]
    apart = np.minimum(np.linalg.norm(one - other, axis=1), np.linalg.norm(one + other, axis=1))
    return np.asarray(4.0 * np.arcsin(np.minimum(1.0, apart / 2.0)) * ARCSEC_PER_RADIAN)


GROUP = 2_000
"""Number of batches of a run compared at a time."""
_COMPARED = ("solution", "stars")
_AT_ONCE = 1_000


def both_runs(
    connection: Connection,
    archive: Archive,
    selected: pages.ResultFilter,
    other: str,
    latest: int | None,
) -> Iterator[OpenedBatches]:
    """Open the selected batches together with those of the same names in another run, latest first.

    At most the `latest` of those selected.  Recorded and archived ones are copied into one
    database, so that a batch of either run may be in either place.
    """
    named = (results.c.spacecraft, batches.c.batch)
    query = select(*pages.PLACE, *named).join_from(
        results, batches, results.c.batch_id == batches.c.id
    )
    query = query.where(*selected.conditions())
    listing, left = pages.Listing(archive, query, selected, newest_first=True), latest
    beyond: pages.Place | None = None
    while left is None or left > 0:
        limit = GROUP if left is None else min(GROUP, left)
        found = listing.first_rows(connection, limit, beyond).rows
        if not found:
            return
        names = [(each.row.spacecraft, each.row.batch) for each in found]
        own: dict[bool, list[str]] = {True: [], False: []}
        for each in found:
            own[each.archived].append(each.row.batch_id)
        recorded = [*own[False], *_named(connection, batches, other, names)]
        archived = [*own[True], *_named(connection, tables.archived_batches, other, names)]
        yield archive.together(connection, recorded, archived, _COMPARED)
        beyond = found[-1].place
        left = None if left is None else left - len(found)
        if len(found) < limit:
            return


def _named(
    connection: Connection, table: Table, run: str, names: Sequence[tuple[str, str]]
) -> list[str]:
    """Ids of a run's batches by spacecraft and name."""
    c = table.c
    found: list[str] = []
    for first in range(0, len(names), _AT_ONCE):
        chunk = names[first : first + _AT_ONCE]
        query = select(c.id).where(c.run == run, tuple_(c.spacecraft, c.batch).in_(chunk))
        found += connection.scalars(query)
    return found


_SHOWN_BY_HOUR_S = 30 * DAY_S
"""Longest period in seconds with cells of an hour; a longer one has cells of whole days."""
_MOST_CELLS_OF_DAYS = 732
"""Largest number of one-day cells in a comparison of runs: two years."""
_SHARES = ("ambiguous", "unmatched")


def cell_width_s(period_s: float) -> int:
    """Width in seconds of the time cells for a period: an hour, a day or several days."""
    if period_s <= _SHOWN_BY_HOUR_S:
        return HOUR_S
    return DAY_S * math.ceil(period_s / (DAY_S * _MOST_CELLS_OF_DAYS))


def run_rates(
    connection: Connection, spacecraft: str, runs: Sequence[str], start: Utc | None, end: Utc | None
) -> models.RatesOfRuns | None:
    """Rates of stars by outcome for each run, in total and over time.

    The period is that between `start` and `end`, and at most the days that all runs have; None
    without common days.
    """
    common = _common_days(connection, spacecraft, runs)
    if common is None:
        return None
    start = max(start or common[0], common[0], key=attrgetter("tai_ns"))
    end = min(end or common[1], common[1], key=attrgetter("tai_ns"))
    if start.tai_ns >= end.tai_ns:
        return None
    first_s, end_s = unix_seconds([start.tai_ns, end.tai_ns]).tolist()
    width_s = cell_width_s(end_s - first_s)
    level: Bucket = "hour" if width_s == HOUR_S else "day"
    cells = int(-(-end_s // width_s) - first_s // width_s)
    rates = []
    for run in runs:
        span = BucketFilter(spacecraft, run, start, end)
        buckets = read_buckets(connection, span, level, tables.COUNTS)
        place = (buckets["unix_s"] // width_s - first_s // width_s).astype(int)
        rates.append(
            models.RunRates(
                run=run,
                totals={name: int(buckets[name].sum()) for name in tables.COUNTS},
                shares={name: _share(buckets, name, place, cells) for name in _SHARES},
            )
        )
    return models.RatesOfRuns(start=start, end=end, cell_s=width_s, runs=tuple(rates))


def _common_days(
    connection: Connection, spacecraft: str, runs: Sequence[str]
) -> tuple[Utc, Utc] | None:
    c = tables.rollups_daily.c
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
    """Fraction of the observed stars with an outcome in each time cell; NaN without a star."""
    part, whole = (
        np.bincount(place, weights=buckets[column], minlength=cells)
        for column in (name, "observed")
    )
    return np.asarray(np.divide(part, whole, out=np.full(cells, np.nan), where=whole > 0))
