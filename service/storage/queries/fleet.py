"""State of all spacecraft in a run, read in a few queries however large the fleet."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import numpy as np
from msgspec import structs
from sqlalchemy import BigInteger, Connection, Select, bindparam, case, func, select

from service.contract.alarms import Alarm, AlarmSummary
from service.contract.answers import Summary
from service.contract.spacecraft import Overview, OverviewRow, Sparkline, WindowCounts
from service.intervals import share_of_sums
from service.missions.mission import Mission
from service.observations.schema import LIVE
from service.storage.archived import holds_any
from service.storage.queries import time_buckets
from service.storage.queries.fleet_rows import DayCounts, FleetRow, KnownAttitude, TrackerCounts
from service.storage.queries.histories import live_state
from service.storage.queries.pages import newest_first
from service.storage.queries.results import summary_of, summary_query
from service.storage.queries.time_buckets import BucketFilter
from service.storage.queries.trends import latest_time_of
from service.storage.recording.result_metrics import SUMMED
from service.storage.recording.unsaved_result import AHEAD_NS
from service.storage.sql import tables
from service.storage.sql.columns import Row
from service.storage.sql.tables import COUNTS, batches, results
from service.times import (
    DAY_S,
    HOUR_S,
    UNIX_DAY,
    Utc,
    bucket_start,
    recorded_utc,
    shifted,
    unix_seconds,
)
from service.trends.limits import Severity
from service.vectors import Matrix

Period = Literal["hour", "day", "week"]
PERIODS_S: Mapping[Period, int] = {"hour": HOUR_S, "day": DAY_S, "week": 7 * DAY_S}
CELLS_S: Mapping[Period, int] = {"hour": 120, "day": 1800, "week": 4 * HOUR_S}
"""Width of a chart's time cell in seconds, by period; each divides a day."""
MOST_SUMMED = 20_000
"""Largest number of a day's batches that are summed one by one; above it, hours are read."""

_TICK_S = 1e-6
_Sums = Sequence[tuple[Any, ...]]
"""Database rows of counts: spacecraft, POSIX time at the start of a cell, and the counts."""


@dataclass(frozen=True)
class FleetCells:
    """Counts in cells of equal width in time: a row for each spacecraft, a column for each cell."""

    start_s: float
    """POSIX time at which the first cell begins, in seconds."""
    width_s: int
    counts: Mapping[str, Matrix]
    """Star and batch counts (spacecraft, cells) by name, such as `observed`; 0 without a batch."""

    @property
    def columns(self) -> int:
        """Number of time cells of the fleet's chart."""
        return int(self.counts["batches"].shape[1])


@dataclass(frozen=True)
class Fleet:
    """State of every spacecraft in a run; `cells` has the same rows as `rows`."""

    run: str
    as_of: Utc | None
    """Time of the newest batch of the run's spacecraft; far-ahead live ones count only alone."""
    alarms: AlarmSummary
    rows: tuple[FleetRow, ...]
    cells: FleetCells | None


def fleet(
    connection: Connection,
    missions: Iterable[Mission],
    run: str,
    period: Period,
    now: Utc,
    active: Sequence[Alarm],
    spacecraft: Collection[str] | None = None,
) -> Fleet:
    """Read the state of every mission in a run; periods end with the run's latest batch.

    `active` are the alarms of the run that are not cleared.  With `spacecraft`, only batches of
    these count.
    """
    named = {mission.name: mission for mission in missions}
    active = [each for each in active if each.spacecraft in named]
    as_of, rows = fleet_rows(connection, named.values(), run, now, active, spacecraft)
    cells = None if as_of is None else _cells(connection, list(named), run, as_of, period)
    return Fleet(run, as_of, summary(active), rows, cells)


def fleet_rows(
    connection: Connection,
    missions: Iterable[Mission],
    run: str,
    now: Utc,
    active: Sequence[Alarm],
    spacecraft: Collection[str] | None = None,
) -> tuple[Utc | None, tuple[FleetRow, ...]]:
    """Read the time of a run's newest batch, and the state of every mission; see `fleet`."""
    found = list(missions)
    as_of = latest_time_of(connection, run, spacecraft, now=now)
    names = [each.name for each in found]
    facts = None if as_of is None else _Facts(connection, names, run, as_of, now)
    return as_of, tuple(_row(each, facts, run, now, active) for each in found)


MOST_DOUBLINGS = 64
"""Excess of a value that has fallen to zero below its bound."""


