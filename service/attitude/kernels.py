"""TRIAD, QUEST and the covariance, compiled.

b are observed unit vectors in body axes, r the reference vectors in inertial
axes, weights are sigma^-2 with sigma in radians.  Quaternions are scalar last,
inertial to body.
"""

import math

import numpy as np
from numba import njit

from service.uncounted import borrowing
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector

NEWTON_STEPS = 30
POLISHING_STEPS = 10
LEAST_SINE = 1e-12
"""Below this two vectors stand in one line."""
TRIAD, QUEST = 0, 1
"""Rows of the quaternions that are solved for."""


@borrowing
def _sine(a, b):  # type: ignore[no-untyped-def]
    x = a[1] * b[2] - a[2] * b[1]
    y = a[2] * b[0] - a[0] * b[2]
    z = a[0] * b[1] - a[1] * b[0]
    return math.sqrt(x * x + y * y + z * z)


@borrowing
def widest_pair(b, r, weights):  # type: ignore[no-untyped-def]
    """The two rows with the largest sine between them, the smaller sigma first, and that sine.

    The sine is that of the references, which have no noise: the pair that is
    widest as observed is too wide on average.  Two stars that were given one
    identity have a sine of zero.
    """
    first, second, widest = 0, 1, 0.0
    for i in range(len(r) - 1):
        for j in range(i + 1, len(r)):
            sine = _sine(r[i], r[j])
            if sine > widest and _sine(b[i], b[j]) > LEAST_SINE:
                first, second, widest = i, j, sine
    if weights[second] > weights[first]:
        first, second = second, first
    return first, second, widest


@borrowing
def _firmest_pair(b, r, weights):  # type: ignore[no-untyped-def]
    """The finest star, and the one that best fixes the turn about it by weight times sine^2."""
    first, second, firmest = 0, 0, 0.0
    for i in range(len(b)):
        if weights[i] > weights[first]:
            first = i
    for j in range(len(b)):
        firmness = weights[j] * _sine(b[first], b[j]) ** 2
        if firmness > firmest and _sine(r[first], r[j]) > LEAST_SINE:
            second, firmest = j, firmness
    return first, second


@borrowing
def _triad_frame(anchor, other):  # type: ignore[no-untyped-def]
    """The second and third axis of the frame whose first is the anchor."""
    x = anchor[1] * other[2] - anchor[2] * other[1]
    y = anchor[2] * other[0] - anchor[0] * other[2]
    z = anchor[0] * other[1] - anchor[1] * other[0]
    norm = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    third = (
        anchor[1] * z - anchor[2] * y,
        anchor[2] * x - anchor[0] * z,
        anchor[0] * y - anchor[1] * x,
    )
    return (x, y, z), third


@borrowing
def triad(b1, b2, r1, r2, attitude):  # type: ignore[no-untyped-def]
    """The matrix that takes r1 to b1 exactly and r2 into the plane of b1 and b2 (Black 1964)."""
    body2, body3 = _triad_frame(b1, b2)
    inertial2, inertial3 = _triad_frame(r1, r2)
    for i in range(3):
        for j in range(3):
            attitude[i, j] = b1[i] * r1[j] + body2[i] * inertial2[j] + body3[i] * inertial3[j]


@borrowing
def triad_covariance(b1, b2, variance1, variance2, covariance):  # type: ignore[no-untyped-def]
    """The covariance (3, 3) of `triad`, about the body axes, to first order (Shuster & Oh 1981).

    The noise of b1 along both its tangent axes and that of b2 across the plane
    enter; that of b2 in the plane does not.
    """
    cosine = b1[0] * b2[0] + b1[1] * b2[1] + b1[2] * b2[2]
    sine2 = _sine(b1, b2) ** 2
    along, beside = (variance2 - variance1) / sine2, variance1 * cosine / sine2
    for i in range(3):
        for j in range(3):
            covariance[i, j] = along * b1[i] * b1[j] + beside * (b1[i] * b2[j] + b2[i] * b1[j])
        covariance[i, i] += variance1


