"""Linear equations of the sequential estimator for the peak of a star image (report, part VI).

The image is Phi = Phi00 + M u² + 2 J u v + L v² (6.4), and optionally + Q u^4 + R v^4 + T u² v².  A
telescope with the error (a, b) measures S = Phi(u + a, v + b) + noise at known points; the star
then stands at (-a, -b).

The report takes a, b, a², a b, b² as five unknowns.  For the second-order image the last three
columns are constant over all points: the rows have rank three, no number of measurements separates
the five unknowns, and the matrix of 6.13 is singular.  Two remedies are implemented: three unknowns
a, b and g = M a² + 2 J a b + L b², which also absorbs a constant background, or an image of fourth
order with all five.

Also the most informative order of measurements, and noise estimated from them (6.1, 4).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import numpy.typing as npt

from service.features.pictures.centroids.sequential import StateEstimate, diffuse
from service.features.pictures.centroids.window import Array
from studies.star_image_report.claims import Claim, Picture, Study


@dataclass(frozen=True)
class Hump:
    """Model of an image's peak: M = Phi_uu / 2, J = Phi_uv / 2, L = Phi_vv / 2, higher terms."""

    peak: float
    M: float
    L: float
    J: float = 0.0
    Q: float = 0.0
    R: float = 0.0
    T: float = 0.0

    def intensity(self, u: npt.ArrayLike, v: npt.ArrayLike) -> Array:
        """Intensity Phi(u, v) of the modelled image."""
        u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
        second = self.M * u**2 + 2.0 * self.J * u * v + self.L * v**2
        fourth = self.Q * u**4 + self.R * v**4 + self.T * u**2 * v**2
        return np.asarray(self.peak + second + fourth)

    def remainder(self, u: npt.ArrayLike, v: npt.ArrayLike, measured: npt.ArrayLike) -> Array:
        """Measured minus modelled intensity, R = S - Phi(u, v): the left sides of 6.6."""
        return np.asarray(measured, dtype=np.float64) - self.intensity(u, v)

    def rows(self, u: npt.ArrayLike, v: npt.ArrayLike) -> Array:
        """Coefficients (n, 3) of the unknowns (a, b, g) at points (u, v)."""
        u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
        in_a = 2.0 * (u * self.M + v * self.J)
        in_b = 2.0 * (v * self.L + u * self.J)
        return np.stack([in_a, in_b, np.ones_like(in_a)], axis=-1)

    def rows_of_five(self, u: npt.ArrayLike, v: npt.ArrayLike) -> Array:
        """Coefficients (n, 5) of (a, b, a², a b, b²); rank three for a second-order image (6.6)."""
        u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
        Q, R, T = self.Q, self.R, self.T
        plain = self.rows(u, v)
        in_a = plain[..., 0] + 4.0 * Q * u**3 + 2.0 * T * u * v**2
        in_b = plain[..., 1] + 4.0 * R * v**3 + 2.0 * T * u**2 * v
        in_aa = self.M + 6.0 * Q * u**2 + T * v**2
        in_ab = 2.0 * self.J + 4.0 * T * u * v
        in_bb = self.L + 6.0 * R * v**2 + T * u**2
        return np.stack([in_a, in_b, in_aa, in_ab, in_bb], axis=-1)

    def differenced(self, u: Array, v: Array, measured: Array) -> tuple[Array, Array]:
        """Equations (n/2, 2) for (a, b) and their left sides, from disjoint pairs of points (6.21).

        g and a constant background cancel; the noise has twice the variance.  Pairs share no point,
        since sharing pairs are correlated by -1/2.  The report's 6.21 lacks the factor two before a
        and b (and has N for J), which doubles the answer.
        """
        even = len(u) - len(u) % 2
        one, other = slice(0, even, 2), slice(1, even, 2)
        rows = self.rows(u, v)[:, :2]
        left = self.remainder(u, v, measured)
        return rows[one] - rows[other], left[one] - left[other]

    def inconsistency(self, estimate: StateEstimate) -> tuple[float, float]:
        """Estimated g minus the g of the estimated (a, b), and the sigma of the difference (6.4).

        A significant difference means that the offset is outside of the peak, or that a background
        was neglected.  The report compares a² in the same way.
        """
        a, b, g = estimate.state
        slope = np.array([-2.0 * (self.M * a + self.J * b), -2.0 * (self.J * a + self.L * b), 1.0])
        gap = g - (self.M * a**2 + 2.0 * self.J * a * b + self.L * b**2)
        return float(gap), math.sqrt(float(slope @ estimate.covariance @ slope))


