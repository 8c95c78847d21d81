"""Axes across a direction, compiled."""

import math

from service.compiled.jit import njit_no_refcount


@njit_no_refcount
def axes_across(direction, u, v):  # type: ignore[no-untyped-def]
    """Write two directions into `u` and `v` that are at right angles to one and to each other.

    `numpy.cross` takes a second to compile.
    """
    least = 0
    for i in range(3):
        if abs(direction[i]) < abs(direction[least]):
            least = i
    v[0] = v[1] = v[2] = 0.0
    v[least] = 1.0
    _cross(direction, v, u)
    norm = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
    for i in range(3):
        u[i] /= norm
    _cross(direction, u, v)


@njit_no_refcount
def _cross(a, b, product):  # type: ignore[no-untyped-def]
    product[0] = a[1] * b[2] - a[2] * b[1]
    product[1] = a[2] * b[0] - a[0] * b[2]
    product[2] = a[0] * b[1] - a[1] * b[0]
