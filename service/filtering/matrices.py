"""Products and Cholesky factors of small matrices, compiled; nothing is allocated."""

import math

from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def multiply(a, b, out):  # type: ignore[no-untyped-def]
    """A B into `out`, which is neither of them."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[k, j]
            out[i, j] = total


@njit_no_refcount
def multiply_transposed(a, b, out):  # type: ignore[no-untyped-def]
    """A B^T into `out`, which is neither of them."""
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[j, k]
            out[i, j] = total


@njit_no_refcount
def congruence(a, p, out, scratch):  # type: ignore[no-untyped-def]
    """A P A^T into `out`, exactly symmetric; P is symmetric and may be `out`."""
    multiply(a, p, scratch)
    for i in range(a.shape[0]):
        for j in range(i + 1):
            total = 0.0
            for k in range(a.shape[1]):
                total += scratch[i, k] * a[j, k]
            out[i, j] = out[j, i] = total


@njit_no_refcount
def copy(a, out):  # type: ignore[no-untyped-def]
    """A into `out`."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


@njit_no_refcount
def cholesky(m, size, lower):  # type: ignore[no-untyped-def]
    """The factor L of the first `size` rows and columns, m = L L^T; False where there is none."""
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
    """Replace x by m^-1 x, of the factor of m."""
    for i in range(size):
        for k in range(i):
            x[i] -= lower[i, k] * x[k]
        x[i] /= lower[i, i]
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            x[i] -= lower[k, i] * x[k]
        x[i] /= lower[i, i]