@borrowing
def within(p, largest):  # type: ignore[no-untyped-def]
    """Whether no axis of a covariance (3, 3) has more than the largest variance allowed.

    That is where I - P / largest is positive definite.
    """
    a, b, c = 1.0 - p[0, 0] / largest, 1.0 - p[1, 1] / largest, 1.0 - p[2, 2] / largest
    d, e, f = p[0, 1] / largest, p[0, 2] / largest, p[1, 2] / largest
    minor = a * b - d * d
    det = a * (b * c - f * f) - d * (d * c + f * e) - e * (d * f + b * e)
    return a > 0.0 and minor > 0.0 and det > 0.0


@borrowing
def to_matrix(q, a):  # type: ignore[no-untyped-def]
    """A(q) into a (3, 3)."""
    q1, q2, q3, qc = q[0], q[1], q[2], q[3]
    a[0, 0] = q1 * q1 - q2 * q2 - q3 * q3 + qc * qc
    a[0, 1] = 2 * (q1 * q2 + q3 * qc)
    a[0, 2] = 2 * (q1 * q3 - q2 * qc)
    a[1, 0] = 2 * (q1 * q2 - q3 * qc)
    a[1, 1] = -q1 * q1 + q2 * q2 - q3 * q3 + qc * qc
    a[1, 2] = 2 * (q2 * q3 + q1 * qc)
    a[2, 0] = 2 * (q1 * q3 + q2 * qc)
    a[2, 1] = 2 * (q2 * q3 - q1 * qc)
    a[2, 2] = -q1 * q1 - q2 * q2 + q3 * q3 + qc * qc


@borrowing
def to_quaternion(a, q):  # type: ignore[no-untyped-def]
    """The quaternion of an attitude matrix, qc >= 0, by Shepperd's largest component."""
    trace = a[0, 0] + a[1, 1] + a[2, 2]
    if trace >= a[0, 0] and trace >= a[1, 1] and trace >= a[2, 2]:
        q[0], q[1], q[2] = a[1, 2] - a[2, 1], a[2, 0] - a[0, 2], a[0, 1] - a[1, 0]
        q[3] = 1.0 + trace
    elif a[0, 0] >= a[1, 1] and a[0, 0] >= a[2, 2]:
        q[0], q[1] = 1.0 + a[0, 0] - a[1, 1] - a[2, 2], a[0, 1] + a[1, 0]
        q[2], q[3] = a[0, 2] + a[2, 0], a[1, 2] - a[2, 1]
    elif a[1, 1] >= a[2, 2]:
        q[0], q[1] = a[0, 1] + a[1, 0], 1.0 - a[0, 0] + a[1, 1] - a[2, 2]
        q[2], q[3] = a[1, 2] + a[2, 1], a[2, 0] - a[0, 2]
    else:
        q[0], q[1] = a[0, 2] + a[2, 0], a[1, 2] + a[2, 1]
        q[2], q[3] = 1.0 - a[0, 0] - a[1, 1] + a[2, 2], a[0, 1] - a[1, 0]
    _normalise(q)


@borrowing
def _normalise(q):  # type: ignore[no-untyped-def]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        norm = -norm
    for i in range(4):
        q[i] /= norm