@dataclass(frozen=True)
class StopRule:
    """Stopping rule of the estimator: both sigmas below the required one, and a consistent peak.

    `inconsistency_sigmas` is None for an unknown background, which g then absorbs.
    """

    required_sigma: float
    inconsistency_sigmas: float | None = 4.0

    def says(self, hump: Hump, estimate: StateEstimate) -> "Verdict":
        """Verdict on an estimate: continue, or stop with a consistent or an inconsistent image."""
        if not np.all(estimate.sigma[:2] < self.required_sigma):
            return Verdict(done=False, consistent=True)
        if self.inconsistency_sigmas is None:
            return Verdict(done=True, consistent=True)
        gap, sigma = hump.inconsistency(estimate)
        return Verdict(done=True, consistent=abs(gap) < self.inconsistency_sigmas * sigma)


@dataclass(frozen=True)
class Verdict:
    """Verdict of the stopping rule: precise enough, and consistent with the model of the image."""

    done: bool
    consistent: bool


def hump_of(image: Callable[[float, float], float], step: float, fourth: bool = False) -> Hump:
    """Peak model of an even image given as a function, from differences of `step`.

    An even polynomial of fourth order through the differences, exact for such an image.
    """

    def at(i: int, j: int) -> float:
        return float(image(i * step, j * step))

    middle = at(0, 0)
    # Even parts along the axes: f(h) - f(0) = M h² + Q h^4.
    u1, u2, v1, v2 = (at(*x) - middle for x in ((1, 0), (2, 0), (0, 1), (0, 2)))
    M, Q = (16.0 * u1 - u2) / (12.0 * step**2), (u2 - 4.0 * u1) / (12.0 * step**4)
    L, R = (16.0 * v1 - v2) / (12.0 * step**2), (v2 - 4.0 * v1) / (12.0 * step**4)
    J = (at(1, 1) - at(1, -1)) / (4.0 * step**2)
    T = (0.5 * (at(1, 1) + at(1, -1)) - middle - u1 - v1) / step**4
    return Hump(middle, M, L, J, Q, R, T) if fourth else Hump(middle, M, L, J)


def recentred(
    image: Callable[[Array, Array], Array],
    slopes: Callable[[Array, Array], tuple[Array, Array]],
    points: tuple[Array, Array],
    measured: Array,
    start: StateEstimate,
    variance: float,
    passes: int = 10,
) -> StateEstimate:
    """Estimate (a, b) and a background with the true image and slopes, expanded again at each pass.

    This suits offsets that are not small against the peak: the expansion is about the last
    estimate, so that neglected terms vanish.
    """
    u, v = points
    a = b = level = 0.0
    for _ in range(passes):
        in_u, in_v = slopes(u + a, v + b)
        rows = np.stack([in_u, in_v, np.ones_like(in_u)], axis=1)
        left = measured - image(u + a, v + b) - level
        found = start.replayed(rows, left, variance)
        a, b, level = a + found.state[0], b + found.state[1], level + found.state[2]
        if np.abs(found.state[:2]).max() < 1e-9:
            break
    return StateEstimate(np.array([a, b, level]), found.covariance, found.measurements)


HUMP = Hump(peak=1.0, M=-1.0, L=-1.3, J=0.2)
PRIOR = (0.3, 0.3, 0.3)
SIGMA = 0.02
WANTED_SIGMA = 0.004


def grid_points(side: int) -> tuple[Array, Array]:
    """Coordinates (u, v) of a square grid's points over [-1, 1], row by row as in a scan."""
    place = np.linspace(-1.0, 1.0, side)
    return np.tile(place, side), np.repeat(place, side)


