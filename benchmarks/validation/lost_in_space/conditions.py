"""Conditions: errors of scenes, inputs of solvers, and participating solvers."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from benchmarks.validation.lost_in_space.peers import (
    LIMIT_MAG,
    Solver,
    ours,
    peers,
    tetra3rs_solver,
)
from service.acquire import acquire
from service.identify.lost_in_space.solver import FieldOfView
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch, Options, QuaternionPrior, TrackerStars
from service.simulate.motion import random_axis
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.sky.whole_sky.index import FURTHER_MAG
from service.times import parse_utc
from service.vectors import (
    ARCSEC_PER_RADIAN,
    Matrix,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotate_about,
)
from studies.scenes import (
    EPOCH_YEAR,
    MERGE_WITHIN_ARCSEC,
    Conditions,
    PinholeCamera,
    Scene,
    SceneSky,
    draw_random_points,
    draw_scenes,
)

QUICK_SHARE = 0.05
FIVE = Conditions(position_px=0.1, radius_deg=4.0, brightest=5, fewest=5)
WITHOUT_MAGNITUDES = "no magnitudes"
UNCALIBRATED_MAG = {
    "magnitudes off 1.5": 1.5,
    "magnitudes off 2": 2.0,
    "magnitudes off 5": 5.0,
    "magnitudes without zero point": -17.5,
}
"""Magnitude offsets; the last is -2.5 log10 of counts, of which a star of V 5 has 10^5."""
MOMENT = "2000-01-01T12:00:00Z"
WIDEST_PRIOR_DEG = 3.0


@dataclass(frozen=True)
class Condition:
    """Condition for drawing scenes.  `share` of the requested scenes; `real`: an answer exists."""

    conditions: Conditions = field(default_factory=Conditions)
    share: float = 0.125
    real: bool = True
    change: Callable[[Scene], Scene] = field(default=lambda scene: scene)
    random_points: bool = False
    sigma: float = 1.0
    offset_mag: float = 0.0
    prior_deg: float | None = None
    alone: bool = False
    """True without peers: they use neither sigmas nor magnitudes."""

    def draw(self, count: int, seed: int, first: int) -> list[tuple[Scene, int]]:
        """Scenes of a seed, each with the number of its stars in the database."""
        sky = _sky()
        if self.random_points:
            drawn = [
                draw_random_points(sky, self.conditions, int(rng.integers(5, 21)), rng)
                for rng in (np.random.default_rng([seed, k]) for k in range(first, first + count))
            ]
        else:
            drawn = list(draw_scenes(sky, self.conditions, count, seed, first))
        held = np.searchsorted(sky.run_catalog.magnitude_mag, LIMIT_MAG, "right")
        return [
            (self.change(each), int(((each.star >= 0) & (each.star < held)).sum()))
            for each in drawn
        ]


def _mirrored(scene: Scene) -> Scene:
    return scene.mirrored()


def _focal(scene: Scene) -> Scene:
    return scene.with_focal_error(0.002)


CONDITIONS: Mapping[str, Condition] = {
    "0 px": Condition(Conditions(position_px=0.02)),
    "0.5 px": Condition(Conditions(position_px=0.5)),
    "1 px": Condition(share=1.0),
    "2 px": Condition(Conditions(position_px=2.0), share=0.5),
    "five brightest": Condition(FIVE, share=0.25),
    **{
        f"five, prior {deg:g} deg": Condition(FIVE, share=0.05, prior_deg=deg)
        for deg in (0.05, 0.3, 1.0, WIDEST_PRIOR_DEG)
    },
    **{
        f"ten and {spurious} spurious": Condition(
            Conditions(brightest=10, fewest=10, spurious=spurious),
            share=0.25 if spurious in (5, 10) else 0.05,
        )
        for spurious in (0, 2, 5, 10)
    },
    "random points": Condition(share=0.25, real=False, random_points=True),
    "mirrored": Condition(share=0.25, real=False, change=_mirrored),
    "sigma told half": Condition(sigma=0.5, alone=True),
    "sigma told double": Condition(sigma=2.0, alone=True),
    "focal length off 0.2 %": Condition(change=_focal),
    "magnitudes off 0.7": Condition(offset_mag=0.7, alone=True),
    WITHOUT_MAGNITUDES: Condition(share=0.25, offset_mag=math.nan, alone=True),
    **{
        name: Condition(share=0.25, offset_mag=offset_mag, alone=True)
        for name, offset_mag in UNCALIBRATED_MAG.items()
    },
}


@cache
def _sky() -> SceneSky:
    return SceneSky.for_conditions(Conditions())


@cache
def _database() -> SceneSky:
    return SceneSky.to_magnitude(LIMIT_MAG + FURTHER_MAG)


def solvers_of(condition: Condition, with_peers: bool) -> list[Solver]:
    """Participating solvers, the service's own first."""
    camera, run_catalog = condition.conditions.camera, _database().run_catalog
    if condition.prior_deg is not None:
        return _with_prior(condition, condition.prior_deg, with_peers)
    field_of_view = FieldOfView.square(camera.field_deg)
    if condition.conditions.radius_deg is not None:
        field_of_view = FieldOfView(condition.conditions.radius_deg)
    own = ours(run_catalog, field_of_view, condition.sigma, condition.offset_mag)
    if not with_peers or condition.alone:
        return [own]
    return [own, *peers(run_catalog, camera, condition.conditions.position_px)]


