"""The fit of a hypothesis' attitude, and its posterior weight.

A hypothesis is `match` (n,): for every observed star the row of a zone star,
-1 for clutter.
"""

import math

import numpy as np

from service.attitude.covariance import inverse_symmetric
from service.attitude.triad import triad
from service.compiled.jit import njit_inlined, njit_no_refcount
from service.identify.hypotheses import evidence
from service.identify.hypotheses.scene import with_magnitude
from service.identify.sighting import PRIOR_ROTATION
from service.sky.geometry.directions import separation_rad

LEAST_SINE2 = 4e-10
"""Least value of four times the squared sine of the widest pair's angle, for 2 arcsec."""


@njit_inlined
def fit_match(observed, stars, match, scratch, steps):  # type: ignore[no-untyped-def]
    """Fit the attitude T of a hypothesis: TRIAD on the widest pair, then Gauss-Newton steps.

    Returns the number of stars, the weighted sum of squared residuals and
    ln det N; the number is 0 where the geometry gives no attitude.
    In `scratch`, `t` gets T, `matrix` N and `references` the apparent directions
    of the matched stars.
    """
    t, matrix, inverse, references = scratch.t, scratch.matrix, scratch.inverse, scratch.references
    n = len(match)
    direction = observed.direction
    count = 0
    for k in range(n):
        if match[k] >= 0:
            count += 1
            norm = 0.0
            for i in range(3):
                references[k, i] = stars.direction[match[k], i] + observed.velocity[i]
                norm += references[k, i] ** 2
            norm = math.sqrt(norm)
            for i in range(3):
                references[k, i] /= norm
    first = second = -1
    widest = 0.0
    for k in range(n - 1):
        if match[k] < 0:
            continue
        for other in range(k + 1, n):
            if match[other] >= 0:
                chord2 = 0.0
                for i in range(3):
                    chord2 += (references[k, i] - references[other, i]) ** 2
                # Four times the squared sine is small both near zero and near a half turn.
                apart = chord2 * (4.0 - chord2)
                if apart > widest:
                    widest, first, second = apart, k, other
    if widest < LEAST_SINE2 or separation_rad(direction[first], direction[second]) < 1e-5:
        return 0, 0.0, 0.0
    triad(direction[first], direction[second], references[first], references[second], t)
    square = 0.0
    for step in range(steps + 1):
        matrix[:] = 0.0
        g0 = g1 = g2 = square = 0.0
        for k in range(n):
            if match[k] < 0:
                continue
            w = observed.weight[k]
            r = references[k]
            p0 = t[0, 0] * r[0] + t[0, 1] * r[1] + t[0, 2] * r[2]
            p1 = t[1, 0] * r[0] + t[1, 1] * r[1] + t[1, 2] * r[2]
            p2 = t[2, 0] * r[0] + t[2, 1] * r[1] + t[2, 2] * r[2]
            d0, d1, d2 = direction[k, 0] - p0, direction[k, 1] - p1, direction[k, 2] - p2
            square += w * (d0 * d0 + d1 * d1 + d2 * d2)
            g0 += w * (d1 * p2 - d2 * p1)
            g1 += w * (d2 * p0 - d0 * p2)
            g2 += w * (d0 * p1 - d1 * p0)
            matrix[0, 0] += w * (1.0 - p0 * p0)
            matrix[1, 1] += w * (1.0 - p1 * p1)
            matrix[2, 2] += w * (1.0 - p2 * p2)
            matrix[0, 1] -= w * p0 * p1
            matrix[0, 2] -= w * p0 * p2
            matrix[1, 2] -= w * p1 * p2
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = matrix[0, 1], matrix[0, 2], matrix[1, 2]
        if step == steps:
            break
        if not inverse_symmetric(matrix, inverse):
            return 0, 0.0, 0.0
        e0 = inverse[0, 0] * g0 + inverse[0, 1] * g1 + inverse[0, 2] * g2
        e1 = inverse[1, 0] * g0 + inverse[1, 1] * g1 + inverse[1, 2] * g2
        e2 = inverse[2, 0] * g0 + inverse[2, 1] * g1 + inverse[2, 2] * g2
        turn(t, e0, e1, e2)
    det = _determinant(matrix)
    if not det > 0.0:
        return 0, 0.0, 0.0
    return count, square, math.log(det)


