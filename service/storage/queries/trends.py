"""Histories of quantities, reduced to a chart's points with extremes kept; and worst batches."""

from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from sqlalchemy import Case, ColumnElement, Connection, Select, Table, case, func, select, tuple_

from service.contract.spacecraft import History, Numbers, RankedBatch, Series
from service.storage.archived import holds_any
from service.storage.queries import time_buckets
from service.storage.queries.pages import PLACE, ResultFilter, latest_time, newest_first
from service.storage.queries.results import summary_fields, summary_query
from service.storage.queries.time_buckets import BucketFilter, Columns
from service.storage.recording.result_metrics import OF_TRACKERS, value_sql
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, results, tracker_values
from service.times import DAY_S, HOUR_S, Utc, bucket_start, shifted, unix_seconds, utc_now
from service.trends.limits import RecordedSample, Sample
from service.trends.measures import BatchShare, Rate, StarShare
from service.trends.quantities import (
    QUANTITIES,
    QuantityName,
    RankedName,
    Subject,
    quantity_and_tracker,
    sampler,
)
from service.vectors import Vector

Integers = npt.NDArray[np.intp]

Strategy = Literal["minmax", "latest"]
Source = Literal["batch", "hour", "day"]
MAX_SIZE = 1_500
PAGE = 1_000
"""Number of batches read at a time where all batches of a period are requested."""
LEAST_OF_CUT = 10
"""Least number of batches that give a rate for a bucket cut by the end of a span."""
MAX_HOURS_READ = 1_500
"""Largest number of hours read for an answer; a longer period is read from days."""

WIDTHS_S = (
    *(1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800),
    *(HOUR_S * hours for hours in (1, 2, 3, 6, 12)),
    *(DAY_S * days for days in (1, 2, 5, 10, 30)),
)


@dataclass(frozen=True)
class HistoryRequest:
    """Request for a history: spacecraft, run, quantities, and method of reduction.

    Without an end it ends just after the latest batch, without a start it begins a day before its
    end.
    """

    spacecraft: str
    run: str
    start: Utc | None
    end: Utc | None
    quantities: Sequence[QuantityName]
    strategy: Strategy = "latest"
    size: int = PAGE
    """Largest number of points in the history."""
    tracker: str | None = None
    """Tracker whose values are requested, for a spacecraft with several; None: the whole."""


def history(connection: Connection, request: HistoryRequest) -> History:
    """Read a history of quantities by buckets or batches, in columns, oldest first."""
    span = _span(connection, request)
    if span is None:
        return _empty(request)
    if request.strategy == "latest":
        return _latest(connection, span, request)
    width_s, source = _resolution(connection, span, request.size)
    if source == "batch":
        cells = time_buckets.read_steps(connection, span, width_s)
    else:
        cells = time_buckets.read_buckets(connection, span, source)
    return _thinned(cells, span, width_s, source, request)


def latest_time_of(
    connection: Connection, run: str, spacecraft: Collection[str] | None, *, now: Utc
) -> Utc | None:
    """Time of the latest batch in a run of the given spacecraft, or of any for None."""
    names = [None] if spacecraft is None else spacecraft
    found = (latest_time(connection, ResultFilter(run, name), now) for name in names)
    return max(filter(None, found), key=lambda moment: moment.tai_ns, default=None)


def _span(connection: Connection, request: HistoryRequest) -> BucketFilter | None:
    spacecraft, run, end = request.spacecraft, request.run, request.end
    if end is None:
        latest = latest_time(connection, ResultFilter(run, spacecraft), utc_now())
        if latest is None:
            return None
        end = shifted(latest, 1e-6)
    begin = shifted(end, -DAY_S) if request.start is None else request.start
    if begin.tai_ns > end.tai_ns:
        end = begin
    return BucketFilter(spacecraft, run, begin, end, request.tracker)


