"""Input of filters and predictions from the database: attitudes, single stars, gyro samples."""

import hashlib
import json
from collections.abc import Mapping, Sequence

import numpy as np
from sqlalchemy import Connection, select

from service.acquire.choices import aberration_velocity
from service.attitude.solution import NoAttitude
from service.errors import BadInput
from service.features.definitive.day import METHOD
from service.features.definitive.kernels.inputs import DirectionMeasurements, no_directions
from service.features.definitive.stretches import (
    LONGEST_GAP_S,
    Recorded,
    arrays_of,
    constant_rate,
    rates_of_use,
    usable_attitudes,
)
from service.gyro.blocks import Nanoseconds
from service.identify.attitude_from_matches import matched_vectors
from service.identify.identification import Outcome
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.calibrate import CorrectedObservations, correct
from service.observations.decode import RECORDED_RATES
from service.observations.schema import submission_from_json
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import sun_distance_au
from service.sky.model import SkyModel
from service.storage.gyro import BlockFilter, gyro_in
from service.storage.queries.pages import COVARIANCE, PLACE, QUATERNION, ResultFilter
from service.storage.queries.results import recorded_mission
from service.storage.queries.time_buckets import buckets_between
from service.storage.sql.tables import (
    batches,
    results,
    rollups_daily,
    solutions,
    star_results,
)
from service.times import DAY_S, Utc
from service.vectors import Vector, unit

_ATTITUDES = select(
    results.c.time_ns,
    *(solutions.c[name] for name in (*QUATERNION, *COVARIANCE)),
    results.c.batch_id,
).join_from(results, solutions, solutions.c.result_id == results.c.id)


RatesRead = dict[str, Sequence[float]]
"""Body rates (3) in deg/s sent with batches, by batch id; zeros if none were sent."""


def days_with_batches(
    connection: Connection, spacecraft: str, run: str, start: Utc | None, end: Utc | None
) -> list[int]:
    """UTC days of a period with batches, in order, numbered as in `Utc.bucket`."""
    c = rollups_daily.c
    within = buckets_between(c.bucket, start, end, DAY_S)
    chosen = c.spacecraft == spacecraft, c.run == run, *within
    return list(connection.scalars(select(c.bucket).where(*chosen).order_by(c.bucket)))


def recorded_in(
    connection: Connection,
    sky: SkyModel,
    spacecraft: str,
    run: str,
    start: Utc,
    end: Utc,
    rates_read: RatesRead | None = None,
) -> Recorded:
    """Read good attitudes, single stars and gyro samples from `start` up to `end`.

    `rates_read` caches body rates that were read before, and keeps those of this period.
    """
    selected = ResultFilter(run, spacecraft, start, end)
    query = _ATTITUDES.where(*selected.conditions(), results.c.status == "good").order_by(*PLACE)
    rows = np.array([tuple(row) for row in connection.execute(query)], dtype=object)
    rows = rows.reshape(-1, 12)
    numbers = rows[:, 1:11].astype(np.float64)
    attitudes, sound = usable_attitudes(rows[:, 0].astype(np.int64), numbers[:, :4], numbers[:, 4:])
    gyro_ns, rates = gyro_in(connection, BlockFilter(spacecraft, run, start, end))
    # A gyro that is off may send zeros, which are no better than what batches carried.
    told_ns = gyro_ns[rates.any(axis=1)]
    rates_read = {} if rates_read is None else rates_read
    ids = rows[sound, 11].tolist()
    carried = _carried_rates(connection, ids, attitudes.tai_ns, told_ns, rates_read)
    directions = lone_stars(connection, sky, selected)
    unusable = int(np.count_nonzero(~sound))
    return Recorded(gyro_ns, rates, attitudes, directions, unusable, carried)


def _carried_rates(
    connection: Connection,
    batch_ids: list[str],
    tai_ns: Nanoseconds,
    gyro_ns: Nanoseconds,
    rates_read: RatesRead,
) -> Vector | None:
    """Body rates (n, 3) sent with batches, zero near gyro samples; None if all are zero.

    `gyro_ns` are the times of samples that are not zero about all axes.  Rates of other batches are
    removed from the cache `rates_read`.
    """
    carried = np.zeros((len(batch_ids), 3))
    padded = np.concatenate([[-FAR_NS], gyro_ns, [FAR_NS]])
    place = np.searchsorted(gyro_ns, tai_ns)
    near = np.minimum(tai_ns - padded[place], padded[place + 1] - tai_ns)
    chosen = np.flatnonzero(near > LONGEST_GAP_S * 1e9).tolist()
    wanted = [batch_ids[row] for row in chosen]
    for id in rates_read.keys() - set(wanted):
        del rates_read[id]
    unread = [id for id in wanted if id not in rates_read]
    for first in range(0, len(unread), _READ_AT_ONCE):
        part = unread[first : first + _READ_AT_ONCE]
        inputs = _inputs(connection, part)
        for id in part:
            sent = RECORDED_RATES.decode(inputs[id]).body_rates_deg_per_s
            rates_read[id] = sent or (0.0, 0.0, 0.0)
    if chosen:
        carried[chosen] = np.radians([rates_read[id] for id in wanted])
    return carried if carried.any() else None


