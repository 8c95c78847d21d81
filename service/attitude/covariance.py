"""Compiled functions for small matrices: covariances, inverses, Cholesky factors, products.

They allocate nothing.
"""

import math

from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def within(p, largest):  # type: ignore[no-untyped-def]
    """True if no axis of a covariance (3, 3) has more than the largest allowed variance.

    The condition is that I - P / largest is positive definite.
    """
    a, b, c = 1.0 - p[0, 0] / largest, 1.0 - p[1, 1] / largest, 1.0 - p[2, 2] / largest
    d, e, f = p[0, 1] / largest, p[0, 2] / largest, p[1, 2] / largest
    minor = a * b - d * d
    det = a * (b * c - f * f) - d * (d * c + f * e) - e * (d * f + b * e)
    return a > 0.0 and minor > 0.0 and det > 0.0


@njit_no_refcount
def information(vectors, weights, matrix):  # type: ignore[no-untyped-def]
    """The information matrix of unit vectors, sum of sigma^-2 (I - v v^T), in rad^-2."""
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
    """Write the inverse of a symmetric matrix (3, 3) into `out`; false if it is singular."""
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


@njit_no_refcount
def multiply(a, b, out):  # type: ignore[no-untyped-def]
    """Write the matrix product A B into `out`, which must be neither of the two."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@njit_no_refcount
def multiply_transposed(a, b, out):  # type: ignore[no-untyped-def]
    """Write the matrix product A B^T into `out`, which must be neither of the two."""
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[j, k]
            out[i, j] = total


@njit_no_refcount
def congruence(a, p, out, scratch):  # type: ignore[no-untyped-def]
    """Write A P A^T into `out`, exactly symmetric, for a symmetric P, which may be `out`."""
    multiply(a, p, scratch)
    for i in range(a.shape[0]):
        for j in range(i + 1):
            total = 0.0
            for k in range(a.shape[1]):
                total += scratch[i, k] * a[j, k]
            out[i, j] = out[j, i] = total


@njit_no_refcount
def copy(a, out):  # type: ignore[no-untyped-def]
    """Copy the matrix A into `out`."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


@njit_no_refcount
def cholesky(m, size, lower):  # type: ignore[no-untyped-def]
    """Cholesky factor L of the first `size` rows and columns, m = L L^T; false if not definite."""
    for i in range(size):
        for j in range(i + 1):
            total = m[i, j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            if i == j:
                if not total > 0.0:
                    return False
                lower[i, i] = math.sqrt(total)
            else:
                lower[i, j] = total / lower[j, j]
    return True


@njit_no_refcount
def solve_factored(lower, size, x):  # type: ignore[no-untyped-def]
    """Solve m x = b in place for x, given the Cholesky factor of m."""
    for i in range(size):
        for k in range(i):
            x[i] -= lower[i, k] * x[k]
        x[i] /= lower[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            x[i] -= lower[k, i] * x[k]
        x[i] /= lower[i, i]
