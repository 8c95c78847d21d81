"""Fields of the paper's camera given to several algorithms, on all cores.

Every algorithm sees the same fields.  Each is asked twice: for its own answer,
and for what is left of its proposals after the service's attitude check.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from time import perf_counter, perf_counter_ns

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from service.identify.triangles.ptp import explained
from service.simulate.scenes import Conditions, Scene, SceneSky, draw_scenes
from service.sky.geometry.triangles import REACH_DEG
from service.sky.whole_sky.guide import Guide, build_guide
from studies.ptp_2015.projections import Projections, projections_of
from studies.ptp_2015.rivals.liebe import build_liebe
from studies.ptp_2015.rivals.planar_triangle import build_planar_triangle
from studies.ptp_2015.rivals.projected_triangles import build_p_vector, build_ptp
from studies.ptp_2015.rivals.proposed import Algorithm, Build
from studies.ptp_2015.rivals.pyramid import build_pyramid
from studies.ptp_2015.tally import COLUMNS, LIMIT_MAG, Case, Tally
from studies.workers import mapping

ALGORITHMS: Mapping[str, Build] = {
    "PTP": build_ptp,
    "P-vector": build_p_vector,
    "planar triangle": build_planar_triangle,
    "Liebe's triangles": build_liebe,
    "pyramid": build_pyramid,
    **{f"PTP, {slaves} slaves": partial(build_ptp, slaves=slaves) for slaves in (3, 5, 6)},
}
OF_THE_PAPER = ("PTP", "P-vector", "planar triangle")
COMPARED = (*OF_THE_PAPER, "Liebe's triangles", "pyramid")
SIGMA_FLOOR_PX = 0.25
"""The sigma that algorithms assume where there is no noise: a range of nothing finds nothing."""
SCENES_A_TASK = 50


@dataclass(frozen=True)
class _Task:
    case: Case
    seed: int
    first: int
    count: int


@dataclass(frozen=True)
class Database:
    """The data that an algorithm keeps for the catalog to V 6, and the cost of making them."""

    algorithm: str
    entries: int
    nbytes: int
    build_s: float


def compare(
    cases: Sequence[Case], scenes: int, seed: int, processes: int | None = None
) -> list[Tally]:
    """The tallies of every case and algorithm, in their order.

    Scene k of a seed is the same whatever the number of scenes and of workers;
    `processes` is one a core where it is None, and 1 works in this process.
    """
    tasks = [
        _Task(case, seed, first, min(SCENES_A_TASK, scenes - first))
        for case in cases
        for first in range(0, scenes, SCENES_A_TASK)
    ]
    results: dict[Case, list[npt.NDArray[np.int64]]] = {case: [] for case in cases}
    with (
        tqdm(total=len(cases) * scenes, unit="scene", disable=None) as bar,
        mapping(processes) as mapped,
    ):
        for task, counted in zip(tasks, mapped(_perform, tasks), strict=True):
            results[task.case].append(counted)
            bar.update(task.count)
    return [
        Tally(case, algorithm, np.concatenate([part[k] for part in results[case]]))
        for case in cases
        for k, algorithm in enumerate(case.algorithms)
    ]


def _perform(task: _Task) -> npt.NDArray[np.int64]:
    """Counts (algorithms, scenes, columns) of some scenes of a case."""
    case = task.case
    sky = _sky(case.magnitude_sigma_mag if case.adds else 0.0)
    assumed_rad = max(case.position_px, SIGMA_FLOOR_PX) * case.conditions.camera.pixel_rad
    counted = np.empty((len(case.algorithms), task.count, len(COLUMNS)), np.int64)
    for at, scene in enumerate(
        draw_scenes(sky, case.conditions, task.count, task.seed, task.first)
    ):
        seen = replace(scene, sigma_rad=np.full(len(scene.direction), assumed_rad))
        for k, name in enumerate(case.algorithms):
            counted[k, at] = _ask(_database(name), seen)
    return counted


def _ask(algorithm: Algorithm, scene: Scene) -> tuple[int, ...]:
    """One row of a tally; see `COLUMNS`."""
    started = perf_counter_ns()
    proposed = algorithm.identify(scene)
    answered = perf_counter_ns()
    match, rival = explained(
        scene.direction, scene.sigma_rad, np.zeros(3), _guide(), proposed.image, proposed.star
    )
    checked = perf_counter_ns()
    named, unique = proposed.match >= 0, (match >= 0) & (rival < 0)
    return (
        len(scene.direction),
        int(named.sum()),
        int((named & (proposed.match == scene.star)).sum()),
        int(unique.sum()),
        int((unique & (match == scene.star)).sum()),
        (answered - started) // 1000,
        (checked - answered) // 1000,
    )


def false_fields(scenes: int, seed: int) -> list[dict[str, str | int]]:
    """Mirrored skies, and fields of as many random points, that PTP names stars of, at 2 px.

    Counted are fields with three stars or more by sharing stars, and behind the attitude check.
    """
    case, rng = Case("ptp-false", ("PTP",), 2.0), np.random.default_rng([seed, 2])
    half = np.tan(np.radians(5.0))
    assumed_rad = case.position_px * case.conditions.camera.pixel_rad
    counts = {"mirrored sky": np.zeros(2, int), "random points": np.zeros(2, int)}
    for scene in draw_scenes(_sky(0.0), case.conditions, scenes, seed):
        points = rng.uniform(-half, half, (len(scene.direction), 2))
        drawn = np.column_stack([points, np.ones(len(points))])
        fields = {
            "mirrored sky": scene.direction * (-1.0, 1.0, 1.0),
            "random points": drawn / np.linalg.norm(drawn, axis=1)[:, None],
        }
        for name, direction in fields.items():
            sigma_rad = np.full(len(direction), assumed_rad)
            row = _ask(_database("PTP"), replace(scene, direction=direction, sigma_rad=sigma_rad))
            counts[name] += row[1] >= 3, row[3] >= 3
    return [
        {
            "table": "ptp-false",
            "fields": name,
            "scenes": scenes,
            "sharing": int(sharing),
            "checked": int(checked),
        }
        for name, (sharing, checked) in counts.items()
    ]


def databases(names: Sequence[str] = COMPARED) -> list[Database]:
    """Each algorithm's database, built twice: compiling is no part of the second time."""
    made = []
    for name in names:
        ALGORITHMS[name](_sky(0.0).run_catalog)
        started = perf_counter()
        algorithm = ALGORITHMS[name](_sky(0.0).run_catalog)
        seconds = perf_counter() - started
        made.append(Database(name, algorithm.entries, algorithm.nbytes, seconds))
    return made


def stars_in_fields(scenes: int, seed: int) -> npt.NDArray[np.int64]:
    """How many stars to the limit stand in fields at attitudes spread evenly: Figure 10."""
    case = Case("figure-10", (), 0.0, fewest=0)
    drawn = draw_scenes(_sky(0.0), case.conditions, scenes, seed)
    return np.array([len(s.star) for s in tqdm(drawn, total=scenes, unit="scene", disable=None)])


def all_projections() -> Projections:
    """The projections of the sky's guide triangles to the limit: Table 2, Figures 6 and 7."""
    return projections_of(_sky(0.0).run_catalog)


@cache
def _sky(magnitude_sigma_mag: float) -> SceneSky:
    conditions = Conditions(magnitude_sigma_mag=magnitude_sigma_mag, limit_mag=LIMIT_MAG)
    return SceneSky.for_conditions(conditions)


@cache
def _database(name: str) -> Algorithm:
    return ALGORITHMS[name](_sky(0.0).run_catalog)


@cache
def _guide() -> Guide:
    return build_guide(_sky(0.0).run_catalog, REACH_DEG)
