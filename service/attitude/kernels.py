"""Compiled attitude solutions from matched vectors by TRIAD and QUEST, with residuals.

b are observed unit vectors in body axes, r the reference vectors in inertial
axes, weights are sigma^-2 with sigma in radians.  Quaternions are scalar last,
inertial to body.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from service.attitude.covariance import information, inverse_symmetric, within
from service.attitude.quaternions import to_matrix, to_quaternion
from service.attitude.quest import quest
from service.attitude.triad import (
    LEAST_SINE,
    firmest_pair,
    triad,
    triad_covariance,
    widest_pair,
)
from service.compiled.jit import njit, njit_no_refcount
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector

TRIAD, QUEST, START = 0, 1, 2
"""Rows of a fit's quaternions: the two methods, and the rough start of QUEST."""
PLAIN, WEIGHTED, EXPECTED = 0, 1, 2
"""Columns of the sums of squared residuals: unweighted, weighted, and predicted."""
RMS, PREDICTED_RMS, TASTE, APART = 0, 1, 2, 3
"""Indices of a fit's figures: rms residual, its prediction, TASTE, angle between methods."""


class FitWorkspace(NamedTuple):
    """The output arrays of `fit_attitude` for n vectors, angles in arcsec.

    `quaternions` (3, 4) are those of TRIAD and QUEST, and the start of QUEST. The chosen method
    gives `attitude` (3, 3), `covariance_arcsec2` (3, 3), `residual_arcsec` (n,), and among the
    `figures` (4,) the rms residual and its prediction.
    """

    quaternions: Any
    attitude: Any
    covariance_arcsec2: Any
    residual_arcsec: Any
    figures: Any


@njit_no_refcount
def solve(
    b: Vector,
    r: Vector,
    weights: Vector,
    worst_rad: float,
    chosen: int,
    quaternions: Vector,
    covariance: Matrix,
    squares: Vector,
    sums: Vector,
    scratch: Vector,
) -> bool:
    """Solve Wahba's problem by TRIAD into row 0 of `quaternions` (3, 4), and by QUEST into row 1.

    `covariance` (3, 3) is set for the method in row `chosen`, in rad^2. `squares` (2, n) gets the
    squared residuals |b - A r|^2 of both, `sums` (2, 3) their sum, their sum in units of sigma^2
    and, in row `chosen`, the expected value of the first. Returns false if the geometry leaves the
    chosen attitude an axis worse than `worst_rad`. Row 2 of `quaternions` gets the start of QUEST;
    `scratch` (3, 3, 3) is written to.
    """
    n = len(b)
    first, second, sine = widest_pair(b, r, weights)
    if sine <= LEAST_SINE:
        return False
    matrix, attitude = scratch[0], scratch[1]
    information(b, weights, matrix)
    if not inverse_symmetric(matrix, covariance):
        return False
    # Every axis is better than the bound if M - I / worst^2 is positive definite.
    least = 1.0 / (worst_rad * worst_rad)
    m00, m11, m22 = matrix[0, 0] - least, matrix[1, 1] - least, matrix[2, 2] - least
    minor = m00 * m11 - matrix[0, 1] * matrix[0, 1]
    determinant = (
        m00 * (m11 * m22 - matrix[1, 2] * matrix[1, 2])
        - matrix[0, 1] * (matrix[0, 1] * m22 - matrix[1, 2] * matrix[0, 2])
        + matrix[0, 2] * (matrix[0, 1] * matrix[1, 2] - m11 * matrix[0, 2])
    )
    if m00 <= 0.0 or minor <= 0.0 or determinant <= 0.0:
        return False
    if chosen == TRIAD:
        triad_covariance(
            b[first], b[second], 1.0 / weights[first], 1.0 / weights[second], covariance
        )
        if not within(covariance, worst_rad * worst_rad):
            return False
    triad(b[first], b[second], r[first], r[second], attitude)
    to_quaternion(attitude, quaternions[TRIAD])
    # The widest pair may have large sigmas; TRIAD of the most accurate pair is near the optimum.
    start = quaternions[START]
    anchor, other = firmest_pair(b, r, weights)
    if anchor == other:
        for i in range(4):
            start[i] = quaternions[TRIAD, i]
    else:
        triad(b[anchor], b[other], r[anchor], r[other], attitude)
        to_quaternion(attitude, start)
    quest(b, r, weights, start, quaternions[QUEST], scratch)
    for method in range(2):
        to_matrix(quaternions[method], attitude)
        for k in range(n):
            squares[method, k] = 0.0
            for i in range(3):
                apart = b[k, i] - (
                    attitude[i, 0] * r[k, 0] + attitude[i, 1] * r[k, 1] + attitude[i, 2] * r[k, 2]
                )
                squares[method, k] += apart * apart
        plain = weighted = 0.0
        for k in range(n):
            plain += squares[method, k]
            weighted += squares[method, k] * weights[k]
        sums[method, PLAIN], sums[method, WEIGHTED] = plain, weighted
    sums[chosen, EXPECTED] = _expected_square(b, weights, covariance, chosen, first, second)
    return True