def present_rank(alarm: Alarm) -> tuple[bool, int, int]:
    """Sort key of an alarm: shelved ones lowest, then present severity, then excess over the bound.

    The excess is counted in doublings of the bound, so that alarms about as far out are equal:
    where the stars of one tracker go wrong, those of another soon leave their limits by less.
    """
    if alarm.current_severity is None:
        return alarm.state != "shelved", 0, 0
    severity = Severity[alarm.current_severity.upper()]
    return alarm.state != "shelved", severity, _doublings_beyond(alarm)


def _doublings_beyond(alarm: Alarm) -> int:
    """Number of doublings by which the latest value of an alarm is beyond its bound."""
    value, bound = abs(alarm.latest.value), abs(alarm.raised.bound)
    # The bound is that of the worst severity so far, and is no measure of a lower one.
    if alarm.current_severity != alarm.severity or not bound or not math.isfinite(value):
        return 0
    is_above = abs(alarm.worst.value) >= bound
    least = bound / 2**MOST_DOUBLINGS
    doublings = math.log2(max(value, least) / bound)
    return min(MOST_DOUBLINGS, max(0, int(doublings if is_above else -doublings)))


def summary(found: Sequence[Alarm]) -> AlarmSummary:
    """Count active alarms by state, with the present severity of the worst that is not shelved."""
    states = ("open", "acknowledged", "shelved")
    worst = max(found, key=present_rank, default=None)
    return AlarmSummary(
        **{state: sum(each.state == state for each in found) for state in states},
        worst=None if worst is None or worst.state == "shelved" else worst.current_severity,
    )


class _Facts:
    """Data for the state of every spacecraft, by name or by the id of its latest result."""

    def __init__(
        self, connection: Connection, names: list[str], run: str, as_of: Utc, now: Utc
    ) -> None:
        self.as_of = as_of
        ids = _latest_ids(connection, names, run, now)
        self.latest = _summaries(connection, ids)
        self.trackers = _tracker_counts(connection, ids.values())
        unsolved = [name for name, each in self.latest.items() if each.status is None]
        solved_ids = {name: id for name, id in ids.items() if name not in unsolved}
        solved_ids |= _latest_ids(connection, unsolved, run, now, solved=True)
        self.attitudes = _attitudes(connection, solved_ids)
        self.last_hour = _last_hours(connection, names, run, as_of)
        self.days = _days(connection, names, run, as_of)


def _row(
    mission: Mission, facts: _Facts | None, run: str, now: Utc, active: Sequence[Alarm]
) -> FleetRow:
    name = mission.name
    batch = None if facts is None else facts.latest.get(name)
    about = name, mission.description, mission.retired
    alarms = tuple(each for each in active if each.spacecraft == name)
    if facts is None or batch is None:
        return FleetRow(*about, state="no_batches", alarms=alarms)
    return FleetRow(
        *about,
        state=batch.status or "no_attitude",
        alarms=alarms,
        latest_batch=batch,
        last_attitude=facts.attitudes.get(name),
        trackers=_of_every_tracker(mission, facts.trackers.get(batch.id, {})),
        age_s=max(0.0, (facts.as_of.tai_ns - recorded_utc(batch.time).tai_ns) * 1e-9),
        received_age_s=(now.tai_ns - recorded_utc(batch.received).tai_ns) * 1e-9,
        last_hour=facts.last_hour.get(name),
        days=facts.days.get(name, DayCounts()),
        is_live=run == LIVE,
    )


def _of_every_tracker(mission: Mission, counted: Mapping[str, Any]) -> tuple[TrackerCounts, ...]:
    """Star counts of a mission's trackers in its order; zero for a tracker without a star."""
    names = [each.name for each in mission.trackers]
    return tuple(TrackerCounts(name, *counted.get(name, (0, 0))) for name in names)


def _latest_ids(
    connection: Connection, names: list[str], run: str, now: Utc, solved: bool = False
) -> dict[str, str]:
    """Id of each spacecraft's newest current result, chosen as `pages.newest` does."""
    found: dict[str, str] = {}
    bounds_ns = [now.tai_ns + AHEAD_NS] if run == LIVE else []
    for bound_ns in (*bounds_ns, (1 << 63) - 1):
        missing = [name for name in names if name not in found]
        if missing:
            asked = {"names": missing, "run": run, "bound_ns": bound_ns}
            rows = connection.execute(_newest_query(solved), asked)
            found |= {name: id for name, id in rows if id is not None}
    return found


