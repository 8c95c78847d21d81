"""Preparation before the service is ready: kernels and sky files; zones on request."""

import json
import math
import os
from collections.abc import Collection, Iterable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from service.acquire import acquire
from service.errors import AcquisitionError
from service.feature import SETTING, feature_modules
from service.identify.prior_attitude import prior_attitude, search_region
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Band, Mission
from service.observations.batch import APriori, BoresightPrior, SunPointedPrior
from service.observations.schema import submission_from_json
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import open_catalog
from service.sky.model import SkyModel
from service.sky.zones import Zone
from service.times import Utc, parse_utc
from service.vectors import quaternion_from_matrix, rotate_about

ORION = 84.0, -1.0
"""Right ascension and declination in degrees of a field with bright stars, for warming up."""
BRIGHT_MAG = 4.0
"""Magnitude limit of the warm-up catalog: few stars suffice to compile every kernel."""
BRIGHTEST_MAG = 3.0
"""Brighter magnitude limit of the warm-up catalog where the whole sky is indexed."""


def prewarm_sky(
    sky: SkyModel, missions: Iterable[Mission], time: Utc, whole_sky: bool = True
) -> None:
    """Open, or build if missing, the files that batches of given missions and time need.

    These are run catalogs, and whole-sky indexes unless `whole_sky` is false.
    """
    for mission in missions:
        run_catalog = sky.run_catalog(mission, time)
        if whole_sky:
            for radius_deg in {each.field_of_view_radius_deg for each in mission.trackers}:
                sky.index(mission, run_catalog, radius_deg)


def build_sky_files(catalog: Path | None, epochs: Iterable[tuple[Mission, list[Utc]]]) -> None:
    """Build the missing files of the whole sky, for missions at their times.

    `catalog` is the catalog's file, None for the embedded one. A mission whose sky cannot be built
    is left out: the service says so when it opens the files.
    """
    sky = SkyModel(open_catalog(catalog), LruCache(1))
    for mission, times in epochs:
        with suppress(AcquisitionError):
            for time in times:
                prewarm_sky(sky, [mission], time)


def prewarm_zones(sky: SkyModel, mission: Mission, prior: APriori, time: Utc) -> list[Zone]:
    """Build and cache the zones that a batch with given a priori knowledge will need."""
    presumed = prior_attitude(prior, time, mission)
    run_catalog = sky.run_catalog(mission, time)
    return [
        sky.zone(
            mission,
            run_catalog,
            search_region(tracker, presumed, mission, "a_priori"),
            mission.tolerances.pair_separation_max_deg,
            mission.zone.grid_deg,
        )[0]
        for tracker in mission.trackers
    ]