def spread_of(estimate: StateEstimate) -> float:
    """Trace of the covariance of the position (a, b), to be minimised."""
    return float(estimate.covariance[0, 0] + estimate.covariance[1, 1])


def most_telling(estimate: StateEstimate, rows: Array, variance: float) -> int:
    """Index of the row whose measurement reduces the position's covariance trace most.

    By 6.26 the trace falls by |(P c)_ab|² / (sigma² + c^T P c), independent of the measured value.
    """
    gain = rows @ estimate.covariance
    spread = variance + (gain * rows).sum(axis=1)
    return int(np.argmax((gain[:, :2] ** 2).sum(axis=1) / spread))


def best_order(rows: Array, variance: float, count: int, prior: Sequence[float] = PRIOR) -> Array:
    """Choose `count` rows, each the most informative after those before; rows may repeat."""
    estimate, chosen = diffuse(prior), []
    for _ in range(count):
        chosen.append(most_telling(estimate, rows, variance))
        estimate = estimate.updated(rows[chosen[-1]], 0.0, variance)
    return np.array(chosen)


def spreads_along(rows: Array, variance: float, prior: Sequence[float] = PRIOR) -> Array:
    """Covariance trace of the position after each of the rows in order."""
    estimate, found = diffuse(prior), []
    for row in rows:
        estimate = estimate.updated(row, 0.0, variance)
        found.append(spread_of(estimate))
    return np.array(found)


def least_spread(rows: Array, variance: float, count: int) -> float:
    """Least covariance trace of the position by any `count` different rows, all tried."""
    prior = np.diag(1.0 / np.square(PRIOR))
    found = math.inf
    for chosen in combinations(range(len(rows)), count):
        subset = rows[list(chosen)]
        covariance = np.linalg.inv(prior + subset.T @ subset / variance)
        found = min(found, float(covariance[0, 0] + covariance[1, 1]))
    return found


@dataclass(frozen=True)
class LearningEstimate:
    """Estimate with unknown noise: covariance in units of the noise variance, and its statistics.

    `squares` sums the squared residuals of predictions, each over 1 + c^T G c: their expectation is
    the variance of the noise, whatever the state.  From a vague start, as many measurements as
    there are unknowns only determine the state and show nothing of the noise.
    """

    estimate: StateEstimate
    squares: float = 0.0
    measurements: int = 0

    def updated(self, row: Array, value: float) -> "LearningEstimate":
        """Add one measurement with the common noise (6.19, with sigma = 1)."""
        surprise = value - float(row @ self.estimate.state)
        expected = 1.0 + float(row @ self.estimate.covariance @ row)
        return LearningEstimate(
            self.estimate.updated(row, value, 1.0),
            self.squares + surprise**2 / expected,
            self.measurements + 1,
        )

    @property
    def freedom(self) -> int:
        """Degrees of freedom: measurements beyond those that determine the state."""
        return self.measurements - len(self.estimate.state)

    @property
    def noise_variance(self) -> float:
        """Estimated variance of a measurement; infinite without degrees of freedom."""
        return self.squares / self.freedom if self.freedom > 0 else math.inf

    @property
    def sigma(self) -> Array:
        """Standard deviations of the state, from the estimated noise."""
        return np.asarray(self.estimate.sigma * math.sqrt(self.noise_variance))


def learning(unknowns: int) -> LearningEstimate:
    """Initial estimate without knowledge of state or noise."""
    return LearningEstimate(diffuse([1e4] * unknowns))