@borrowing
def quest(b, r, weights, start, q, room):  # type: ignore[no-untyped-def]
    """Wahba's attitude by QUEST (Shuster & Oh 1981) into q; `room` (3, 3, 3) is written to.

    `start` is a rough quaternion: its largest component tells by which half
    turn to rotate the reference vectors first, so that the scalar part of what
    is solved for is never small.  Without it every exact half turn fails.  The
    characteristic polynomial loses its digits where the field is narrow or the
    weights are far apart: then the start stands in for its root.  Gauss-Newton
    steps on the residuals polish the answer.
    """
    turn = 3
    for i in range(3):
        if abs(start[i]) > abs(start[turn]):
            turn = i
    total = 0.0
    for k in range(len(weights)):
        total += weights[k]
    # B = sum of a b r^T, number by number: sums in arrays would wait for memory.
    b00 = b01 = b02 = b10 = b11 = b12 = b20 = b21 = b22 = 0.0
    sign0 = 1.0 if turn == 3 or turn == 0 else -1.0
    sign1 = 1.0 if turn == 3 or turn == 1 else -1.0
    sign2 = 1.0 if turn == 3 or turn == 2 else -1.0
    for k in range(len(weights)):
        share = weights[k] / total
        o0, o1, o2 = share * b[k, 0], share * b[k, 1], share * b[k, 2]
        r0, r1, r2 = sign0 * r[k, 0], sign1 * r[k, 1], sign2 * r[k, 2]
        b00 += o0 * r0
        b01 += o0 * r1
        b02 += o0 * r2
        b10 += o1 * r0
        b11 += o1 * r1
        b12 += o1 * r2
        b20 += o2 * r0
        b21 += o2 * r1
        b22 += o2 * r2
    sigma = b00 + b11 + b22
    s00, s11, s22 = 2.0 * b00, 2.0 * b11, 2.0 * b22
    s01, s02, s12 = b01 + b10, b02 + b20, b12 + b21
    z0, z1, z2 = b12 - b21, b20 - b02, b01 - b10
    c00 = s11 * s22 - s12 * s12
    c11 = s00 * s22 - s02 * s02
    c22 = s00 * s11 - s01 * s01
    kappa = c00 + c11 + c22
    det = s00 * c00 - s01 * (s01 * s22 - s12 * s02) + s02 * (s01 * s12 - s11 * s02)
    sz0 = s00 * z0 + s01 * z1 + s02 * z2
    sz1 = s01 * z0 + s11 * z1 + s12 * z2
    sz2 = s02 * z0 + s12 * z1 + s22 * z2
    zz = z0 * z0 + z1 * z1 + z2 * z2
    zsz = z0 * sz0 + z1 * sz1 + z2 * sz2
    zssz = sz0 * sz0 + sz1 * sz1 + sz2 * sz2
    pa = sigma * sigma - kappa
    pb = sigma * sigma + zz
    pc = det + zsz
    pd = zssz
    largest = 1.0
    for _ in range(NEWTON_STEPS):
        square = largest * largest
        value = (square - pa) * (square - pb) - pc * largest + (pc * sigma - pd)
        slope = 2.0 * largest * (2.0 * square - pa - pb) - pc
        if slope <= 0.0:
            break
        step = value / slope
        largest -= step
        if abs(step) < 1e-15:
            break
    alpha = largest * largest - sigma * sigma + kappa
    beta = largest - sigma
    gamma = (largest + sigma) * alpha - det
    x0 = alpha * z0 + beta * sz0 + s00 * sz0 + s01 * sz1 + s02 * sz2
    x1 = alpha * z1 + beta * sz1 + s01 * sz0 + s11 * sz1 + s12 * sz2
    x2 = alpha * z2 + beta * sz2 + s02 * sz0 + s12 * sz1 + s22 * sz2
    if turn == 0:
        q[0], q[1], q[2], q[3] = gamma, -x2, x1, -x0
    elif turn == 1:
        q[0], q[1], q[2], q[3] = x2, gamma, -x0, -x1
    elif turn == 2:
        q[0], q[1], q[2], q[3] = -x1, x0, gamma, -x2
    else:
        q[0], q[1], q[2], q[3] = x0, x1, x2, gamma
    _normalise(q)
    if not _loss(b, r, weights, q, room[0]) <= _loss(b, r, weights, start, room[0]):
        for i in range(4):
            q[i] = start[i]
    _polish(b, r, weights, q, room)


@borrowing
def _loss(b, r, weights, q, a):  # type: ignore[no-untyped-def]
    """Wahba's loss; `a` (3, 3) is written to."""
    to_matrix(q, a)
    total = 0.0
    for k in range(len(weights)):
        for i in range(3):
            apart = b[k, i] - a[i, 0] * r[k, 0] - a[i, 1] * r[k, 1] - a[i, 2] * r[k, 2]
            total += weights[k] * apart * apart
    return total


@borrowing
def information(vectors, weights, matrix):  # type: ignore[no-untyped-def]
    """Sum of sigma^-2 (I - v v^T): the inverse of the covariance, in rad^-2."""
    m00 = m01 = m02 = m11 = m12 = m22 = 0.0
    for k in range(len(weights)):
        w, v0, v1, v2 = weights[k], vectors[k, 0], vectors[k, 1], vectors[k, 2]
        m00 = m00 + w - w * v0 * v0
        m11 = m11 + w - w * v1 * v1
        m22 = m22 + w - w * v2 * v2
        m01 -= w * v0 * v1
        m02 -= w * v0 * v2
        m12 -= w * v1 * v2
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = m00, m11, m22
    matrix[0, 1] = matrix[1, 0] = m01
    matrix[0, 2] = matrix[2, 0] = m02
    matrix[1, 2] = matrix[2, 1] = m12


