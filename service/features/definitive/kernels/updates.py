"""Compiled filter updates by a measured attitude or a single direction.

The innovation is the rotation, in radians about the body axes, from the predicted attitude to the
measured one; for a direction, two components across the predicted direction.
"""

import math
from typing import Any, NamedTuple

from service.attitude.covariance import cholesky, congruence, solve_factored
from service.attitude.quaternions import rotation_between, to_matrix
from service.compiled.jit import njit_no_refcount

ATTITUDE, DIRECTION = 0, 1
"""Kinds of measurements: an attitude with three components, a direction with two."""


class Measured(NamedTuple):
    """Input arrays of m measurements in order of time.

    `kind` (m,) is ATTITUDE or DIRECTION.  For an attitude: `quaternion` (m, 4) and `covariance` (m,
    3, 3) in rad^2 about the body axes.  For a direction: unit vectors `body` and `inertial` (m, 3),
    and `covariance` holds sigma^2 in its diagonal.
    """

    kind: Any
    quaternion: Any
    covariance: Any
    body: Any
    inertial: Any


class Innovations(NamedTuple):
    """Output arrays of the filter for m measurements; see `result.FilterResult`."""

    innovation: Any
    covariance: Any
    nis: Any
    outcome: Any


@njit_no_refcount
def innovate(q, measured, m, z, h, small):  # type: ignore[no-untyped-def]
    """Compute the innovation `z` (3,) of a measurement, and its derivatives `h` (3, 3) by theta.

    Returns the number of components, and the angle between prediction and measurement in radians.
    `small` (3, 3) is overwritten.
    """
    if measured.kind[m] == ATTITUDE:
        rotation_between(q, measured.quaternion[m], z)
        for i in range(3):
            for j in range(3):
                h[i, j] = 1.0 if i == j else 0.0
        return 3, math.sqrt(z[0] * z[0] + z[1] * z[1] + z[2] * z[2])
    to_matrix(q, small)
    b, r = measured.body[m], measured.inertial[m]
    # The predicted direction p, and the two unit vectors across it that are rows of h.
    p0 = small[0, 0] * r[0] + small[0, 1] * r[1] + small[0, 2] * r[2]
    p1 = small[1, 0] * r[0] + small[1, 1] * r[1] + small[1, 2] * r[2]
    p2 = small[2, 0] * r[0] + small[2, 1] * r[1] + small[2, 2] * r[2]
    if abs(p0) <= abs(p1) and abs(p0) <= abs(p2):
        u0, u1, u2 = 0.0, -p2, p1
    elif abs(p1) <= abs(p2):
        u0, u1, u2 = p2, 0.0, -p0
    else:
        u0, u1, u2 = -p1, p0, 0.0
    norm = math.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    u0, u1, u2 = u0 / norm, u1 / norm, u2 / norm
    v0, v1, v2 = p1 * u2 - p2 * u1, p2 * u0 - p0 * u2, p0 * u1 - p1 * u0
    z[0] = u0 * b[0] + u1 * b[1] + u2 * b[2]
    z[1] = v0 * b[0] + v1 * b[1] + v2 * b[2]
    sine = math.sqrt(z[0] * z[0] + z[1] * z[1])
    angle = math.atan2(sine, p0 * b[0] + p1 * b[1] + p2 * b[2])
    # As an angle, so that the opposite direction is far off and not near.
    if sine > 0.0:
        z[0], z[1] = z[0] * angle / sine, z[1] * angle / sine
    else:
        z[0] = angle
    # u . (p x theta) = theta . (u x p) = -theta . v, and v . (p x theta) = theta . u.
    h[0, 0], h[0, 1], h[0, 2] = -v0, -v1, -v2
    h[1, 0], h[1, 1], h[1, 2] = u0, u1, u2
    return 2, angle


@njit_no_refcount
def add_curvature(p, r):  # type: ignore[no-untyped-def]
    """Add the error of the tangent plane, about |theta|^2 / 2, to the covariance of a direction.

    Without this term single stars accurate to arcseconds would make an attitude uncertain by
    degrees appear equally accurate, though wrong by arcminutes.
    """
    trace = p[0, 0] + p[1, 1] + p[2, 2]
    for i in range(3):
        r[i, i] += 0.5 * trace * trace


@njit_no_refcount
def innovation_covariance(p, h, size, r, s, work):  # type: ignore[no-untyped-def]
    """Innovation covariance S = H P H^T + R into `s` (3, 3); `work` keeps its factor and H P.

    Returns False if S is not positive definite.
    """
    hp = work.projected
    for i in range(size):
        for j in range(6):
            hp[i, j] = h[i, 0] * p[0, j] + h[i, 1] * p[1, j] + h[i, 2] * p[2, j]
    for i in range(size):
        for j in range(size):
            s[i, j] = r[i, j]
            for k in range(3):
                s[i, j] += hp[i, k] * h[j, k]
    return cholesky(s, size, work.small)


@njit_no_refcount
def chi_square(z, size, work):  # type: ignore[no-untyped-def]
    """Normalised innovation squared z^T S^-1 z; `work.small` (3, 3) is the factor of S."""
    theta, total = work.theta, 0.0
    for i in range(size):
        theta[i] = z[i]
    solve_factored(work.small, size, theta)
    for i in range(size):
        total += z[i] * theta[i]
    return total


@njit_no_refcount
def redundancy_of(r, size, work):  # type: ignore[no-untyped-def]
    """Redundancy number of a measurement (Baarda, 1968): the mean over its components of R S^-1.

    The number is 0 if any measurement would have been accepted, and 1 for an exact prediction.
    `work.small` has the factor of S.
    """
    theta, total = work.theta, 0.0
    for j in range(size):
        for i in range(size):
            theta[i] = r[i, j]
        solve_factored(work.small, size, theta)
        total += theta[j]
    return total / size


@njit_no_refcount
def correct(p, z, h, size, r, work):  # type: ignore[no-untyped-def]
    """Kalman update of the covariance `p` (6, 6) by a measurement, after `innovation_covariance`.

    `work.dx` (6,) receives the correction of the state, and P is updated in Joseph's form, (I - K
    H) P (I - K H)^T + K R K^T, which stays positive definite.
    """
    for j in range(6):
        row = work.gain[j]
        for i in range(size):
            row[i] = work.projected[i, j]
        solve_factored(work.small, size, row)
        work.dx[j] = 0.0
        for i in range(size):
            work.dx[j] += row[i] * z[i]
    _joseph(p, work.gain, h, size, r, work)


@njit_no_refcount
def _joseph(p, gain, h, size, r, work):  # type: ignore[no-untyped-def]
    """Covariance update in Joseph's form, (I - K H) P (I - K H)^T + K R K^T, symmetric."""
    reduced, product = work.phi, work.product
    for i in range(6):
        for j in range(6):
            reduced[i, j] = 1.0 if i == j else 0.0
        for j in range(3):
            for k in range(size):
                reduced[i, j] -= gain[i, k] * h[k, j]
    congruence(reduced, p, p, product)
    for i in range(6):
        for j in range(i + 1):
            total = p[i, j]
            for k in range(size):
                for n in range(size):
                    total += gain[i, k] * r[k, n] * gain[j, n]
            p[i, j] = p[j, i] = total
