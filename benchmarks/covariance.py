"""Whether errors scatter as the covariance says, through the whole staircase.

Batches of apparent star directions with two-axis Gaussian noise, seen from a
spacecraft in orbit; the solved attitude is held against the true one.
"""

import json
import math
import tomllib
from dataclasses import dataclass
from typing import Any

import erfa
import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.acquire import Acquisition, acquire
from service.attitude.solve import METHODS
from service.missions.mission import SHIPPED_FOLDER, Mission
from service.observe.wire import submission_from_json
from service.sky.catalog import load_embedded
from service.sky.shelf import Shelf
from service.sky.view import Sky
from service.times import parse_utc
from service.vectors import ARCSEC_PER_RADIAN, attitude_error_arcsec, matrix_from_quaternion
from tests.reference import batches

Array = npt.NDArray[np.float64]

BATCHES, QUICK_BATCHES = 7000, 200
"""Of each mission and method."""
PRIORS = 40
MOMENT = "1996-01-10T12:00:00.000Z"
VELOCITY_KM_PER_S = (0.0, 6.4, -4.1)
SQUARE_BOUND = 14.16
"""Chi-square of three degrees of freedom passes this with probability 0.27 %."""
MEAN_SQUARE_OFF, MOST_BEYOND, MEAN_TASTE_OFF, MOST_SUSPECT = 0.1, 0.0045, 0.05, 0.002
LEAST_SOLVED = 0.9


class Passes:
    """Nominal batches of one mission with their true attitudes."""

    def __init__(self, name: str, sky: Sky) -> None:
        text = (SHIPPED_FOLDER / f"{name.lower()}.toml").read_text("utf-8")
        self.toml: dict[str, Any] = tomllib.loads(text)
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
        """Lorentz-transformed directions, written out: not the service's own correction."""
        v = self.velocity_c
        inverse_gamma = math.sqrt(1.0 - v @ v)
        along = (self.directions @ v)[:, None]
        seen = inverse_gamma * self.directions + v + along * v / (1.0 + inverse_gamma)
        return np.asarray(seen / np.linalg.norm(seen, axis=1, keepdims=True))

    def draw(
        self,
        rng: np.random.Generator,
        prior: Array,
        directions: Array,
        aberration: str,
        method: str = "quest",
    ) -> tuple[Array, Acquisition]:
        """One batch about an a priori attitude: its true attitude and what was made of it."""
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
            "options": {"solver": method},
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


@dataclass(frozen=True)
class Sample:
    """Good attitudes of one mission and method: e^T P^-1 e and TASTE over its degrees of freedom.

    `suspect` counts the other attitudes of `batches`.
    """

    batches: int
    suspect: int
    squares: Array
    tastes: Array

    def figures(self) -> dict[str, Any]:
        """As the page shows them, with what is expected."""
        return {
            "attitudes": len(self.squares),
            "mean of e^T P^-1 e (3)": float(self.squares.mean()),
            f"share above {SQUARE_BOUND} (0.27 %)": f"{self._beyond:.2%}",
            "mean TASTE over 2N - 3 (1)": float(self.tastes.mean()),
            "suspect (0.1 %)": f"{self.suspect / self.batches:.2%}",
        }

    @property
    def _beyond(self) -> float:
        return float((self.squares > SQUARE_BOUND).mean())

    def faults(self, name: str) -> list[str]:
        """Figures out of bounds, allowing five standard errors where the sample is small."""
        n = len(self.squares)
        mean, taste = float(self.squares.mean()), float(self.tastes.mean())
        suspect = self.suspect / self.batches
        taste_slack = max(MEAN_TASTE_OFF, 5.0 * float(self.tastes.std()) / math.sqrt(n))
        checks = (
            (n >= LEAST_SOLVED * self.batches, f"{n} attitudes of {self.batches} batches"),
            (
                abs(mean - 3.0) <= max(MEAN_SQUARE_OFF, 5.0 * math.sqrt(6.0 / n)),
                f"mean of e^T P^-1 e is {mean:.3f}",
            ),
            (
                self._beyond <= max(MOST_BEYOND, 0.0027 + 5.0 * math.sqrt(0.0027 / n)),
                f"{self._beyond:.2%} above {SQUARE_BOUND}",
            ),
            (abs(taste - 1.0) <= taste_slack, f"mean TASTE over 2N - 3 is {taste:.3f}"),
            (
                suspect <= max(MOST_SUSPECT, 0.001 + 5.0 * math.sqrt(0.001 / self.batches)),
                f"{suspect:.2%} suspect",
            ),
        )
        return [f"{name}: {what}" for holds, what in checks if not holds]