def _resolution(connection: Connection, span: BucketFilter, size: int) -> tuple[int, Source]:
    """Width of a history's buckets that gives at most `size` points, and the table to read."""
    first_s, end_s = unix_seconds([span.start.tai_ns, span.end.tai_ns]).tolist()
    width_s = next((w for w in WIDTHS_S if _buckets(first_s, end_s, w) <= size), 0)
    if not width_s:
        # The period is longer than the widest steps allow: use multiples of thirty days.
        width_s = WIDTHS_S[-1] * (1 + int((end_s - first_s) / (WIDTHS_S[-1] * max(size - 1, 0.5))))
    if width_s < HOUR_S:
        are_few = (
            end_s - first_s <= HOUR_S
            or time_buckets.batches_about(connection, span) <= time_buckets.MAX_BATCHES_SUMMED
        )
        archived = holds_any(connection, span.spacecraft, span.run, span.start, span.end)
        if are_few and not archived:
            return width_s, "batch"
        width_s = HOUR_S
    if width_s < DAY_S and end_s - first_s > MAX_HOURS_READ * HOUR_S:
        width_s = DAY_S
    return width_s, "day" if width_s >= DAY_S else "hour"


def _buckets(first_s: float, end_s: float, width_s: int) -> int:
    return int(np.ceil(end_s / width_s) - first_s // width_s)


def _thinned(
    cells: Columns, span: BucketFilter, width_s: int, source: Source, request: HistoryRequest
) -> History:
    number = np.floor(cells["unix_s"] / width_s)
    _, first = np.unique(number, return_index=True)
    unix_s = number[first] * width_s
    number_of = np.add.reduceat(cells["batches"], first) if len(first) else cells["batches"]
    reduced = _Reduced(cells, first, _covered_h(unix_s, width_s, span, number_of))
    counts = number_of.astype(int).tolist()
    return History(
        **_about(span),
        strategy=request.strategy,
        bucket_s=width_s,
        source=source,
        thinned=sum(counts) > len(counts),
        unix_s=unix_s.tolist(),
        batches=counts,
        series={name: reduced.series(name) for name in request.quantities},
    )


def _covered_h(unix_s: Vector, width_s: int, span: BucketFilter, counts: Vector) -> Vector:
    """Duration in hours of each bucket's part in the span; NaN where a rate would be unreliable.

    At the ends of a span, one batch more or less would double the rate of a few.
    """
    begin_s, end_s = unix_seconds([span.start.tai_ns, span.end.tai_ns])
    covered_s = np.minimum(unix_s + width_s, end_s) - np.maximum(unix_s, begin_s)
    has_no_rate = (covered_s < width_s) & (counts < LEAST_OF_CUT)
    return np.asarray(np.where(has_no_rate, np.nan, covered_s)) / HOUR_S


class _Reduced:
    """Columns of narrow buckets merged into wider ones that begin at the rows `first`."""

    def __init__(self, cells: Columns, first: Integers, covered_h: Vector) -> None:
        self._cells, self._first, self._covered_h = cells, first, covered_h

    def sum(self, name: str) -> Vector:
        return self._reduce(np.add, self._cells[name])

    def series(self, name: QuantityName) -> Series:
        """History of one quantity: unit, number of batches with a value, mean, least and greatest.

        Columns that the rollups lack are NaN.
        """
        cells, quantity = self._cells, QUANTITIES[name]
        count = self.sum("batches")
        low = high = np.full(len(cells["batches"]), np.nan)
        if quantity.rolled_up:
            low, high = cells[f"{name}_min"], cells[f"{name}_max"]
        match quantity.source:
            case StarShare(part):
                mean = _over(self._reduce(np.add, part(cells)), self.sum("observed"))
            case BatchShare(part):
                hit = part(cells)
                mean = _over(self._reduce(np.add, hit), count)
                # Each batch is either counted or not: a bucket has all, some, or none.
                low, high = (hit == cells["batches"]).astype(float), (hit > 0).astype(float)
            case Rate():
                mean = _over(count, self._covered_h)
                return _series(name, count, mean, mean, mean)
            case _ if quantity.rolled_up:
                count = self.sum(f"{name}_n")
                mean = _over(self.sum(f"{name}_sum"), count)
            case _:
                count = np.zeros_like(count)
                mean = _over(count, count)
        return _series(name, count, mean, self._reduce(np.fmin, low), self._reduce(np.fmax, high))

    def _reduce(self, ufunc: np.ufunc, values: Vector) -> Vector:
        if len(self._first) == len(values):
            return values
        return np.asarray(ufunc.reduceat(values, self._first))


def _over(part: Vector, whole: Vector) -> Vector:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(whole > 0, part / whole, np.nan))


def _series(name: QuantityName, count: Vector, mean: Vector, low: Vector, high: Vector) -> Series:
    return Series(
        unit=QUANTITIES[name].unit,
        count=count.astype(int).tolist(),
        mean=_listed(mean),
        min=_listed(low),
        max=_listed(high),
    )