@njit_no_refcount
def work_of_fit(n, matched):  # type: ignore[no-untyped-def]
    """The work units of a fit: all pairs of matched stars are compared to find the widest."""
    return n + n * matched // 100


@njit_no_refcount
def _determinant(m):  # type: ignore[no-untyped-def]
    """The determinant of a symmetric matrix (3, 3)."""
    return (
        m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] ** 2)
        - m[0, 1] * (m[0, 1] * m[2, 2] - m[1, 2] * m[0, 2])
        + m[0, 2] * (m[0, 1] * m[1, 2] - m[1, 1] * m[0, 2])
    )


@njit_no_refcount
def turn(t, e0, e1, e2):  # type: ignore[no-untyped-def]
    """Rotate an attitude matrix T in place by a vector e, to exp(-[e x]) T, kept orthonormal."""
    norm = 1.0 / math.sqrt(1.0 + 0.25 * (e0 * e0 + e1 * e1 + e2 * e2))
    x, y, z, c = 0.5 * e0 * norm, 0.5 * e1 * norm, 0.5 * e2 * norm, norm
    for j in range(3):
        a, b, d = t[0, j], t[1, j], t[2, j]
        t[0, j] = (
            (x * x - y * y - z * z + c * c) * a + 2 * (x * y + z * c) * b + 2 * (x * z - y * c) * d
        )
        t[1, j] = (
            2 * (x * y - z * c) * a + (-x * x + y * y - z * z + c * c) * b + 2 * (y * z + x * c) * d
        )
        t[2, j] = (
            2 * (x * z + y * c) * a + 2 * (y * z - x * c) * b + (-x * x - y * y + z * z + c * c) * d
        )


@njit_no_refcount
def prior_angle(t, axis, kind):  # type: ignore[no-untyped-def]
    """Angle that enters the attitude prior: T's total rotation, or the tilt of the known axis."""
    if kind == PRIOR_ROTATION:
        x, y, z = t[2, 1] - t[1, 2], t[0, 2] - t[2, 0], t[1, 0] - t[0, 1]
        return math.atan2(math.sqrt(x * x + y * y + z * z), t[0, 0] + t[1, 1] + t[2, 2] - 1.0)
    chord2 = 0.0
    for j in range(3):
        carried = axis[0] * t[0, j] + axis[1] * t[1, j] + axis[2] * t[2, j]
        chord2 += (carried - axis[j]) ** 2
    return 2.0 * math.asin(min(1.0, 0.5 * math.sqrt(chord2)))


@njit_inlined
def weigh(observed, stars, match, scratch):  # type: ignore[no-untyped-def]
    """The log posterior weight of a hypothesis after fitting; see `fit_match`."""
    count, square, log_det = fit_match(observed, stars, match, scratch, 1)
    if count < 2:
        return -math.inf
    return log_weight_of(observed, stars, match, scratch.t, count, square, log_det)