def sample(
    passes: Passes, method: str, count: int, rng: np.random.Generator, bar: "tqdm[None]"
) -> Sample:
    """The attitudes that one method gives of `count` batches about `PRIORS` attitudes."""
    priors = batches.prior_attitudes(rng, passes.toml, PRIORS)
    squares, tastes, suspect = [], [], 0
    for _ in range(count):
        prior = priors[rng.integers(PRIORS)]
        truth, found = passes.draw(rng, prior, passes.seen, "to_correct", method)
        bar.update(1)
        solution, error = found.solution, error_of(truth, found)
        suspect += solution is not None and solution.suspect
        if solution is None or error is None:
            continue
        squares.append(float(error @ np.linalg.solve(solution.covariance_arcsec2, error)))
        tastes.append(solution.taste / solution.degrees_of_freedom)
    return Sample(count, suspect, np.array(squares), np.array(tastes))


def run(quick: bool, seed: int) -> Report:
    """The benchmark: every mission and method, errors in units of the covariance and TASTE."""
    count = QUICK_BATCHES if quick else BATCHES
    sky = Sky(load_embedded(), Shelf(256 << 20))
    samples: dict[str, Sample] = {}
    with tqdm(total=3 * len(METHODS) * count, desc="covariance", unit="batch") as bar:
        for mission in ("XTE", "SWAS", "SOHO"):
            passes = Passes(mission, sky)
            for method in METHODS:
                rng = np.random.default_rng([seed, *f"{mission} {method}".encode()])
                found = sample(passes, method, count, rng, bar)
                samples[f"{mission}, {method}"] = found
    for method in METHODS:
        mine = [found for name, found in samples.items() if name.endswith(method)]
        samples[f"all, {method}"] = Sample(
            sum(each.batches for each in mine),
            sum(each.suspect for each in mine),
            np.concatenate([each.squares for each in mine]),
            np.concatenate([each.tastes for each in mine]),
        )
    figures = {
        f"{name}: {what}": value
        for name, found in samples.items()
        for what, value in found.figures().items()
    }
    faults = [fault for name, found in samples.items() for fault in found.faults(name)]
    return Report("covariance", figures, not faults, faults)


def write(quick: bool, seed: int) -> Written:
    """The section of the verification."""
    report = run(quick, seed)
    count = QUICK_BATCHES if quick else BATCHES
    text = f"""
Nominal batches of up to five stars with two-axis Gaussian noise, through the whole staircase:
identified, corrected for aberration and solved, {count:,} for each mission and method. With e the
attitude error about the body axes and P the covariance of the method, e^T P^-1 e of good attitudes
is chi-square with three degrees of freedom, and TASTE, which is that of QUEST's attitude for both
methods, with 2N - 3. Bounds: a mean of e^T P^-1 e of 2.9 to 3.1; at most {MOST_BEYOND:.2%} above
{SQUARE_BOUND}; a mean TASTE over 2N - 3 within {MEAN_TASTE_OFF:g} of 1; at most {MOST_SUSPECT:.2%}
suspect; a good attitude of at least {LEAST_SOLVED:.0%} of the batches. Where five standard errors
of a sample are wider than a bound, they are allowed.

{table(("", "figure"), report.figures.items())}
"""
    return Written(text, report.passed)


SECTION = Section("Covariance", write)
