"""Test of the covariance against the scatter of errors, through the whole pipeline.

Batches of apparent star directions with two-axis Gaussian noise, seen from a spacecraft in orbit;
the solved attitude is compared with the true one.
"""

import json
import math
import tomllib
from typing import Any

import erfa
import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, mean_as_expected, share_as_expected
from benchmarks.report import Report
from benchmarks.sections import Section, Written
from service.acquire import Acquisition, acquire
from service.missions.defaults import completed
from service.missions.mission import SHIPPED_FOLDER, Mission
from service.observations.schema import submission_from_json
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.times import parse_utc
from service.vectors import ARCSEC_PER_RADIAN, attitude_error_arcsec, matrix_from_quaternion
from tests.reference import batches

Array = npt.NDArray[np.float64]

BATCHES, QUICK_BATCHES = 20_000, 200
SOLVERS = ("quest", "triad")
PRIORS = 40
MOMENT = "1996-01-10T12:00:00.000Z"
VELOCITY_KM_PER_S = (0.0, 6.4, -4.1)
SQUARES = {2.366: 0.5, 7.815: 0.05, 14.16: 0.0027}
"""Values of chi-square with three degrees of freedom, and the probabilities to exceed them."""
SUSPECT = 0.001
"""Probability of a correct attitude's TASTE to exceed its 99.9 % point."""
LEAST_SOLVED = 0.99


class Passes:
    """Nominal batches of one mission with their true attitudes."""

    def __init__(self, name: str, sky: SkyModel, solver: str = "quest") -> None:
        self.solver = solver
        text = (SHIPPED_FOLDER / f"{name.lower()}.toml").read_text("utf-8")
        self.toml: dict[str, Any] = completed(tomllib.loads(text)).table
        self.mission = Mission.model_validate(self.toml)
        self.sky = sky
        run_catalog = sky.run_catalog(self.mission, parse_utc(MOMENT))
        self.directions, self.magnitudes = run_catalog.direction, run_catalog.magnitude_mag
        self.velocity_c = self._velocity()
        self.seen = self._apparent()

    def _velocity(self) -> Array:
        tai = erfa.utctai(*erfa.dtf2d("UTC", 1996, 1, 10, 12, 0, 0.0))
        earth = erfa.epv00(*erfa.taitt(*tai))[1]["v"] * erfa.DAU / erfa.DAYSEC
        return np.asarray((earth + np.array(VELOCITY_KM_PER_S) * 1000.0) / erfa.CMPS)

    def _apparent(self) -> Array:
        """Lorentz-transformed directions, without the service's own correction."""
        v = self.velocity_c
        inverse_gamma = math.sqrt(1.0 - v @ v)
        along = (self.directions @ v)[:, None]
        seen = inverse_gamma * self.directions + v + along * v / (1.0 + inverse_gamma)
        return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True))

    def draw(
        self, rng: np.random.Generator, prior: Array, directions: Array, aberration: str
    ) -> tuple[Array, Acquisition]:
        """Batch about an a priori attitude: its true attitude and its result."""
        band = self.toml["zone"]["kind"] == "band"
        error = batches.rotation(rng.normal(size=3), rng.uniform(0, 0.1 if band else 3.0))
        if band:
            error = error @ batches.rotation(self.toml["zone"]["axis_body"], rng.uniform(0, 360))
        truth = error @ prior
        tracker = self.mission.trackers[0]
        boresight = truth.T @ tracker.body_from_tracker[:, 2]
        radius = math.radians(tracker.field_of_view_radius_deg)
        field = np.flatnonzero(directions @ boresight > math.cos(radius))
        rows = rng.choice(field, min(5, len(field)), replace=False)
        exact = directions[rows] @ truth.T @ tracker.body_from_tracker
        noise = rng.normal(size=exact.shape) * tracker.sigma_arcsec / ARCSEC_PER_RADIAN
        noise -= np.sum(noise * exact, axis=1, keepdims=True) * exact
        vectors = exact + noise
        vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
        magnitudes = self.magnitudes[rows] + 0.1 * rng.normal(size=len(rows))
        batch = {
            "spacecraft": self.mission.name,
            "batch": "1",
            "time": MOMENT,
            "a_priori": {"quaternion": batches.matrix_quaternion(prior).tolist()},
            "velocity_km_per_s": list(VELOCITY_KM_PER_S),
            "aberration": aberration,
            "options": {"solver": self.solver},
            "observations": [
                {
                    "tracker": tracker.name,
                    "stars": [
                        {"vector": v.tolist(), "magnitude": float(m)}
                        for v, m in zip(vectors, magnitudes, strict=True)
                    ]
                    or [{"h_deg": 0.0, "v_deg": 0.0}],
                }
            ],
        }
        return truth, acquire(submission_from_json(json.dumps(batch)).batch, self.mission, self.sky)