@cache
def _newest_query(solved: bool) -> Select[Any]:
    # The service notes every spacecraft of a mission file with its settings when it starts.
    known = select(tables.mission_uses.c.spacecraft.label("name")).distinct()
    asked = known.where(
        tables.mission_uses.c.spacecraft.in_(bindparam("names", expanding=True))
    ).subquery()
    newest = select(results.c.id).where(
        results.c.current,
        results.c.spacecraft == asked.c.name,
        results.c.run == bindparam("run"),
        results.c.time_ns <= bindparam("bound_ns", type_=BigInteger),
    )
    if solved:
        newest = newest.where(results.c.status.is_not(None))
    newest = newest_first(newest).limit(1).correlate(asked)
    return select(asked.c.name, newest.scalar_subquery())


def latest_inputs(connection: Connection, names: Iterable[str], now: Utc) -> Sequence[str]:
    """Latest live batch of each named spacecraft, as its recorded canonical JSON; in no order."""
    ids = _latest_ids(connection, list(names), LIVE, now)
    query = select(batches.c.input).join_from(results, batches, results.c.batch_id == batches.c.id)
    return connection.scalars(query.where(results.c.id.in_(list(ids.values())))).all()


def _summaries(connection: Connection, ids: Mapping[str, str]) -> dict[str, Summary]:
    query = summary_query().where(results.c.id.in_(list(ids.values())))
    found = (summary_of(row) for row in connection.execute(query).mappings())
    return {each.spacecraft: each for each in found}


def _tracker_counts(
    connection: Connection, ids: Iterable[str]
) -> dict[str, dict[str, tuple[int, int]]]:
    """Number of stars and of unique stars of each tracker, by the id of the result."""
    columns = tables.star_results.c
    unique = func.sum(case((columns.outcome == "unique", 1), else_=0))
    query = (
        select(columns.result_id, columns.tracker, func.count(), unique)
        .where(columns.result_id.in_(list(ids)))
        .group_by(columns.result_id, columns.tracker)
    )
    found: dict[str, dict[str, tuple[int, int]]] = {}
    for id, tracker, observed, sure in connection.execute(query):
        found.setdefault(id, {})[tracker] = (int(observed), int(sure))
    return found


def _attitudes(connection: Connection, ids: Mapping[str, str]) -> dict[str, KnownAttitude]:
    columns = tables.solutions.c
    query = (
        select(
            results.c.spacecraft,
            results.c.id,
            batches.c.time,
            columns.status,
            *(columns.p11, columns.p22, columns.p33),
        )
        .join_from(results, batches, results.c.batch_id == batches.c.id)
        .join(tables.solutions, columns.result_id == results.c.id)
        .where(results.c.id.in_(list(ids.values())))
    )
    return {
        name: KnownAttitude(id, time, status, (_root(p11), _root(p22), _root(p33)))
        for name, id, time, status, p11, p22, p33 in connection.execute(query)
    }


def _root(variance: float) -> float:
    return math.sqrt(max(variance, 0.0))


def _last_hours(
    connection: Connection, names: list[str], run: str, as_of: Utc
) -> dict[str, WindowCounts]:
    """Star and batch counts by spacecraft over the hour that ends with the run's latest batch."""
    # The window includes the latest batch, and excludes one exactly an hour before it.
    end = shifted(as_of, _TICK_S)
    start = shifted(end, -HOUR_S)
    query = select(results.c.spacecraft, *(SUMMED[name] for name in COUNTS))
    asked = {"names": names, "run": run, "start_ns": start.tai_ns, "end_ns": end.tai_ns}
    rows = connection.execute(
        query.where(*time_buckets.IN_PERIOD, _IN_NAMES).group_by(results.c.spacecraft), asked
    )
    return {
        name: WindowCounts(
            start=start.text, end=as_of.text, **dict(zip(COUNTS, map(int, counts), strict=True))
        )
        for name, *counts in rows
    }


def _cells(
    connection: Connection, names: list[str], run: str, as_of: Utc, period: Period
) -> FleetCells:
    width_s, span_s = CELLS_S[period], PERIODS_S[period]
    if period == "day":
        # Hours show the number of batches, and replace them where there are too many.
        rows = _hours(connection, names, run, as_of, span_s, HOUR_S)
        if sum(row[2] for row in rows) > MOST_SUMMED:
            return _table(names, rows, as_of, span_s, HOUR_S)
    if width_s < HOUR_S:
        rows = _steps(connection, names, run, as_of, span_s, width_s)
    else:
        rows = _hours(connection, names, run, as_of, span_s, width_s)
    return _table(names, rows, as_of, span_s, width_s)