def _listed(values: Vector) -> Numbers:
    unknown = np.isnan(values)
    if unknown.any():
        values = values.astype(object)
        values[unknown] = None
    return list(values.tolist())


_VALUES = (*tables.COUNTED, "status", *tables.MEASURED)
_SHOWN = (results.c.id, *PLACE, batches.c.batch, batches.c.time)
_OF_BATCHES = select(*(results.c[name] for name in _VALUES), *_SHOWN).join_from(
    results, batches, results.c.batch_id == batches.c.id
)
_OF_TRACKERS = (
    select(*(tracker_values.c[name] for name in _VALUES), *_SHOWN)
    .join_from(results, batches, results.c.batch_id == batches.c.id)
    .join(tracker_values, tracker_values.c.batch_id == results.c.batch_id)
)


def _values_query(span: BucketFilter) -> Select[Any]:
    """Query for the values of each batch in a span, or of one tracker in each batch."""
    chosen = ResultFilter(span.run, span.spacecraft, span.start, span.end).conditions()
    if span.tracker is None:
        return _OF_BATCHES.where(*chosen)
    return _OF_TRACKERS.where(*chosen, tracker_values.c.tracker == span.tracker)


def every_batch(
    reading: Callable[[], AbstractContextManager[Connection]], request: HistoryRequest
) -> Iterator[History]:
    """All batches of a period in columns as `history` returns them, oldest first, in pages.

    At least one page is given, which may be empty.  Between two pages no connection is held, so
    that a slow reader blocks no other.
    """
    with reading() as connection:
        span = _span(connection, request)
    if span is None:
        yield _empty(request)
        return
    query = _values_query(span).order_by(*PLACE).limit(request.size)
    beyond = query
    while True:
        with reading() as connection:
            rows = connection.execute(beyond).mappings().all()
        if rows or beyond is query:
            yield _of_batches(rows, _about(span), request)
        if len(rows) < request.size:
            return
        last = rows[-1]["time_ns"], rows[-1]["batch_id"]
        beyond = query.where(tuple_(*PLACE) > tuple_(*last))


def _latest(connection: Connection, span: BucketFilter, request: HistoryRequest) -> History:
    # Ask for one more than requested, which shows if there are more.
    query = newest_first(_values_query(span)).limit(request.size + 1)
    rows = list(connection.execute(query).mappings())
    thinned = len(rows) > request.size
    return _of_batches(rows[: request.size][::-1], _about(span), request, thinned=thinned)


def _about(span: BucketFilter) -> Row:
    """Fields of a history that name its spacecraft, run and period."""
    return {
        "spacecraft": span.spacecraft,
        "run": span.run,
        "start": span.start.text,
        "end": span.end.text,
    }


def _of_batches(
    rows: Sequence[Any], about: Row, request: HistoryRequest, *, thinned: bool = False
) -> History:
    return History(
        **about,
        strategy=request.strategy,
        bucket_s=None,
        source="batch",
        thinned=thinned,
        unix_s=unix_seconds([row["time_ns"] for row in rows]).tolist(),
        time=[row["time"] for row in rows],
        id=[row["id"] for row in rows],
        batch=[row["batch"] for row in rows],
        series={
            name: Series(
                unit=QUANTITIES[name].unit, value=list(map(QUANTITIES[name].value_of, rows))
            )
            for name in request.quantities
        },
    )


def _empty(request: HistoryRequest) -> History:
    """History without points, for a run that has no batches of the spacecraft."""
    start = None if request.start is None else request.start.text
    about: Row = {"spacecraft": request.spacecraft, "run": request.run, "start": start, "end": None}
    if request.strategy == "latest":
        return _of_batches([], about, request)
    nothing = np.empty(0)
    return History(
        **about,
        strategy=request.strategy,
        bucket_s=None,
        source="batch",
        thinned=False,
        unix_s=[],
        batches=[],
        series={
            name: _series(name, nothing, nothing, nothing, nothing) for name in request.quantities
        },
    )


# The worst batches of a period by a quantity, found without reading all batches.
#
# The rollups have the greatest value of every hour.  Hours are read in descending order of that
# value until no batch of the remaining hours can be worse than those found.

RankedRow = tuple[float, int, str, str]
"""Sort key of a batch among the worst: (badness, time_ns, batch_id, result id)."""