def claims(study: Study) -> tuple[Claim, ...]:
    """Check the claims of section 6.1 (4) on the order of measurements and on learned noise."""
    rng = study.rng(61)
    u, v = grid_points(7)
    rows = HUMP.rows(u, v)
    variance = SIGMA**2
    needed = {
        "the order that tells most": _needed(rows[best_order(rows, variance, 200)]),
        "random points": float(
            np.mean([_needed(rows[rng.integers(0, len(rows), 1200)]) for _ in range(20)])
        ),
        "row by row": _needed(np.tile(rows, (20, 1))),
    }
    few = HUMP.rows(*grid_points(4))
    ratio = max(
        spreads_along(few[best_order(few, variance, count)], variance)[-1]
        / least_spread(few, variance, count)
        for count in (3, 4, 5)
    )
    learned, covered, assumed = _learned(rng, 300 if study.quick else 4000)
    trials = 300 if study.quick else 4000
    slack = 4.0 * math.sqrt(0.683 * 0.317 / trials)
    return (
        Claim(
            "6.1",
            "the system can learn to proceed in an optimal sequence of measurements",
            f"points until the place is known to {WANTED_SIGMA:g}: "
            + ", ".join(f"{name} {count:.0f}" for name, count in needed.items())
            + f"; of 3 to 5 points of 16 the chosen ones leave {ratio:.3f} of the least spread "
            "that any choice leaves, all tried",
            "added",
            needed["the order that tells most"] < 0.75 * needed["random points"] and ratio < 1.2,
            {"points": needed, "over the least": ratio},
        ),
        Claim(
            "6.1",
            "the system learns",
            f"noise that nobody told, after 12 points: mean learned variance over the true "
            f"{learned:.3f}; its sigma covers the place in {covered:.1%} of cases (Student: 68.3 % "
            f"at 1.06 sigma), one told half the noise in {assumed:.1%}",
            "added",
            abs(learned - 1.0) < 4.0 * math.sqrt(2.0 / 9.0 / trials)
            and abs(covered - 0.683) < slack
            and assumed < 0.45,
            {"learned over true": learned, "covered": covered, "half told": assumed},
        ),
    )


def _needed(rows: Array) -> float:
    """Number of rows after which both position errors together are as small as required."""
    spreads = spreads_along(rows, SIGMA**2)
    enough = np.flatnonzero(spreads < 2.0 * WANTED_SIGMA**2)
    return float(enough[0] + 1) if len(enough) else math.inf


def _learned(rng: np.random.Generator, trials: int) -> tuple[float, float, float]:
    """Ratio of estimated to true variance; coverages of 68.3 % bounds, learned and assumed."""
    from scipy.stats import t

    points = 12
    state = np.array([0.1, -0.07, 0.02])
    ratios, covered, assumed = [], 0, 0
    for _ in range(trials):
        u, v = rng.uniform(-1.0, 1.0, (2, points))
        rows = HUMP.rows(u, v)
        values = rows @ state + rng.normal(0.0, SIGMA, points)
        found = learning(3)
        for row, value in zip(rows, values, strict=True):
            found = found.updated(row, float(value))
        error = abs(float(found.estimate.state[0] - state[0]))
        ratios.append(found.noise_variance / SIGMA**2)
        covered += error < float(t.ppf(0.8415, found.freedom)) * float(found.sigma[0])
        assumed += error < 0.5 * SIGMA * float(found.estimate.sigma[0])
    return float(np.mean(ratios)), covered / trials, assumed / trials


def pictures() -> dict[str, Picture]:
    """Figures of section 6.1 (4) on the order of measurements."""
    return {
        "imaging-order": Picture(
            "One sigma of the place after so many points, by the order in which they are measured.",
            (5.6, 3.0),
            _draw,
        )
    }


def _draw(figure: Any) -> None:
    axis = figure.subplots()
    rows = HUMP.rows(*grid_points(7))
    rng = np.random.default_rng(1)
    for label, order, color in (
        ("the most telling next", best_order(rows, SIGMA**2, 60), "#0b5394"),
        ("at random", rng.integers(0, len(rows), 60), "#b45309"),
        ("row by row", np.arange(60) % len(rows), "0.5"),
    ):
        sigma = np.sqrt(0.5 * spreads_along(rows[order], SIGMA**2))
        axis.loglog(np.arange(1, 61), sigma, label=label, color=color)
    axis.axhline(WANTED_SIGMA, color="0.6", lw=0.8, ls=":")
    axis.set(xlabel="points", ylabel="sigma of a and b")
    axis.legend(fontsize=7)
