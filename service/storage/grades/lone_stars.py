"""Identified stars of batches that have no attitude: single directions for the filter."""

from collections.abc import Mapping

import numpy as np
from sqlalchemy import Connection, select

from service.acquire.choices import aberration_velocity
from service.attitude.solution import NoAttitude
from service.errors import BadInput
from service.filtering.samples import DirectionMeasurements, no_directions
from service.identify.attitude_from_matches import matched_vectors
from service.identify.identification import Outcome
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.calibrate import CorrectedObservations, correct
from service.observations.schema import submission_from_json
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import sun_distance_au
from service.sky.model import SkyModel
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.queries.recorded_batch import recorded_mission
from service.storage.sql.tables import batches, results, star_results
from service.vectors import Vector, unit

WITHOUT_ATTITUDE = (
    str(NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS),
    str(NoAttitude.DEGENERATE_GEOMETRY),
)
"""Why a batch has no attitude although stars of it are identified."""
_READ_AT_ONCE = 100
"""Inputs may be long: few of them are in memory at a time."""

Stars = Mapping[tuple[str, int], str]
"""The catalog star of each unique star, by tracker and place."""


def lone_stars(
    connection: Connection, sky: SkyModel, selected: ResultFilter
) -> DirectionMeasurements:
    """The unique stars of the batches without an attitude, in order of time.

    The batch is calibrated with the settings that its result was made with; the inertial
    directions are apparent ones, as attitudes are solved from.
    """
    missions: dict[str, Mission] = {}
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
            digest = row.mission_digest
            if digest not in missions:
                missions[digest] = recorded_mission(connection, digest)
            mission, batch = missions[digest], submission_from_json(inputs[row.batch_id]).batch
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
    """Body and apparent inertial directions (n, 3) of the unique stars, and their sigmas (n,)."""
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