def _off_by(scene: Scene, deg: float) -> Matrix:
    """Attitude of a scene rotated by an angle about an axis that the scene determines."""
    rng = np.random.default_rng(np.frombuffer(scene.attitude.tobytes(), np.uint32))
    turn = rotate_about(random_axis(rng) * math.radians(deg), np.eye(3)).T
    return np.asarray(turn @ scene.attitude)


def _with_prior(condition: Condition, deg: float, with_peers: bool) -> list[Solver]:
    """Solvers with an a priori attitude: the whole pipeline, and tetra3rs."""
    import importlib.util

    solvers = [_pipeline(condition.conditions, deg)]
    if with_peers and importlib.util.find_spec("tetra3rs"):
        solvers.append(
            tetra3rs_solver(
                _database().run_catalog, PinholeCamera(), lambda scene: _off_by(scene, deg), deg
            )
        )
    return solvers


def mission_of(conditions: Conditions) -> Mission:
    """Mission whose only tracker is the camera; its cap is as wide as those of the paper."""
    sigma_arcsec = conditions.position_px * conditions.camera.pixel_rad * ARCSEC_PER_RADIAN
    return Mission.model_validate(
        {
            "name": "CAMERA",
            "identifier": "verified",
            "zone": {"kind": "cap", "axis_body": [0.0, 0.0, 1.0], "radius_deg": 10.66},
            "tolerances": {
                "pair_separation_max_deg": 8.0,
                "separation_deg": 3.0 * math.sqrt(2.0) * sigma_arcsec / 3600.0,
                "magnitude_mag": 1.5,
                "magnitude_order_mag": 1.5,
                "cross_product_deg": 90.0,
            },
            "catalog": {
                "magnitude_limit_mag": LIMIT_MAG + FURTHER_MAG,
                "merge_within_arcsec": MERGE_WITHIN_ARCSEC,
            },
            "trackers": [
                {
                    "name": "CAMERA",
                    "x_axis_body": [1.0, 0.0, 0.0],
                    "y_axis_body": [0.0, 1.0, 0.0],
                    "z_axis_body": [0.0, 0.0, 1.0],
                    "field_of_view_radius_deg": conditions.radius_deg,
                    "sigma_arcsec": sigma_arcsec,
                    "magnitude_sigma_mag": conditions.magnitude_sigma_mag,
                }
            ],
        }
    )


def _pipeline(conditions: Conditions, prior_deg: float) -> Solver:
    mission = mission_of(conditions)
    sky = SkyModel(load_embedded(), LruCache(64 << 20))
    run_catalog = sky.run_catalog(mission, parse_utc(MOMENT))
    assert run_catalog.epoch_year == EPOCH_YEAR

    def ready(scene: Scene) -> ObservationBatch:
        n = len(scene.star)
        return ObservationBatch(
            spacecraft=mission.name,
            batch="scene",
            run="benchmark",
            time=parse_utc(MOMENT),
            a_priori=QuaternionPrior(quaternion_from_matrix(_off_by(scene, prior_deg))),
            body_rates_deg_per_s=np.zeros(3),
            velocity_km_per_s=None,
            aberration="ignore",
            observations=(
                TrackerStars(
                    tracker="CAMERA",
                    vector=scene.direction,
                    angles_deg=np.full((n, 2), np.nan),
                    magnitude_mag=scene.magnitude_mag,
                    time_offset_s=np.zeros(n),
                    sigma_arcsec=np.full(n, np.nan),
                ),
            ),
            options=Options(),
        )

    def attitude(acquisition: object) -> Matrix | None:
        solution = getattr(acquisition, "solution", None)
        return None if solution is None else matrix_from_quaternion(solution.quaternion)

    # Its database is the run catalog: directions, magnitudes, names.
    return Solver(
        "pipeline, a priori",
        run_catalog.nbytes / 1e6,
        ready,
        lambda batch: acquire(batch, mission, sky),
        attitude,
    )


__all__ = [
    "CONDITIONS",
    "QUICK_SHARE",
    "UNCALIBRATED_MAG",
    "WITHOUT_MAGNITUDES",
    "Condition",
    "solvers_of",
]
