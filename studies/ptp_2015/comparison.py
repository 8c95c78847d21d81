"""Comparison of algorithms on the same simulated fields of the paper's camera, on all cores.

Each algorithm is judged twice: by its own answer, and by the proposals that remain after the
service's attitude check.

The outcomes for one condition and algorithm are a `Tally`, with its rates.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from time import perf_counter, perf_counter_ns
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from service.identify.triangles.ptp import explained
from service.sky.geometry.triangles import REACH_DEG
from service.sky.whole_sky.guide import Guide, build_guide
from studies.ptp_2015.projections import Projections, projections_of
from studies.ptp_2015.rivals.liebe import build_liebe
from studies.ptp_2015.rivals.planar_triangle import build_planar_triangle
from studies.ptp_2015.rivals.projected_triangles import build_p_vector, build_ptp
from studies.ptp_2015.rivals.proposed import Algorithm, Build
from studies.ptp_2015.rivals.pyramid import build_pyramid
from studies.scenes import Conditions, Scene, SceneSky, draw_scenes
from studies.workers import mapping

COLUMNS = ("stars", "named", "named_right", "unique", "unique_right", "own_us", "check_us")
"""Columns of a field's counts: stars; named and rightly named by the algorithm; named and rightly
named after the check; microseconds of the algorithm and of the check.
"""
SIGMAS_95 = 1.959964

Fields = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class FieldShare:
    """Share of fields in percent with its 95 % interval (Wilson)."""

    count: int
    of: int

    @property
    def percent(self) -> float:
        """Share of fields in percent; NaN without fields."""
        return 100.0 * self.count / self.of if self.of else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """Bounds of the 95 % interval of the share, in percent."""
        if not self.of:
            return math.nan, math.nan
        z2, share = SIGMAS_95**2 / self.of, self.count / self.of
        middle = (share + z2 / 2) / (1 + z2)
        half = math.sqrt(share * (1 - share) * z2 + z2**2 / 4) / (1 + z2)
        return 100.0 * (middle - half), 100.0 * (middle + half)

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.percent:.2f} ({low:.2f}-{high:.2f})"


LIMIT_MAG = 6.0


@dataclass(frozen=True)
class Case:
    """One simulated condition, with the algorithms compared on its fields.

    `adds`: noise of magnitude also lifts stars fainter than the limit into the field; otherwise the
    sky ends at the limit.
    """

    name: str
    algorithms: tuple[str, ...]
    position_px: float
    magnitude_sigma_mag: float = 0.0
    adds: bool = True
    fewest: int = 6

    @property
    def conditions(self) -> Conditions:
        """The compared condition as conditions of the scene simulator."""
        return Conditions(
            position_px=self.position_px,
            magnitude_sigma_mag=self.magnitude_sigma_mag,
            limit_mag=LIMIT_MAG,
            fewest=self.fewest,
        )


@dataclass(frozen=True, eq=False)
class Tally:
    """Counts (fields, columns) of one condition and algorithm; see `COLUMNS`.

    The paper does not define when a field is identified.  *strict*: three stars or more are named,
    all rightly; *loose*: two or more, most of them rightly; *checked*: three or more after the
    attitude check, all rightly; *wrong*: a star is misnamed after the check.
    """

    case: Case
    algorithm: str
    rows: npt.NDArray[np.int64]

    def _column(self, name: str) -> npt.NDArray[np.int64]:
        return np.asarray(self.rows[:, COLUMNS.index(name)])

    @cached_property
    def strict(self) -> FieldShare:
        """Share of fields with at least three named stars, all named rightly."""
        named, right = self._column("named"), self._column("named_right")
        return self._rate((named >= 3) & (right == named))

    @cached_property
    def loose(self) -> FieldShare:
        """Share of fields with at least two named stars, most of them named rightly."""
        named, right = self._column("named"), self._column("named_right")
        return self._rate((named >= 2) & (2 * right > named))

    @cached_property
    def checked(self) -> FieldShare:
        """Share of fields with at least three named stars after the attitude check, all rightly."""
        unique, right = self._column("unique"), self._column("unique_right")
        return self._rate((unique >= 3) & (right == unique))

    @cached_property
    def wrong(self) -> FieldShare:
        """Share of fields with a misnamed star after the attitude check."""
        return self._rate(self._column("unique_right") < self._column("unique"))

    @property
    def rates(self) -> tuple[FieldShare, ...]:
        """Shares of fields identified strictly, loosely, after the check, and wrongly."""
        return self.strict, self.loose, self.checked, self.wrong

    @cached_property
    def median_ms(self) -> tuple[float, float]:
        """Median milliseconds per field: of the algorithm alone, and with the check."""
        own, check = self._column("own_us"), self._column("check_us")
        return float(np.median(own)) / 1000.0, float(np.median(own + check)) / 1000.0

    @cached_property
    def mean_ms(self) -> tuple[float, float]:
        """Mean milliseconds per field, as in the paper: algorithm alone, and with the check."""
        own, check = self._column("own_us"), self._column("check_us")
        return float(np.mean(own)) / 1000.0, float(np.mean(own + check)) / 1000.0

    @property
    def times(self) -> str:
        """Text of median and mean times, of the algorithm alone, and with the check."""
        pairs = zip(self.median_ms, self.mean_ms, strict=True)
        return " / ".join(f"{median:.2f} ({mean:.2f})" for median, mean in pairs)

    def of_fields_with(self, least: int, most: int) -> "Tally":
        """Counts of the fields with a number of stars from `least` to `most`."""
        stars = self._column("stars")
        return Tally(self.case, self.algorithm, self.rows[(stars >= least) & (stars <= most)])

    def _rate(self, fields: Fields) -> FieldShare:
        return FieldShare(int(fields.sum()), len(self.rows))

    def row(self) -> dict[str, Any]:
        """Results of one condition and algorithm as a JSON object."""
        own_ms, checked_ms = self.median_ms
        return {
            "table": self.case.name,
            "algorithm": self.algorithm,
            "position_px": self.case.position_px,
            "magnitude_sigma_mag": self.case.magnitude_sigma_mag,
            "noise_adds_stars": self.case.adds,
            "scenes": len(self.rows),
            "strict": self.strict.count,
            "loose": self.loose.count,
            "checked": self.checked.count,
            "wrong": self.wrong.count,
            "median_ms": own_ms,
            "median_checked_ms": checked_ms,
            "mean_ms": self.mean_ms[0],
            "mean_checked_ms": self.mean_ms[1],
        }


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
"""Sigma in pixels that algorithms assume for noiseless fields: a search needs some range."""
SCENES_A_TASK = 50


@dataclass(frozen=True)
class _Task:
    case: Case
    seed: int
    first: int
    count: int


@dataclass(frozen=True)
class Database:
    """Database of an algorithm for the catalog to V 6: entries, size, and building time."""

    algorithm: str
    entries: int
    nbytes: int
    build_s: float


def compare(
    cases: Sequence[Case], scenes: int, seed: int, processes: int | None = None
) -> list[Tally]:
    """Compare algorithms on the fields of several cases; returns a tally for each.

    Scene k of a seed is the same for any number of scenes and workers; `processes` is one per core
    if None, and 1 works in this process.
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
    """Counts (algorithms, scenes, columns) for some scenes of a case."""
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
    """Run an algorithm and the check on one scene; returns counts and times, see `COLUMNS`."""
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
    """Numbers of mirrored skies and of random-point fields in which PTP names stars, at 2 px.

    Counted are fields with three named stars or more, by sharing stars and after the check.
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
    """Build each algorithm's database twice, and time the second build, free of compilation."""
    made = []
    for name in names:
        ALGORITHMS[name](_sky(0.0).run_catalog)
        started = perf_counter()
        algorithm = ALGORITHMS[name](_sky(0.0).run_catalog)
        seconds = perf_counter() - started
        made.append(Database(name, algorithm.entries, algorithm.nbytes, seconds))
    return made


def stars_in_fields(scenes: int, seed: int) -> npt.NDArray[np.int64]:
    """Numbers of stars to the limit in fields at random attitudes, for Figure 10."""
    case = Case("figure-10", (), 0.0, fewest=0)
    drawn = draw_scenes(_sky(0.0), case.conditions, scenes, seed)
    return np.array([len(s.star) for s in tqdm(drawn, total=scenes, unit="scene", disable=None)])


def all_projections() -> Projections:
    """Projections of the sky's guide triangles to the limit: Table 2, Figures 6 and 7."""
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