@njit_no_refcount
def _expected_square(b, weights, p, chosen, first, second):  # type: ignore[no-untyped-def]
    """The expected sum of squared residuals for an attitude with covariance `p`.

    A residual is the star's own noise and, across the star, the attitude's error. QUEST's error
    reduces the sum by as much as it would increase it for independent stars. With TRIAD the
    residual of its pair is the difference between the observed and the reference separation, and
    other stars have both parts.
    """
    trace = p[0, 0] + p[1, 1] + p[2, 2]
    total = 0.0
    for k in range(len(weights)):
        variance = 1.0 / weights[k]
        if chosen == TRIAD and k in (first, second):
            total += variance
            continue
        across = trace
        for i in range(3):
            for j in range(3):
                across -= b[k, i] * p[i, j] * b[k, j]
        total += 2.0 * variance + (across if chosen == TRIAD else -across)
    return max(total, 0.0)


@njit(error_model="numpy")
def fit_attitude(b, r, sigma_rad, worst_rad, chosen, workspace):  # type: ignore[no-untyped-def]
    """Fit an attitude to matched vectors into `workspace`, in arcsec; false if there is none.

    `chosen` is the row of the method whose attitude, covariance and residuals go to the workspace.
    TASTE is always QUEST's: only at the optimal attitude is the weighted sum of squares chi-square
    with 2 n - 3 degrees of freedom.
    """
    n = len(b)
    weights, squares, sums = np.empty(n), np.empty((2, n)), np.empty((2, 3))
    scratch = np.empty((3, 3, 3))
    for k in range(n):
        weights[k] = 1.0 / (sigma_rad[k] * sigma_rad[k])
    quaternions, covariance, figures = (
        workspace.quaternions,
        workspace.covariance_arcsec2,
        workspace.figures,
    )
    problem = b, r, weights, worst_rad, chosen
    if not solve(*problem, quaternions, covariance, squares, sums, scratch):
        return False
    to_matrix(quaternions[chosen], workspace.attitude)
    for i in range(3):
        for j in range(3):
            covariance[i, j] *= ARCSEC_PER_RADIAN * ARCSEC_PER_RADIAN
    for k in range(n):
        workspace.residual_arcsec[k] = math.sqrt(squares[chosen, k]) * ARCSEC_PER_RADIAN
    apart = along = 0.0
    for i in range(4):
        apart += (quaternions[TRIAD, i] - quaternions[QUEST, i]) ** 2
        along += (quaternions[TRIAD, i] + quaternions[QUEST, i]) ** 2
    half = 0.5 * math.sqrt(min(apart, along))
    figures[RMS] = math.sqrt(sums[chosen, PLAIN] / n) * ARCSEC_PER_RADIAN
    figures[PREDICTED_RMS] = math.sqrt(sums[chosen, EXPECTED] / n) * ARCSEC_PER_RADIAN
    figures[TASTE] = sums[QUEST, WEIGHTED]
    figures[APART] = 4.0 * math.asin(min(1.0, half)) * ARCSEC_PER_RADIAN
    return True
