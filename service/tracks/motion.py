"""A direction that moves along a great circle at a constant rate, fitted to points.

The parameters are a direction and a rate at one moment.  Along the circle a point is off
by da + t dr; across it by dc cos(w t) + dq sin(w t) / w, where da and dc are errors of the
direction, dr and dq of the rate, and w is the rate.  These are linear, so that a few rounds of
weighted least squares settle.
"""

from dataclasses import dataclass

import numpy as np

from service.vectors import Matrix, Vector, unit

_ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion at `time_s`: direction (3,), and rate (3,) in rad/s across it.

    `axes` (2, 3) are orthonormal and across the direction.  `covariance` (4, 4) is of the
    direction along both, rad^2, then of the rate along both.  Without a rate it is (2, 2).
    `chi_square` has `degrees_of_freedom`.
    """

    time_s: float
    direction: Vector
    rate: Vector
    axes: Matrix
    covariance: Matrix
    chi_square: float
    degrees_of_freedom: int

    def at(self, time_s: Vector) -> tuple[Vector, Vector]:
        """Directions (n, 3) at times, and the axes (n, 2, 3) there, carried along the circle."""
        elapsed = np.asarray(time_s) - self.time_s
        speed = float(np.sqrt(self.rate @ self.rate))
        along = self.axes[0] if speed == 0.0 else self.rate / speed
        pole = np.cross(self.direction, along)
        angle = speed * elapsed[:, None]
        place = np.cos(angle) * self.direction + np.sin(angle) * along
        onward = np.cos(angle) * along - np.sin(angle) * self.direction
        # The axes turn about the pole with the direction.
        parts = self.axes @ np.stack([along, pole], axis=1)
        axes = parts[:, 0, None] * onward[:, None, :] + parts[:, 1, None] * pole
        return place, axes

    def spread(self, time_s: Vector) -> Vector:
        """The covariance (n, 2, 2), rad^2, of the directions at times, along the axes there."""
        elapsed = np.asarray(time_s) - self.time_s
        own = self.covariance
        if len(own) == 2:
            return np.broadcast_to(own, (len(elapsed), 2, 2))
        t = elapsed[:, None, None]
        return np.asarray(own[:2, :2] + t * (own[:2, 2:] + own[2:, :2]) + t * t * own[2:, 2:])

    @property
    def rate_chi_square(self) -> float:
        """The rate in sigmas, squared: chi-square with two degrees of freedom if there is none."""
        along = self.axes @ self.rate
        return float(along @ np.linalg.solve(self.covariance[2:, 2:], along))


def fit_motion(time_s: Vector, direction: Vector, covariance: Vector, *, moves: bool) -> Motion:
    """The motion through points: times (n,), directions (n, 3), covariances (n, 3, 3) in rad^2.

    A motion with a rate takes two points at different times.
    """
    middle = 0.5 * float(np.min(time_s) + np.max(time_s))
    place, rate = unit(direction.sum(axis=0)), np.zeros(3)
    if moves:
        elapsed = time_s - time_s.mean()
        rate = elapsed @ direction / (elapsed @ elapsed)
        place = unit(place + rate * (middle - float(time_s.mean())))
        rate = rate - (rate @ place) * place
    for _ in range(_ROUNDS):
        axes = _axes(place, rate)
        step, normal, left = _step(
            Motion(middle, place, rate, axes, np.eye(4), 0.0, 0),
            *(time_s, direction, covariance),
            moves=moves,
        )
        place = unit(place + step[:2] @ axes)
        if moves:
            rate = rate + step[2:] @ axes
            rate = rate - (rate @ place) * place
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    return Motion(middle, place, rate, axes, covariance, left, 2 * len(time_s) - len(normal))


def offsets(motion: Motion, points: "tuple[Vector, Vector, Vector]") -> tuple[Vector, Vector]:
    """Of times, directions and covariances: offsets (n, 2) from a motion in rad, and variances.

    The variances (n, 2, 2) are of the points alone; both are along the axes carried there.
    """
    time_s, direction, covariance = points
    _, axes = motion.at(time_s)
    off = np.einsum("nij,nj->ni", axes, direction)
    return off, np.einsum("nij,njk,nlk->nil", axes, covariance, axes)


def _axes(place: Vector, rate: Vector) -> Matrix:
    """Along the motion, or anywhere where there is none, and across it."""
    along = rate
    if not rate.any():
        along = np.cross(place, np.eye(3)[int(np.argmin(np.abs(place)))])
    along = unit(along - (along @ place) * place)
    return np.stack([along, np.cross(place, along)])


def _step(
    motion: Motion, time_s: Vector, direction: Vector, covariance: Vector, *, moves: bool
) -> tuple[Vector, Matrix, float]:
    """The correction, the normal matrix, and the chi-square that the correction leaves."""
    off, variance = offsets(motion, (time_s, direction, covariance))
    elapsed = time_s - motion.time_s
    design = np.zeros((len(time_s), 2, 4 if moves else 2))
    design[:, 0, 0] = 1.0
    design[:, 1, 1] = 1.0
    if moves:
        angle = float(np.sqrt(motion.rate @ motion.rate)) * elapsed
        design[:, 1, 1] = np.cos(angle)
        design[:, 0, 2] = elapsed
        design[:, 1, 3] = elapsed * np.sinc(angle / np.pi)
    weight = np.linalg.inv(variance)
    normal = np.einsum("nki,nkl,nlj->ij", design, weight, design)
    right = np.einsum("nki,nkl,nl->i", design, weight, off)
    # Rates are small numbers beside directions: scaled, the matrix is well conditioned.
    scale = np.sqrt(np.diagonal(normal))
    step = np.linalg.solve(normal / np.outer(scale, scale), right / scale) / scale
    left = off - design @ step
    return step, normal, float(np.einsum("nk,nkl,nl->", left, weight, left))
