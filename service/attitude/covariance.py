"""Covariances (3, 3) of small rotations, and their inverses, compiled."""

from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def within(p, largest):  # type: ignore[no-untyped-def]
    """Whether no axis of a covariance (3, 3) has more than the largest variance allowed.

    That is where I - P / largest is positive definite.
    """
    a, b, c = 1.0 - p[0, 0] / largest, 1.0 - p[1, 1] / largest, 1.0 - p[2, 2] / largest
    d, e, f = p[0, 1] / largest, p[0, 2] / largest, p[1, 2] / largest
    minor = a * b - d * d
    det = a * (b * c - f * f) - d * (d * c + f * e) - e * (d * f + b * e)
    return a > 0.0 and minor > 0.0 and det > 0.0


@njit_no_refcount
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


@njit_no_refcount
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