def _table(
    names: list[str], rows: Iterable[tuple[Any, ...]], as_of: Utc, span_s: int, width_s: int
) -> FleetCells:
    """Arrange counts in tables with a row for each spacecraft and a column for each time cell."""
    end_s = float(unix_seconds([as_of.tai_ns])[0])
    start_s = (end_s - span_s) // width_s * width_s + width_s
    place = {name: k for k, name in enumerate(names)}
    counts = {name: np.zeros((len(names), span_s // width_s)) for name in COUNTS}
    found = [(place[row[0]], int((row[1] - start_s) // width_s), row[2:]) for row in rows]
    kept = [each for each in found if 0 <= each[1] < span_s // width_s]
    if kept:
        at = np.array([(each[0], each[1]) for each in kept]).T
        values = np.array([each[2] for each in kept], dtype=float).T
        for name, column in zip(COUNTS, values, strict=True):
            np.add.at(counts[name], tuple(at), column)
    return FleetCells(start_s, width_s, counts)


def _hours(
    connection: Connection, names: list[str], run: str, as_of: Utc, span_s: int, width_s: int
) -> _Sums:
    """Star and batch counts by spacecraft and cell of whole hours, from the hourly rollups."""
    table, hours = tables.rollups_hourly.c, width_s // HOUR_S
    first = shifted(as_of, -span_s).bucket(HOUR_S)
    cell = (table.bucket // hours).label("cell")
    query = (
        select(table.spacecraft, cell, *(func.sum(table[name]) for name in COUNTS))
        .where(
            table.run == run,
            table.spacecraft.in_(names),
            table.bucket.between(first, as_of.bucket(HOUR_S)),
            table.batches > 0,
        )
        .group_by(table.spacecraft, cell)
    )
    return [
        (name, number * width_s - UNIX_DAY * DAY_S, *counts)
        for name, number, *counts in connection.execute(query)
    ]


def last_day(as_of: Utc) -> tuple[Utc, Utc]:
    """Start and end of a run's last day: 24 whole hours, the last with the latest batch."""
    hour = as_of.bucket(HOUR_S) + 1
    return bucket_start(hour - 24, HOUR_S), bucket_start(hour, HOUR_S)


def _days(connection: Connection, names: list[str], run: str, as_of: Utc) -> dict[str, DayCounts]:
    """Star counts by spacecraft of the last day of a run, and of the day before."""
    begin_s = float(unix_seconds([last_day(as_of)[0].tai_ns])[0])
    hours: dict[str, tuple[list[Any], list[Any]]] = {name: ([], []) for name in names}
    observed, ambiguous = (COUNTS.index(each) for each in ("observed", "ambiguous"))
    for name, at_s, *counts in _hours(connection, names, run, as_of, 2 * DAY_S, HOUR_S):
        if at_s >= begin_s - DAY_S and counts[observed]:
            hours[name][at_s < begin_s].append((int(counts[observed]), int(counts[ambiguous])))
    return {name: _day_counts(*map(np.array, each)) for name, each in hours.items() if each[0]}


def _day_counts(day: Matrix, before: Matrix) -> DayCounts:
    """Sums over the hours of a day and of the day before, each with observed and ambiguous."""
    sums = [int(each) for part in (day, before) if len(part) for each in part.sum(axis=0)]
    if not len(before):
        return DayCounts(*sums)
    shares = [share_of_sums(part[:, 1], part[:, 0]) for part in (day, before)]
    return DayCounts(*sums, is_certain=shares[0].differs(shares[1]))


_IN_NAMES = results.c.spacecraft.in_(bindparam("names", expanding=True))
_STEPS = (
    select(results.c.spacecraft, time_buckets.STEP, *(SUMMED[name] for name in COUNTS))
    .where(*time_buckets.IN_PERIOD, _IN_NAMES)
    .group_by(results.c.spacecraft, time_buckets.STEP)
)


def _steps(
    connection: Connection, names: list[str], run: str, as_of: Utc, span_s: int, width_s: int
) -> _Sums:
    """Star and batch counts by spacecraft and cell shorter than an hour, from the batches."""
    end = shifted(as_of, _TICK_S)
    found: list[tuple[Any, ...]] = []
    for midnight, asked in time_buckets.steps_by_day(shifted(end, -span_s), end, width_s):
        midnight_s = float(unix_seconds([midnight.tai_ns])[0])
        found += [
            (name, midnight_s + step * width_s, *counts)
            for name, step, *counts in connection.execute(
                _STEPS, {"names": names, "run": run} | asked
            )
        ]
    return found


STEPS = {HOUR_S: 120, DAY_S: 1800}
"""Width in seconds of a sparkline's cells, by its period: two minutes for an hour, 30 for a day."""


def overview(
    connection: Connection,
    missions: Iterable[Mission],
    run: str,
    now: Utc,
    active: Sequence[Alarm],
    spacecraft: Collection[str] | None = None,
) -> Overview:
    """Overview of every mission in a run; the last hour and day end with the run's latest batch.

    With `spacecraft`, runs and batches of others are ignored.
    """
    if spacecraft is not None:
        missions = [each for each in missions if each.name in spacecraft]
    if spacecraft is not None:
        active = [each for each in active if each.spacecraft in spacecraft]
    missions = list(missions)
    as_of, rows = fleet_rows(connection, missions, run, now, active, spacecraft)
    return Overview(
        run=run,
        default_run=default_run(connection, spacecraft),
        as_of=None if as_of is None else as_of.text,
        now=now.text,
        alarms=summary(active),
        items=[
            _item(connection, each, row, run, as_of, now)
            for each, row in zip(missions, rows, strict=True)
        ],
    )


def default_run(connection: Connection, spacecraft: Collection[str] | None = None) -> str:
    """Name of the run to show first: live, or the newest with batches if only other runs hold any.

    With `spacecraft`, only batches of these count.
    """
    daily, c = tables.rollups_daily.c, tables.runs.c
    filled = select(daily.run).where(daily.run == c.name)
    if spacecraft is not None:
        filled = filled.where(daily.spacecraft.in_(spacecraft))
    query = select(c.name).where(filled.exists())
    first = query.order_by(c.name != LIVE, c.created.desc(), c.name).limit(1)
    return str(connection.execute(first).scalar() or LIVE)


def _item(
    connection: Connection,
    mission: Mission,
    row: FleetRow,
    run: str,
    as_of: Utc | None,
    now: Utc,
) -> OverviewRow:
    state = live_state(connection, mission, run, now, row.faults)
    batch, attitude = state.latest_batch, state.last_attitude
    item: Row = structs.asdict(state) | {
        "sigma_arcsec": attitude and sigma_arcsec(attitude.covariance_arcsec2),
        "age_s": row.age_s,
        "received_age_s": row.received_age_s,
        **dict.fromkeys(("last_hour", "last_day", "sparkline_hour", "sparkline_day")),
        "alarms": row.alarms,
    }
    if batch is None or as_of is None:
        return OverviewRow(**item)
    for name, width_s in (("hour", HOUR_S), ("day", DAY_S)):
        # The window includes the latest batch, and excludes one exactly its length before.
        end = shifted(as_of, _TICK_S)
        span = BucketFilter(mission.name, run, shifted(end, -width_s), end)
        step_s, buckets = _read(connection, span, width_s)
        window = WindowCounts(start=span.start.text, end=as_of.text, **time_buckets.totals(buckets))
        item[f"last_{name}"] = window
        item[f"sparkline_{name}"] = _sparkline(buckets, step_s)
    return OverviewRow(**item)


def sigma_arcsec(covariance_arcsec2: list[list[float]]) -> list[float]:
    """One standard deviation in arcsec about each body axis, from a covariance in arcsec^2."""
    return [math.sqrt(max(covariance_arcsec2[axis][axis], 0.0)) for axis in range(3)]


def _read(
    connection: Connection, span: BucketFilter, width_s: int
) -> tuple[int, time_buckets.Columns]:
    are_many = width_s > HOUR_S and (
        time_buckets.batches_about(connection, span) > time_buckets.MAX_BATCHES_SUMMED
        or holds_any(connection, span.spacecraft, span.run, span.start, span.end)
    )
    if are_many:
        return HOUR_S, time_buckets.read_buckets(connection, span, "hour", COUNTS)
    return STEPS[width_s], time_buckets.read_steps(connection, span, STEPS[width_s], COUNTS)


def _sparkline(buckets: time_buckets.Columns, step_s: int) -> Sparkline:
    observed = np.maximum(buckets["observed"], 1.0)
    return Sparkline(
        bucket_s=step_s,
        unix_s=buckets["unix_s"].tolist(),
        batches=buckets["batches"].astype(int).tolist(),
        **{
            f"{name}_share": np.round(buckets[name] / observed, 6).tolist()
            for name in ("unique", "ambiguous", "unmatched")
        },
    )