def error_of(truth: Array, found: Acquisition) -> Array | None:
    """The attitude error in arcseconds about the body axes; None without a good attitude."""
    solution = found.solution
    if solution is None or solution.suspect:
        return None
    return attitude_error_arcsec(matrix_from_quaternion(solution.quaternion), truth)


def run(quick: bool, seed: int) -> Report:
    """Benchmark of every mission and solver: errors in units of the covariance, and TASTE."""
    count = count_of(quick)
    sky = SkyModel(load_embedded(), LruCache(256 << 20))
    figures: dict[str, Any] = {}
    bounds: list[Bound] = []
    missions = ("XTE", "SWAS", "SOHO")
    with tqdm(total=len(SOLVERS) * len(missions) * count, desc="covariance", unit="batch") as bar:
        for name in missions:
            for solver in SOLVERS:
                rng = np.random.default_rng([seed, *name.encode()])
                passes = Passes(name, sky, solver)
                priors = batches.prior_attitudes(rng, passes.toml, PRIORS)
                squares, tastes, freedoms, suspect = [], [], [], 0
                for _ in range(count):
                    prior = priors[rng.integers(PRIORS)]
                    truth, found = passes.draw(rng, prior, passes.seen, "to_correct")
                    bar.update(1)
                    solution = found.solution
                    if solution is None:
                        continue
                    suspect += solution.suspect
                    # Use all attitudes: without the suspect ones TASTE does not follow chi-square.
                    tastes.append(solution.taste)
                    freedoms.append(solution.degrees_of_freedom)
                    error = error_of(truth, found)
                    if error is not None:
                        covariance = solution.covariance_arcsec2
                        squares.append(float(error @ np.linalg.solve(covariance, error)))
                label = f"{name}, {solver}"
                figures |= {
                    f"{label}: attitudes": len(tastes),
                    f"{label}: of these suspect": suspect,
                }
                bounds += _bounds(label, count, squares, tastes, freedoms, suspect)
    return Report("covariance", figures, bounds)


def _bounds(
    label: str,
    count: int,
    squares: list[float],
    tastes: list[float],
    freedoms: list[int],
    suspect: int,
) -> list[Bound]:
    """Bounds of a mission's attitudes, by chi-square on both sides."""
    solved = len(tastes)
    return [
        at_least(f"{label}: batches with an attitude", solved / count, LEAST_SOLVED),
        mean_as_expected(f"{label}: mean of e^T P^-1 e, good attitudes", squares, 3.0, 6.0),
        *(
            share_as_expected(
                f"{label}: e^T P^-1 e above {most:g}",
                sum(square > most for square in squares),
                len(squares),
                share,
            )
            for most, share in SQUARES.items()
        ),
        mean_as_expected(
            f"{label}: mean of (TASTE - (2N - 3)) / sqrt(2 (2N - 3))",
            [(t - f) / math.sqrt(2.0 * f) for t, f in zip(tastes, freedoms, strict=True)],
            0.0,
            1.0,
        ),
        share_as_expected(f"{label}: suspect", suspect, solved, SUSPECT),
    ]


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about covariances."""
    report = run(quick, seed)
    text = f"""
Nominal batches of up to five stars with two-axis Gaussian noise, through the whole pipeline:
identified, corrected for aberration and solved. With e the attitude error about the body axes and
P the covariance, e^T P^-1 e is chi-square with three degrees of freedom, and TASTE with 2N - 3: it
has the mean 2N - 3 and the variance 2 (2N - 3). An attitude is suspect beyond the 99.9 % point of
TASTE, so one in a thousand is. The a priori attitude is off by up to 3 deg about any axis (XTE,
SWAS), or by up to 0.1 deg and any angle about the pole (SOHO). {count_of(quick):,} batches each.
"""
    return Written(text, report.bounds)


def count_of(quick: bool) -> int:
    """Number of batches of one mission."""
    return QUICK_BATCHES if quick else BATCHES


SECTION = Section("Covariance", write)