def prewarm_kernels(
    sky: SkyModel,
    missions: Mapping[str, Mission],
    identifiers: Collection[str] | None = None,
    seldom: bool = False,
) -> None:
    """Load or compile the kernels by acquiring a batch of real stars for each kind of zone.

    The kernels are those of the named identifiers, by default of the missions and of the whole sky
    (a batch with another identifier loads its kernels in some ms), and with `seldom` those for rare
    cases: two groups of stars, match groups, a misaligned tracker. Zones are built into a separate
    cache, which is discarded. The code that builds run catalogs and indexes is compiled only for a
    sky that opens no files.
    """
    moment = parse_utc("2000-01-01T12:00:00Z")
    # Large enough that nothing is evicted and built twice.
    apart = SkyModel(sky.catalog, LruCache(max_bytes=256 << 20), opens_files=sky.opens_files)
    kinds = {mission.zone.kind: mission for mission in missions.values()}
    first = next(iter(kinds), None)
    if identifiers is None:
        identifiers = {"lost_in_space", *(mission.identifier for mission in missions.values())}
    for kind, original in kinds.items():
        mission = _of_bright_stars(original, BRIGHT_MAG)
        tracker = mission.trackers[0]
        attitude = prior_attitude(
            SunPointedPrior(None, None)
            if isinstance(mission.zone, Band)
            else BoresightPrior(*ORION),
            moment,
            mission,
        ).attitude
        run_catalog = apart.run_catalog(mission, moment)
        boresight = attitude.T @ tracker.body_from_tracker[:, 2]
        stars = np.argsort(-(run_catalog.direction @ boresight))[:5]
        seen = run_catalog.direction[stars] @ attitude.T @ tracker.body_from_tracker
        body = {
            "spacecraft": mission.name,
            "batch": "warm-up",
            "time": moment.text,
            "a_priori": {"quaternion": quaternion_from_matrix(attitude).tolist()},
            "body_rates_deg_per_s": [0.0, 0.0, 0.01],
            "observations": [
                {
                    "tracker": tracker.name,
                    "stars": [
                        {"vector": vector, "magnitude": magnitude, "time_offset_s": 0.1}
                        for vector, magnitude in zip(
                            seen.tolist(), run_catalog.magnitude_mag[stars].tolist(), strict=True
                        )
                    ],
                }
            ],
        }
        for identifier in IDENTIFIERS.values():
            if identifier.name not in identifiers:
                continue
            if not identifier.searches_zone and kind != first:
                continue  # the same kernels
            # From JSON, like posted batches, since kernels are compiled for that kind of array. One
            # zone is on the mission's grid, which needs more code; the others are small.
            exact = {} if identifier.name == "starid" else {"zone_grid_deg": 0.0}
            options = {"identifier": identifier.name} | exact
            batch = submission_from_json(json.dumps(body | {"options": options})).batch
            brightest = _of_bright_stars(original, BRIGHTEST_MAG)
            searched = mission if identifier.uses_prior else brightest
            if identifier.searches_zone:
                # The warm-up batch is small; keep it from falling back to the whole sky, which is
                # warmed by itself.
                searched = searched.model_copy(update={"lost_in_space_fallback": False})
            acquire(batch, searched, apart)
        if seldom and kind == first:
            _prewarm_seldom(apart, mission, body, identifiers)


def compile_beside_batches() -> None:
    """Load or compile the kernels (compiled functions) of features."""
    for module in feature_modules("kernels", os.environ.get(SETTING, "")):
        module.compile_kernels()


def _prewarm_seldom(
    sky: SkyModel, mission: Mission, body: dict[str, Any], identifiers: Collection[str]
) -> None:
    """Compile the kernels for two groups of stars, and for group votes of a misaligned tracker."""
    (seen,) = body["observations"]
    tracker, stars = mission.trackers[0], seen["stars"]

    def turned(angle_deg: float) -> list[dict[str, Any]]:
        rotation = np.array([math.radians(angle_deg), 0.0, 0.0])
        return [
            star | {"vector": rotate_about(rotation, star["vector"]).tolist()} for star in stars
        ]

    misaligned = tracker.model_copy(update={"name": "misaligned"})
    searched = mission.model_copy(
        update={"trackers": (tracker, misaligned), "lost_in_space_fallback": False}
    )
    in_steps = {"identifier": "starid", "tests": {"match_groups": True}}
    for observations, options in (
        ([seen | {"stars": stars + turned(0.5)}], {"identifier": "verified"}),
        ([seen, {"tracker": misaligned.name, "stars": turned(0.01)}], in_steps),
    ):
        if options["identifier"] not in identifiers:
            continue
        text = json.dumps(body | {"observations": observations, "options": options})
        acquire(submission_from_json(text).batch, searched, sky)


def _of_bright_stars(mission: Mission, to_mag: float) -> Mission:
    limit_mag = min(to_mag, mission.catalog.magnitude_limit_mag)
    settings = mission.run_catalog_settings.model_copy(update={"magnitude_limit_mag": limit_mag})
    return mission.model_copy(update={"catalog": settings})