def worst_batches(
    connection: Connection,
    selected: ResultFilter,
    by: RankedName,
    limit: int,
    tracker: str | None = None,
) -> list[RankedBatch]:
    """The `limit` batches with the greatest value, the worst first, newest first among equals.

    An offset counts by its absolute value.  With a tracker, of a spacecraft with several, the
    values are the tracker's.
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
    """Join the values of a tracker to a query over `results`; the same query for None."""
    if tracker is None:
        return query
    return query.select_from(OF_TRACKERS).where(tracker_values.c.tracker == tracker)


def _hours(
    connection: Connection, selected: ResultFilter, by: RankedName, limit: int, tracker: str | None
) -> Iterator[tuple[int, int, float]]:
    """Hours of a period as (begin, end, greatest value), in descending order of that value.

    An hour that the period cuts is narrowed; its greatest value may lie outside.
    """
    rollup = tables.rollups_hourly if tracker is None else tables.tracker_rollups_hourly
    table = rollup.c
    most = _greatest(by, rollup)
    query = select(table.bucket, most).where(
        table.spacecraft == selected.spacecraft,
        table.run == selected.run,
        most.is_not(None),
        *time_buckets.buckets_between(table.bucket, selected.start, selected.end, HOUR_S),
    )
    if tracker is not None:
        query = query.where(table.tracker == tracker)
    # Each of `limit` whole hours holds a batch at least as bad as any in later hours; two more,
    # since the ends of the period may cut off the worst batch of an hour.
    query = query.order_by(most.desc(), table.bucket.desc()).limit(limit + 2)
    for bucket, greatest in connection.execute(query).all():
        begin, over = (bucket_start(bucket + ahead, HOUR_S).tai_ns for ahead in (0, 1))
        if selected.start is not None:
            begin = max(begin, selected.start.tai_ns)
        if selected.end is not None:
            over = min(over, selected.end.tai_ns)
        if begin < over:
            yield begin, over, float(greatest)


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


def samples_until(
    connection: Connection, batch_id: str, subject: Subject, limit: int
) -> list[RecordedSample]:
    """Samples that batches had when recorded, up to the time of one of them; the latest of these.

    At most `limit` batches of its spacecraft and run are read; empty if it is not in the database.
    """
    first = results.alias()
    _, tracker = quantity_and_tracker(subject)
    values = tracker_values if tracker else first
    columns = [values.c[name] for name in (*tables.COUNTED, "status", *tables.MEASURED)]
    last = results.alias()
    query = (
        select(*PLACE, first.c.seq, *columns)
        .select_from(results)
        .join(last, last.c.id == batch_id)
        .join(first, first.c.id == results.c.batch_id)
        .where(
            results.c.current,
            results.c.spacecraft == last.c.spacecraft,
            results.c.run == last.c.run,
            results.c.time_ns <= last.c.time_ns,
        )
    )
    if tracker:
        same_batch = tracker_values.c.batch_id == results.c.batch_id
        query = query.join(tracker_values, same_batch).where(tracker_values.c.tracker == tracker)
    sample_of = sampler(subject)
    rows = map(dict, connection.execute(newest_first(query).limit(limit)).mappings())
    samples = [(sample_of(row, {tracker: row}), row["seq"], row["batch_id"]) for row in rows]
    return [RecordedSample(*each) for each in samples if each[0] is not None]


def latest_samples(
    connection: Connection, selected: ResultFilter, subject: Subject, limit: int
) -> tuple[list[int], list[Sample]]:
    """Times (ns of TAI) of the latest batches, and the samples of those with a value, in order."""
    _, tracker = quantity_and_tracker(subject)
    values = tracker_values if tracker else results
    columns = [values.c[name] for name in (*tables.COUNTED, "status", *tables.MEASURED)]
    query = select(results.c.time_ns, *columns).where(*selected.conditions())
    if tracker:
        same_batch = tracker_values.c.batch_id == results.c.batch_id
        of_tracker = tracker_values.c.tracker == tracker
        query = query.join_from(results, tracker_values, same_batch).where(of_tracker)
    query = newest_first(query).limit(limit)
    sample_of = sampler(subject)
    rows = [dict(row) for row in connection.execute(query).mappings()][::-1]
    samples = [sample_of(row, {tracker: row}) for row in rows]
    return [row["time_ns"] for row in rows], [each for each in samples if each is not None]