@borrowing
def inverse_symmetric(m, out):  # type: ignore[no-untyped-def]
    """The inverse of a symmetric (3, 3); False where it has none."""
    c00 = m[1, 1] * m[2, 2] - m[1, 2] * m[1, 2]
    c01 = m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2]
    c02 = m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    det = m[0, 0] * c00 + m[0, 1] * c01 + m[0, 2] * c02
    scale = m[0, 0] + m[1, 1] + m[2, 2]
    if not det > 1e-15 * scale * scale * scale:
        return False
    out[0, 0] = c00 / det
    out[0, 1] = out[1, 0] = c01 / det
    out[0, 2] = out[2, 0] = c02 / det
    out[1, 1] = (m[0, 0] * m[2, 2] - m[0, 2] * m[0, 2]) / det
    out[1, 2] = out[2, 1] = (m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2]) / det
    out[2, 2] = (m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]) / det
    return True


@borrowing
def _polish(b, r, weights, q, room):  # type: ignore[no-untyped-def]
    a, matrix, inverse = room[0], room[1], room[2]
    for _ in range(POLISHING_STEPS):
        to_matrix(q, a)
        g0 = g1 = g2 = 0.0
        m00 = m01 = m02 = m11 = m12 = m22 = 0.0
        for k in range(len(weights)):
            p0 = a[0, 0] * r[k, 0] + a[0, 1] * r[k, 1] + a[0, 2] * r[k, 2]
            p1 = a[1, 0] * r[k, 0] + a[1, 1] * r[k, 1] + a[1, 2] * r[k, 2]
            p2 = a[2, 0] * r[k, 0] + a[2, 1] * r[k, 1] + a[2, 2] * r[k, 2]
            # b x p, written with the residual b - p so that it keeps its digits.
            d0, d1, d2 = b[k, 0] - p0, b[k, 1] - p1, b[k, 2] - p2
            g0 += weights[k] * (d1 * p2 - d2 * p1)
            g1 += weights[k] * (d2 * p0 - d0 * p2)
            g2 += weights[k] * (d0 * p1 - d1 * p0)
            # As in `information`.
            w = weights[k]
            m00 = m00 + w - w * p0 * p0
            m11 = m11 + w - w * p1 * p1
            m22 = m22 + w - w * p2 * p2
            m01 -= w * p0 * p1
            m02 -= w * p0 * p2
            m12 -= w * p1 * p2
        matrix[0, 0], matrix[1, 1], matrix[2, 2] = m00, m11, m22
        matrix[0, 1] = matrix[1, 0] = m01
        matrix[0, 2] = matrix[2, 0] = m02
        matrix[1, 2] = matrix[2, 1] = m12
        if not inverse_symmetric(matrix, inverse):
            return
        e0 = 0.5 * (inverse[0, 0] * g0 + inverse[0, 1] * g1 + inverse[0, 2] * g2)
        e1 = 0.5 * (inverse[1, 0] * g0 + inverse[1, 1] * g1 + inverse[1, 2] * g2)
        e2 = 0.5 * (inverse[2, 0] * g0 + inverse[2, 1] * g1 + inverse[2, 2] * g2)
        square = e0 * e0 + e1 * e1 + e2 * e2
        if square > 0.25:
            return  # no small correction: the vectors do not agree, and the start stands
        # (e/2, 1) composed with q: A becomes exp(-[e x]) A.
        q0, q1, q2, qc = q[0], q[1], q[2], q[3]
        q[0] = qc * e0 + q0 + q1 * e2 - q2 * e1
        q[1] = qc * e1 + q1 + q2 * e0 - q0 * e2
        q[2] = qc * e2 + q2 + q0 * e1 - q1 * e0
        q[3] = qc - q0 * e0 - q1 * e1 - q2 * e2
        _normalise(q)
        # What is left is smaller by the size of the residuals, as parts of a radian.
        if square < 1e-24:
            return