@njit_no_refcount
def weigh_without(observed, stars, match, k, square, scratch):  # type: ignore[no-untyped-def]
    """The log weight of a fitted hypothesis in `scratch` with star k changed to clutter.

    The fit is linear within its residuals: the contributions of star k to N, to the sum of squares
    and to the gradient, which is zero, are subtracted. `match` has -1 for star k already.
    """
    t, matrix, smaller, inverse, turned = (
        scratch.t,
        scratch.matrix,
        scratch.smaller,
        scratch.inverse,
        scratch.turned,
    )
    w, v, r = observed.weight[k], observed.direction[k], scratch.references[k]
    count = 0
    for other in match:
        if other >= 0:
            count += 1
    if count < 2:
        return -math.inf
    p0 = t[0, 0] * r[0] + t[0, 1] * r[1] + t[0, 2] * r[2]
    p1 = t[1, 0] * r[0] + t[1, 1] * r[1] + t[1, 2] * r[2]
    p2 = t[2, 0] * r[0] + t[2, 1] * r[1] + t[2, 2] * r[2]
    d0, d1, d2 = v[0] - p0, v[1] - p1, v[2] - p2
    smaller[0, 0] = matrix[0, 0] - w * (1.0 - p0 * p0)
    smaller[1, 1] = matrix[1, 1] - w * (1.0 - p1 * p1)
    smaller[2, 2] = matrix[2, 2] - w * (1.0 - p2 * p2)
    smaller[0, 1] = smaller[1, 0] = matrix[0, 1] + w * p0 * p1
    smaller[0, 2] = smaller[2, 0] = matrix[0, 2] + w * p0 * p2
    smaller[1, 2] = smaller[2, 1] = matrix[1, 2] + w * p1 * p2
    det = _determinant(smaller)
    if not det > 0.0 or not inverse_symmetric(smaller, inverse):
        return -math.inf
    g0, g1, g2 = w * (d1 * p2 - d2 * p1), w * (d2 * p0 - d0 * p2), w * (d0 * p1 - d1 * p0)
    e0 = inverse[0, 0] * g0 + inverse[0, 1] * g1 + inverse[0, 2] * g2
    e1 = inverse[1, 0] * g0 + inverse[1, 1] * g1 + inverse[1, 2] * g2
    e2 = inverse[2, 0] * g0 + inverse[2, 1] * g1 + inverse[2, 2] * g2
    left = square - w * (d0 * d0 + d1 * d1 + d2 * d2) - (g0 * e0 + g1 * e1 + g2 * e2)
    for i in range(3):
        for j in range(3):
            turned[i, j] = t[i, j]
    turn(turned, -e0, -e1, -e2)
    return log_weight_of(observed, stars, match, turned, count, max(left, 0.0), math.log(det))


@njit_inlined
def log_weight_of(observed, stars, match, t, count, square, log_det):  # type: ignore[no-untyped-def]
    """The log posterior weight of a fitted hypothesis of `count` stars."""
    compared = clutter = 0
    total = total2 = 0.0
    log_relative = 0.0
    for k in range(len(match)):
        if match[k] >= 0 and observed.weight[k] != 1.0:
            log_relative += math.log(observed.weight[k])
        if np.isnan(observed.magnitude[k]):
            continue
        if match[k] < 0:
            clutter += 1
            continue
        difference = observed.magnitude[k] - stars.magnitude[match[k]]
        compared += 1
        total += difference
        total2 += difference * difference
    of_two = 0.0
    if count == 2:
        others = len(match) - count
        of_two = evidence.log_of_two(square, compared, total2, observed.reference_sigma, others)
    kind = observed.prior_kind
    return (
        evidence.log_prior(prior_angle(t, observed.prior_axis, kind), kind)
        + evidence.log_positions(count, square, log_det, observed.reference_sigma)
        + log_relative
        + of_two
        + evidence.log_magnitudes(compared, total, total2)
        + evidence.log_clutter(len(match) - count, count)
        - clutter * evidence.LOG_CLUTTER_SPAN
        - count * stars.log_density
    )


@njit_no_refcount
def log_weight_bound(observed, stars, count, compared):  # type: ignore[no-untyped-def]
    """An upper bound on the log weight of a hypothesis of `count` stars, apart from det N.

    It assumes no residuals, equal magnitudes, of which `compared` stars have one, and the presumed
    attitude.
    """
    n = len(observed.direction)
    clutter = with_magnitude(observed) - compared
    of_two = 0.0
    if count == 2:
        of_two = evidence.log_of_two(0.0, compared, 0.0, observed.reference_sigma, n - count)
    return (
        evidence.LOG_PRIOR_AT_BEST[observed.prior_kind]
        + evidence.log_exact_positions(count, observed.reference_sigma)
        + evidence.log_equal_magnitudes(compared)
        + of_two
        + evidence.log_clutter(n - count, count)
        - clutter * evidence.LOG_CLUTTER_SPAN
        - count * stars.log_density
    )
