"""All spacecraft of a run: state, recent observations, and time since the latest batch."""

import math
from collections.abc import Collection, Iterable, Sequence

import numpy as np
from msgspec import structs
from sqlalchemy import Connection, select

from service.missions.mission import Mission
from service.storage.models.alarms import Alarm
from service.storage.models.overview import Overview, OverviewRow, Sparkline, WindowCounts
from service.storage.queries.alarms import active_alarms, summary
from service.storage.queries.histories import live_state
from service.storage.queries.time_buckets import (
    MAX_BATCHES_SUMMED,
    BucketFilter,
    Columns,
    batches_about,
    has_archived,
    read_buckets,
    read_steps,
    totals,
)
from service.storage.queries.trends import latest_time_of
from service.storage.recording.unsaved_result import LIVE
from service.storage.sql.columns import Row
from service.storage.sql.rollup_tables import COUNTS, rollups_daily
from service.storage.sql.tables import runs
from service.times import DAY_S, HOUR_S, Utc, recorded_utc, shifted

STEPS = {HOUR_S: 120, DAY_S: 1800}
"""The buckets of a sparkline: two minutes in an hour, half an hour in a day."""
_TICK_S = 1e-6


def overview(
    connection: Connection,
    missions: Iterable[Mission],
    run: str,
    now: Utc,
    spacecraft: Collection[str] | None = None,
) -> Overview:
    """Every mission in a run; the last hour and day end with the run's latest batch.

    With `spacecraft`, runs and batches of others are as if they did not exist.
    """
    if spacecraft is not None:
        missions = [each for each in missions if each.name in spacecraft]
    as_of = latest_time_of(connection, run, spacecraft, now=now)
    found = active_alarms(connection, run, now.text)
    if spacecraft is not None:
        found = [each for each in found if each.spacecraft in spacecraft]
    return Overview(
        run=run,
        default_run=default_run(connection, spacecraft),
        as_of=None if as_of is None else as_of.text,
        now=now.text,
        alarms=summary(found),
        items=[_item(connection, each, run, as_of, now, found) for each in missions],
    )


def default_run(connection: Connection, spacecraft: Collection[str] | None = None) -> str:
    """The run to look at first: live, or while that is empty the newest that holds batches.

    With `spacecraft`, batches of these.
    """
    batches = select(rollups_daily.c.run).where(rollups_daily.c.run == runs.c.name)
    if spacecraft is not None:
        batches = batches.where(rollups_daily.c.spacecraft.in_(spacecraft))
    filled = batches.exists()
    query = select(runs.c.name).where(filled)
    first = query.order_by(runs.c.name != LIVE, runs.c.created.desc(), runs.c.name).limit(1)
    return str(connection.execute(first).scalar() or LIVE)


def _item(
    connection: Connection,
    mission: Mission,
    run: str,
    as_of: Utc | None,
    now: Utc,
    active: Sequence[Alarm],
) -> OverviewRow:
    state = live_state(connection, mission, run, now)
    batch, attitude = state.latest_batch, state.last_attitude
    item: Row = structs.asdict(state) | {
        "sigma_arcsec": attitude and sigma_arcsec(attitude.covariance_arcsec2),
        "age_s": None,
        "received_age_s": None,
        **dict.fromkeys(("last_hour", "last_day", "sparkline_hour", "sparkline_day")),
        "alarms": [alarm for alarm in active if alarm.spacecraft == mission.name],
    }
    if batch is None or as_of is None:
        return OverviewRow(**item)
    item["age_s"] = max(0.0, (as_of.tai_ns - recorded_utc(batch.time).tai_ns) * 1e-9)
    item["received_age_s"] = (now.tai_ns - recorded_utc(batch.received).tai_ns) * 1e-9
    for name, width_s in (("hour", HOUR_S), ("day", DAY_S)):
        # The latest batch is of the window, one just as long before it is not.
        end = shifted(as_of, _TICK_S)
        span = BucketFilter(mission.name, run, shifted(end, -width_s), end)
        step_s, buckets = _read(connection, span, width_s)
        window = WindowCounts(start=span.start.text, end=as_of.text, **totals(buckets))
        item[f"last_{name}"] = window
        item[f"sparkline_{name}"] = _sparkline(buckets, step_s)
    return OverviewRow(**item)


def sigma_arcsec(covariance_arcsec2: list[list[float]]) -> list[float]:
    """One standard deviation about each body axis."""
    return [math.sqrt(max(covariance_arcsec2[axis][axis], 0.0)) for axis in range(3)]


def _read(connection: Connection, span: BucketFilter, width_s: int) -> tuple[int, Columns]:
    are_many = width_s > HOUR_S and (
        batches_about(connection, span) > MAX_BATCHES_SUMMED or has_archived(connection, span)
    )
    if are_many:
        return HOUR_S, read_buckets(connection, span, "hour", COUNTS)
    return STEPS[width_s], read_steps(connection, span, STEPS[width_s], COUNTS)


def _sparkline(buckets: Columns, step_s: int) -> Sparkline:
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