def inputs_digest(recorded: Recorded, mission: Mission) -> str:
    """Digest (`sha256:`) of all data and settings that filtered attitudes of a day depend on."""
    settings = {
        name: None if each is None else each.model_dump(mode="json")
        for name, each in (("gyro", mission.gyro), ("motion", mission.motion))
    }
    digest = hashlib.sha256(json.dumps([METHOD, settings], sort_keys=True).encode())
    carried, model = recorded.carried_rad_s, constant_rate(mission.motion)
    if carried is not None and not rates_of_use(model, recorded.attitudes.tai_ns, carried):
        carried = None
    for values in (
        recorded.gyro_ns,
        recorded.rates_rad_s,
        *arrays_of(recorded.attitudes, recorded.directions),
        np.array([recorded.unusable]),
        *(() if carried is None else (carried,)),
    ):
        digest.update(f"{values.dtype}{values.shape}".encode())
        digest.update(np.ascontiguousarray(values).tobytes())
    return f"sha256:{digest.hexdigest()}"


WITHOUT_ATTITUDE = (
    str(NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS),
    str(NoAttitude.DEGENERATE_GEOMETRY),
)
"""Reasons for which a batch with identified stars has no attitude."""
FAR_NS = 2**62
"""Nanoseconds of TAI later than any recorded time."""
_READ_AT_ONCE = 100
"""Number of batch inputs read at once, small because inputs may be long."""

Stars = Mapping[tuple[str, int], str]
"""Catalog star of every uniquely identified star, by tracker and place in the batch."""


def lone_stars(
    connection: Connection, sky: SkyModel, selected: ResultFilter
) -> DirectionMeasurements:
    """Uniquely identified stars of batches without an attitude, as directions in order of time.

    A batch is corrected with the settings of its result; inertial directions are apparent ones, as
    used to compute attitudes.
    """
    rows_of: dict[str, dict[str, int]] = {}
    found: list[tuple[int, Vector, Vector, Vector]] = []
    query = (
        select(results.c.id, results.c.batch_id, results.c.time_ns, results.c.mission_digest)
        .where(
            *selected.conditions(),
            results.c.status.is_(None),
            results.c.unique > 0,
            results.c.reason.in_(WITHOUT_ATTITUDE),
        )
        .order_by(*PLACE)
    )
    read = connection.execute(query).all()
    for first in range(0, len(read), _READ_AT_ONCE):
        part = read[first : first + _READ_AT_ONCE]
        stars = _unique_stars(connection, [row.id for row in part])
        inputs = _inputs(connection, [row.batch_id for row in part])
        for row in part:
            mission = recorded_mission(connection, row.mission_digest)
            batch = submission_from_json(inputs[row.batch_id]).batch
            run_catalog = sky.run_catalog(mission, batch.time)
            if run_catalog.digest not in rows_of:
                rows_of[run_catalog.digest] = {n: k for k, n in enumerate(run_catalog.star_id)}
            rows = rows_of[run_catalog.digest]
            body, inertial, sigma = _directions(
                batch, mission, run_catalog, stars.get(row.id, {}), rows
            )
            found.append((row.time_ns, body, inertial, sigma))
    if not found:
        return no_directions()
    return DirectionMeasurements(
        np.repeat([each[0] for each in found], [len(each[3]) for each in found]).astype(np.int64),
        np.concatenate([each[1] for each in found]),
        np.concatenate([each[2] for each in found]),
        np.concatenate([each[3] for each in found]),
    )


def _inputs(connection: Connection, batch_ids: list[str]) -> dict[str, str]:
    query = select(batches.c.id, batches.c.input).where(batches.c.id.in_(batch_ids))
    return dict(map(tuple, connection.execute(query)))


def _unique_stars(connection: Connection, ids: list[str]) -> dict[str, dict[tuple[str, int], str]]:
    c = star_results.c
    query = select(c.result_id, c.tracker, c.position, c.star_id).where(
        c.result_id.in_(ids), c.outcome == Outcome.UNIQUE.word
    )
    found: dict[str, dict[tuple[str, int], str]] = {}
    for id, tracker, position, star in connection.execute(query):
        found.setdefault(id, {})[tracker, position] = star
    return found


def _directions(
    batch: ObservationBatch,
    mission: Mission,
    run_catalog: RunCatalog,
    stars: Stars,
    rows: Mapping[str, int],
) -> tuple[Vector, Vector, Vector]:
    """Body and apparent inertial directions (n, 3) of uniquely identified stars, sigmas (n,)."""
    try:
        corrected = correct(batch, mission)
    except BadInput:
        corrected = ()
    names = list(stars.values())
    star = [
        # Two stars with one identity: at least one of them is wrong.
        rows.get(name, -1) if name is not None and names.count(name) == 1 else -1
        for each in corrected
        for name in _of_tracker(each, stars)
    ]
    if not any(row >= 0 for row in star):
        return np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
    body, inertial, sigma = matched_vectors(
        np.concatenate([each.direction_body for each in corrected]),
        np.concatenate([each.sigma_rad for each in corrected]),
        np.array(star, np.int64),
        run_catalog.direction_at(batch.time),
        aberration_velocity(batch),
        sun_distance_au(batch.time),
    )
    return unit(body), unit(inertial), sigma


def _of_tracker(corrected: CorrectedObservations, stars: Stars) -> list[str | None]:
    name = corrected.tracker.name
    return [stars.get((name, k)) for k in range(len(corrected.sigma_rad))]
