"""What the grades of a day are computed from: recorded attitudes, lone stars, and gyro samples."""

import hashlib
import json

import numpy as np
from sqlalchemy import Connection, select

from service.grades.day import METHOD, day_bounds
from service.grades.measured import Recorded, usable_attitudes
from service.gyro.block import Nanoseconds, tai_ns_of
from service.missions.mission import Mission
from service.sky.model import SkyModel
from service.storage.grades.lone_stars import lone_stars
from service.storage.gyro.blocks import BlockFilter, rates_of, times_of
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.sql.grade_tables import gyro_blocks
from service.storage.sql.tables import results, rollups_daily, solutions
from service.times import DAY_S, Utc
from service.vectors import Vector

_ATTITUDES = select(
    results.c.time_ns,
    *(solutions.c[name] for name in ("q1", "q2", "q3", "qc")),
    *(solutions.c[name] for name in ("p11", "p12", "p13", "p22", "p23", "p33")),
).join_from(results, solutions, solutions.c.result_id == results.c.id)


def days_with_batches(
    connection: Connection, spacecraft: str, run: str, start: Utc | None, end: Utc | None
) -> list[int]:
    """The UTC days of a period (see `Utc.bucket`) that have batches, in order."""
    c = rollups_daily.c
    chosen = [c.spacecraft == spacecraft, c.run == run]
    if start is not None:
        chosen.append(c.bucket >= start.bucket(DAY_S))
    if end is not None:
        chosen.append(c.bucket <= end.bucket(DAY_S))
    days = connection.scalars(select(c.bucket).where(*chosen).order_by(c.bucket))
    # The end of a period is excluded.
    return [day for day in days if end is None or day_bounds(day)[0].tai_ns < end.tai_ns]


def recorded_in(
    connection: Connection, sky: SkyModel, spacecraft: str, run: str, start: Utc, end: Utc
) -> Recorded:
    """What was recorded from `start` to before `end`: good attitudes, lone stars, gyro samples."""
    selected = ResultFilter(run, spacecraft, start, end)
    query = _ATTITUDES.where(*selected.conditions(), results.c.status == "good").order_by(*PLACE)
    rows = np.array([tuple(row) for row in connection.execute(query)], dtype=object)
    rows = rows.reshape(-1, 11)
    numbers = rows[:, 1:].astype(np.float64)
    attitudes, unusable = usable_attitudes(
        rows[:, 0].astype(np.int64), numbers[:, :4], numbers[:, 4:]
    )
    gyro_ns, rates = gyro_in(connection, BlockFilter(spacecraft, run, start, end))
    directions = lone_stars(connection, sky, selected)
    return Recorded(gyro_ns, rates, attitudes, directions, unusable)


def gyro_in(connection: Connection, selected: BlockFilter) -> tuple[Nanoseconds, Vector]:
    """The samples of a period in order of time; those of blocks that interleave are merged."""
    times, rates = [np.zeros(0, np.int64)], [np.zeros((0, 3))]
    query = select(gyro_blocks).where(*selected.conditions()).order_by(gyro_blocks.c.start_ns)
    for row in connection.execute(query).mappings():
        times.append(tai_ns_of(row["start_ns"], times_of(row)))
        rates.append(rates_of(row))
    tai_ns, rate = np.concatenate(times), np.concatenate(rates)
    inside = np.ones(len(tai_ns), bool)
    if selected.start is not None:
        inside &= tai_ns >= selected.start.tai_ns
    if selected.end is not None:
        inside &= tai_ns < selected.end.tai_ns
    tai_ns, rate = tai_ns[inside], rate[inside]
    order = np.argsort(tai_ns, kind="stable")
    return tai_ns[order], rate[order]


def inputs_digest(recorded: Recorded, mission: Mission) -> str:
    """`sha256:` of everything that the grades of a day depend on."""
    settings = {
        name: None if each is None else each.model_dump(mode="json")
        for name, each in (("gyro", mission.gyro), ("motion", mission.motion))
    }
    digest = hashlib.sha256(json.dumps([METHOD, settings], sort_keys=True).encode())
    attitudes, directions = recorded.attitudes, recorded.directions
    for values in (
        recorded.gyro_ns,
        recorded.rates_rad_s,
        attitudes.tai_ns,
        attitudes.quaternion,
        attitudes.covariance_rad2,
        directions.tai_ns,
        directions.body,
        directions.inertial,
        directions.sigma_rad,
        np.array([recorded.unusable]),
    ):
        digest.update(f"{values.dtype}{values.shape}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return f"sha256:{digest.hexdigest()}"
