"""The QUEST method, compiled, with final Gauss-Newton steps.

b are observed unit vectors in body axes, r the reference vectors in inertial
axes, weights are sigma^-2 with sigma in radians.
"""

from service.attitude.covariance import inverse_symmetric
from service.attitude.quaternions import normalise, to_matrix
from service.compiled.jit import njit_no_refcount

NEWTON_STEPS = 30
POLISHING_STEPS = 10


@njit_no_refcount
def quest(b, r, weights, start, q, scratch):  # type: ignore[no-untyped-def]
    """Solve Wahba's problem by QUEST (Shuster & Oh 1981) into `q`, with `scratch` (3, 3, 3).

    `start` is an approximate quaternion: its largest component selects a half turn by which the
    reference vectors are rotated first, so that the scalar part of the solved quaternion is never
    small. Otherwise exact half turns would fail. For a narrow field or very different weights the
    characteristic polynomial is ill-conditioned: then the start replaces the solution from its
    root. Gauss-Newton steps on the residuals refine the result.
    """
    turn = 3
    for i in range(3):
        if abs(start[i]) > abs(start[turn]):
            turn = i
    total = 0.0
    for k in range(len(weights)):
        total += weights[k]
    # B = sum of a b r^T, in scalars: sums in arrays would wait for memory.
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
    largest = _largest_root(pa, pb, pc, pd, sigma)
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
    normalise(q)
    if not _loss(b, r, weights, q, scratch[0]) <= _loss(b, r, weights, start, scratch[0]):
        for i in range(4):
            q[i] = start[i]
    _polish(b, r, weights, q, scratch)


@njit_no_refcount
def _largest_root(pa, pb, pc, pd, sigma):  # type: ignore[no-untyped-def]
    """The largest root of QUEST's characteristic polynomial, by Newton steps from 1."""
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
    return largest


@njit_no_refcount
def _loss(b, r, weights, q, a):  # type: ignore[no-untyped-def]
    """Wahba's loss function at a quaternion; `a` (3, 3) is work space."""
    to_matrix(q, a)
    total = 0.0
    for k in range(len(weights)):
        for i in range(3):
            apart = b[k, i] - a[i, 0] * r[k, 0] - a[i, 1] * r[k, 1] - a[i, 2] * r[k, 2]
            total += weights[k] * apart * apart
    return total


@njit_no_refcount
def _polish(b, r, weights, q, scratch):  # type: ignore[no-untyped-def]
    a, matrix, inverse = scratch[0], scratch[1], scratch[2]
    for _ in range(POLISHING_STEPS):
        to_matrix(q, a)
        g0 = g1 = g2 = 0.0
        m00 = m01 = m02 = m11 = m12 = m22 = 0.0
        for k in range(len(weights)):
            p0 = a[0, 0] * r[k, 0] + a[0, 1] * r[k, 1] + a[0, 2] * r[k, 2]
            p1 = a[1, 0] * r[k, 0] + a[1, 1] * r[k, 1] + a[1, 2] * r[k, 2]
            p2 = a[2, 0] * r[k, 0] + a[2, 1] * r[k, 1] + a[2, 2] * r[k, 2]
            # b x p, written with the residual b - p to keep its digits.
            d0, d1, d2 = b[k, 0] - p0, b[k, 1] - p1, b[k, 2] - p2
            g0 += weights[k] * (d1 * p2 - d2 * p1)
            g1 += weights[k] * (d2 * p0 - d0 * p2)
            g2 += weights[k] * (d0 * p1 - d1 * p0)
            # The information matrix, as in `information`.
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
        normalise(q)
        # The remaining error is smaller by the size of the residuals in radians.
        if square < 1e-24:
            return