@borrowing
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
    room: Vector,
) -> bool:
    """TRIAD into row 0 of `quaternions` (3, 4), QUEST into row 1.

    `covariance` (3, 3) gets that of the method in row `chosen`, in rad^2.
    `squares` (2, n) gets the squared residuals |b - A r|^2 of either, `sums`
    (2, 3) their sum, their sum in units of sigma^2 and, in row `chosen`, the
    expectation of the first.  False where the geometry leaves the chosen
    attitude an axis worse than `worst_rad`.  Row 2 of `quaternions` gets the
    start of QUEST; `room` (3, 3, 3) is written to.
    """
    n = len(b)
    first, second, sine = widest_pair(b, r, weights)
    if sine <= LEAST_SINE:
        return False
    matrix, attitude = room[0], room[1]
    information(b, weights, matrix)
    if not inverse_symmetric(matrix, covariance):
        return False
    # Every axis is better than the bound where M - I / worst^2 is positive definite.
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
    to_quaternion(attitude, quaternions[0])
    # The widest pair may be of coarse stars; TRIAD of the firmest is near the optimum.
    start = quaternions[2]
    anchor, other = _firmest_pair(b, r, weights)
    if anchor == other:
        for i in range(4):
            start[i] = quaternions[0, i]
    else:
        triad(b[anchor], b[other], r[anchor], r[other], attitude)
        to_quaternion(attitude, start)
    quest(b, r, weights, start, quaternions[1], room)
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
        sums[method, 0], sums[method, 1] = plain, weighted
    sums[chosen, 2] = _expected_square(b, weights, covariance, chosen, first, second)
    return True


@borrowing
def _expected_square(b, weights, p, chosen, first, second):  # type: ignore[no-untyped-def]
    """The expectation of the sum of squared residuals at an attitude of covariance `p`.

    A residual is the star's own noise and, across the star, the attitude's
    error.  QUEST's error takes as much from the sum as it would add to that of
    a star that it was not solved from.  TRIAD leaves its pair the difference
    between the separations observed and referred to, and others both parts.
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


@njit(cache=True, error_model="numpy")
def fit(b, r, sigma_rad, worst_rad, chosen, quaternions, matrices, residual):  # type: ignore[no-untyped-def]
    """All that `solve` gives, in one call and in the units that are shown; whether there is any.

    `quaternions` (3, 4) gets those of TRIAD and QUEST and, of the method in row
    `chosen`, the rms residual and what the covariance predicts of that, then
    QUEST's TASTE and the angle between both attitudes, angles in arcsec.
    `matrices` (2, 3, 3) gets the chosen attitude and the covariance in arcsec^2,
    `residual` (n,) the residuals in arcsec.

    TASTE is QUEST's whichever method is chosen: at the optimal attitude alone
    the weighted sum of squares is chi-square with 2 n - 3 degrees of freedom.
    """
    n = len(b)
    weights, squares, sums, room = (
        np.empty(n),
        np.empty((2, n)),
        np.empty((2, 3)),
        np.empty((3, 3, 3)),
    )
    for k in range(n):
        weights[k] = 1.0 / (sigma_rad[k] * sigma_rad[k])
    covariance, told = matrices[1], quaternions[2]
    given = b, r, weights, worst_rad, chosen
    if not solve(*given, quaternions, covariance, squares, sums, room):
        return False
    to_matrix(quaternions[chosen], matrices[0])
    for i in range(3):
        for j in range(3):
            covariance[i, j] *= ARCSEC_PER_RADIAN * ARCSEC_PER_RADIAN
    for k in range(n):
        residual[k] = math.sqrt(squares[chosen, k]) * ARCSEC_PER_RADIAN
    apart = along = 0.0
    for i in range(4):
        apart += (quaternions[0, i] - quaternions[1, i]) ** 2
        along += (quaternions[0, i] + quaternions[1, i]) ** 2
    half = 0.5 * math.sqrt(min(apart, along))
    told[0] = math.sqrt(sums[chosen, 0] / n) * ARCSEC_PER_RADIAN
    told[1] = math.sqrt(sums[chosen, 2] / n) * ARCSEC_PER_RADIAN
    told[2] = sums[QUEST, 1]
    told[3] = 4.0 * math.asin(min(1.0, half)) * ARCSEC_PER_RADIAN
    return True
