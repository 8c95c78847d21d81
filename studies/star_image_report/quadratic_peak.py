"""The rows of the sequential estimator for the hump of a star's image (report, part VI).

The image is Phi = Phi00 + M u² + 2 J u v + L v² (6.4), and, where asked for, + Q u^4 +
R v^4 + T u² v².  A telescope off by (a, b) measures S = Phi(u + a, v + b) + noise at
known points; the star then stands at (-a, -b).

The report takes a, b, a², a b, b² for five unknowns.  With the second-order image the
columns of the last three are the same number at every point: the rows have rank
three, no amount of measuring tells the five apart, and the matrix of 6.13 cannot be
inverted.  Two forms here cure that: three unknowns a, b and g = M a² + 2 J a b + L b², into
which a constant background falls as well, or an image of fourth order with all five.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.imaging.centroids.sequential import StateEstimate
from service.imaging.centroids.window import Array


@dataclass(frozen=True)
class Hump:
    """The image about its middle: M = Phi_uu / 2, J = Phi_uv / 2, L = Phi_vv / 2, and onwards."""

    peak: float
    M: float
    L: float
    J: float = 0.0
    Q: float = 0.0
    R: float = 0.0
    T: float = 0.0

    def intensity(self, u: npt.ArrayLike, v: npt.ArrayLike) -> Array:
        """Phi(u, v)."""
        u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
        second = self.M * u**2 + 2.0 * self.J * u * v + self.L * v**2
        fourth = self.Q * u**4 + self.R * v**4 + self.T * u**2 * v**2
        return np.asarray(self.peak + second + fourth)

    def remainder(self, u: npt.ArrayLike, v: npt.ArrayLike, measured: npt.ArrayLike) -> Array:
        """R = S - Phi(u, v): the left sides of 6.6."""
        return np.asarray(measured, dtype=np.float64) - self.intensity(u, v)

    def rows(self, u: npt.ArrayLike, v: npt.ArrayLike) -> Array:
        """(n, 3) rows for (a, b, g)."""
        u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
        in_a = 2.0 * (u * self.M + v * self.J)
        in_b = 2.0 * (v * self.L + u * self.J)
        return np.stack([in_a, in_b, np.ones_like(in_a)], axis=-1)

    def rows_of_five(self, u: npt.ArrayLike, v: npt.ArrayLike) -> Array:
        """(n, 5) rows for (a, b, a², a b, b²); of rank three for an image of second order (6.6)."""
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
        """Rows (n/2, 2) for (a, b) and their left sides, from disjoint pairs of points (6.21).

        g and a constant background cancel; the noise has twice the variance.  Pairs share no
        point: those that do are correlated by -1/2.  The report's 6.21 has lost the factor
        two before a and b (and writes N for J), which doubles the answer.
        """
        even = len(u) - len(u) % 2
        one, other = slice(0, even, 2), slice(1, even, 2)
        rows = self.rows(u, v)[:, :2]
        left = self.remainder(u, v, measured)
        return rows[one] - rows[other], left[one] - left[other]

    def inconsistency(self, estimate: StateEstimate) -> tuple[float, float]:
        """G as it is estimated minus g of the estimated (a, b), and the sigma of that (6.4).

        Not zero within its sigma: the offset is outside the hump, or a background is
        taken for none.  The report compares a² in the same way.
        """
        a, b, g = estimate.state
        slope = np.array([-2.0 * (self.M * a + self.J * b), -2.0 * (self.J * a + self.L * b), 1.0])
        gap = g - (self.M * a**2 + 2.0 * self.J * a * b + self.L * b**2)
        return float(gap), math.sqrt(float(slope @ estimate.covariance @ slope))


@dataclass(frozen=True)
class StopRule:
    """When enough was measured: both sigmas below what is required, and the hump consistent.

    `inconsistency_sigmas` is None where a background is not known: g then holds it, and
    tells nothing of a and b.
    """

    required_sigma: float
    inconsistency_sigmas: float | None = 4.0

    def says(self, hump: Hump, estimate: StateEstimate) -> "Verdict":
        """The verdict on an estimate: go on, or stop, with an image that is consistent or not."""
        if not np.all(estimate.sigma[:2] < self.required_sigma):
            return Verdict(done=False, consistent=True)
        if self.inconsistency_sigmas is None:
            return Verdict(done=True, consistent=True)
        gap, sigma = hump.inconsistency(estimate)
        return Verdict(done=True, consistent=abs(gap) < self.inconsistency_sigmas * sigma)


@dataclass(frozen=True)
class Verdict:
    """Tells if the estimate is as sharp as required, and if the image is where it may be."""

    done: bool
    consistent: bool


def hump_of(image: Callable[[float, float], float], step: float, fourth: bool = False) -> Hump:
    """The hump of an even image given as a function, by differences of `step`.

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
    """(a, b) and a background with the true image and its slopes, re-centred at each pass.

    The remedy for an offset that is not small against the hump: the expansion is then made
    where the star was last found, so that what it neglects vanishes.
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
