"""All spacecraft of a run at a glance: state, what was lately observed, and since when nothing."""

import math
from collections.abc import Iterable

import numpy as np
from sqlalchemy import Connection, select

from service.missions.mission import Mission
from service.records.ahead import LIVE
from service.records.alarms import active_alarms, summary
from service.records.cells import (
    MAX_BATCHES_SUMMED,
    Columns,
    Span,
    batches_about,
    read_cells,
    read_steps,
    totals,
)
from service.records.draft import Row
from service.records.histories import live_state
from service.records.tables import COUNTS, rollups_daily, runs
from service.records.trends import latest_time
from service.times import DAY_S, HOUR_S, Utc, recorded_utc, shifted

STEPS = {HOUR_S: 120, DAY_S: 1800}
"""The buckets of a sparkline: two minutes in an hour, half an hour in a day."""
_TICK_S = 1e-6


def overview(connection: Connection, missions: Iterable[Mission], run: str, now: Utc) -> Row:
    """Every mission in a run; the last hour and day end with the run's latest batch."""
    as_of = latest_time(connection, run, now=now)
    found = active_alarms(connection, run, now.text)
    return {
        "run": run,
        "default_run": default_run(connection),
        "as_of": None if as_of is None else as_of.text,
        "now": now.text,
        "alarms": summary(found),
        "items": [
            _item(connection, each, run, as_of, now)
            | {"alarms": [alarm for alarm in found if alarm["spacecraft"] == each.name]}
            for each in missions
        ],
    }


def default_run(connection: Connection) -> str:
    """The run to look at first: live, or while that is empty the newest that holds batches."""
    filled = select(rollups_daily.c.run).where(rollups_daily.c.run == runs.c.name).exists()
    query = select(runs.c.name).where(filled)
    first = query.order_by(runs.c.name != LIVE, runs.c.created.desc(), runs.c.name).limit(1)
    return str(connection.execute(first).scalar() or LIVE)


def _item(connection: Connection, mission: Mission, run: str, as_of: Utc | None, now: Utc) -> Row:
    state = live_state(connection, mission, run, now)
    batch, attitude = state["latest_batch"], state["last_attitude"]
    item = state | {
        "sigma_arcsec": attitude and sigma_arcsec(attitude["covariance_arcsec2"]),
        "age_s": None,
        "received_age_s": None,
        **dict.fromkeys(("last_hour", "last_day", "sparkline_hour", "sparkline_day")),
    }
    if batch is None or as_of is None:
        return item
    item["age_s"] = max(0.0, (as_of.tai_ns - recorded_utc(batch["time"]).tai_ns) * 1e-9)
    item["received_age_s"] = (now.tai_ns - recorded_utc(batch["received"]).tai_ns) * 1e-9
    for name, width_s in (("hour", HOUR_S), ("day", DAY_S)):
        # The latest batch is of the window, one just as long before it is not.
        end = shifted(as_of, _TICK_S)
        span = Span(mission.name, run, shifted(end, -width_s), end)
        step_s, cells = _cells(connection, span, width_s)
        item[f"last_{name}"] = {"start": span.start.text, "end": as_of.text, **totals(cells)}
        item[f"sparkline_{name}"] = _sparkline(cells, step_s)
    return item


def sigma_arcsec(covariance_arcsec2: list[list[float]]) -> list[float]:
    """One standard deviation about each body axis."""
    return [math.sqrt(max(covariance_arcsec2[axis][axis], 0.0)) for axis in range(3)]


def _cells(connection: Connection, span: Span, width_s: int) -> tuple[int, Columns]:
    if width_s > HOUR_S and batches_about(connection, span) > MAX_BATCHES_SUMMED:
        return HOUR_S, read_cells(connection, span, "hour", COUNTS)
    return STEPS[width_s], read_steps(connection, span, STEPS[width_s], COUNTS)


def _sparkline(cells: Columns, step_s: int) -> Row:
    observed = np.maximum(cells["observed"], 1.0)
    return {
        "bucket_s": step_s,
        "unix_s": cells["unix_s"].tolist(),
        "batches": cells["batches"].astype(int).tolist(),
        **{
            f"{name}_share": np.round(cells[name] / observed, 6).tolist()
            for name in ("unique", "ambiguous", "unmatched")
        },
    }
