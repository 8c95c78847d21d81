"""Compiled functions of directions: the angle between two, and axes perpendicular to one."""

import math

from service.compiled.jit import njit, njit_no_refcount


@njit_no_refcount
def separation_rad(a, b):  # type: ignore[no-untyped-def]
    """The angle in radians between two unit vectors, accurate from zero to a half turn."""
    dx, dy, dz = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    half_chord = 0.5 * math.sqrt(dx * dx + dy * dy + dz * dz)
    if half_chord < 0.7:
        return 2.0 * math.asin(half_chord)
    sx, sy, sz = a[0] + b[0], a[1] + b[1], a[2] + b[2]
    return 2.0 * math.atan2(half_chord, 0.5 * math.sqrt(sx * sx + sy * sy + sz * sz))


@njit(nogil=True)
def separation_of(square):  # type: ignore[no-untyped-def]
    """The angle in radians for a squared chord, by a series if short, as exact as the arc sine."""
    quarter = 0.25 * square
    half = math.sqrt(quarter)
    if quarter < 0.0064:
        series = 1.0 / 6.0 + quarter * (
            3.0 / 40.0
            + quarter
            * (
                15.0 / 336.0
                + quarter * (105.0 / 3456.0 + quarter * (945.0 / 42240.0 + quarter * 0.01735276))
            )
        )
        return 2.0 * (half + half * quarter * series)
    return 2.0 * math.asin(min(1.0, half))


@njit_no_refcount
def axes_across(direction, u, v):  # type: ignore[no-untyped-def]
    """Write two directions into `u` and `v`, perpendicular to a direction and to each other.

    `numpy.cross` takes a second to compile, so this computes it by hand.
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
