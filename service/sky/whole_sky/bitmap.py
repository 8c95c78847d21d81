"""A bitmap of the sky: a test for stars near a direction with one memory access.

The sphere is unfolded to a square by way of an octahedron, which takes one division and no branch,
and the square is divided into cells. A cell's bit is set if a star lies within a radius of any of
its points: a cleared bit excludes a star, a set bit does not prove one.
"""

import math

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit
from service.sky.geometry.directions import axes_across
from service.vectors import Vector, locked

CELLS = 1632
"""Cells along an edge of the square on which the whole sky is unfolded, 3.7 to 11 arcmin wide.

A bitmap takes 333 kB: several fit into a cache.
"""
SAMPLE_RAD = 6e-4
"""Spacing of the points that fill a disc, less than the narrowest cell."""
RIM_RAD, RIM_SAMPLE_RAD = 1.5e-4, 1e-4
"""Distance of a disc's rim beyond it, and the spacing of the rim's points, in radians.

A cell whose corner barely reaches into the disc contains more of the rim than that, since no corner
is sharper than 45 deg; the margin of 6 arcsec is for directions in single precision.
"""

Bits = npt.NDArray[np.uint8]


def build_sky_bitmap(direction: Vector, radius_rad: float) -> Bits:
    """The bitmap of sky cells within a radius of unit vectors (n, 3), eight bits to a byte."""
    bits = np.zeros(CELLS * CELLS // 8, np.uint8)
    _fill(locked(direction), _disc(radius_rad), bits)
    return bits


@njit(nogil=True, inline="always")
def cell_of(x, y, z):  # type: ignore[no-untyped-def]
    """The number of the bitmap cell of a direction of any length."""
    scale = 1.0 / (abs(x) + abs(y) + abs(z))
    u, v = x * scale, y * scale
    # The lower half is folded outwards over the edges of the upper.
    fold_u = math.copysign(1.0 - abs(v), u)
    fold_v = math.copysign(1.0 - abs(u), v)
    u = fold_u if z < 0.0 else u
    v = fold_v if z < 0.0 else v
    cu = min(int((u + 1.0) * (0.5 * CELLS)), CELLS - 1)
    cv = min(int((v + 1.0) * (0.5 * CELLS)), CELLS - 1)
    return cu * CELLS + cv


@njit(inline="always")
def _single_cell(x, y, z):  # type: ignore[no-untyped-def]
    """The number of the bitmap cell of a direction, in single precision and vectorisable."""
    one, half, last = np.float32(1.0), np.float32(0.5 * CELLS), np.int32(CELLS - 1)
    scale = one / (abs(x) + abs(y) + abs(z))
    u, v = x * scale, y * scale
    fold_u, fold_v = one - abs(v), one - abs(u)
    fold_u = -fold_u if u < 0 else fold_u
    fold_v = -fold_v if v < 0 else fold_v
    u = fold_u if z < 0 else u
    v = fold_v if z < 0 else v
    cu = min(max(np.int32((u + one) * half), np.int32(0)), last)
    cv = min(max(np.int32((v + one) * half), np.int32(0)), last)
    return cu * np.int32(CELLS) + cv


@njit(nogil=True, error_model="numpy", forceinline=True)
def cells_of_pairs(count, alpha, beta, gamma, pair, cell):  # type: ignore[no-untyped-def]
    """Write the cells (2, count) of one point's predicted places for star pairs in both orders.

    `pair` (6, m) holds the two directions of every pair, component by component; the coefficients
    belong to the two directions and their cross product. All are in single precision, which the
    bitmaps allow for.
    """
    for q in range(count):
        x0, x1, x2 = pair[0, q], pair[1, q], pair[2, q]
        y0, y1, y2 = pair[3, q], pair[4, q], pair[5, q]
        z0 = gamma * (x1 * y2 - x2 * y1)
        z1 = gamma * (x2 * y0 - x0 * y2)
        z2 = gamma * (x0 * y1 - x1 * y0)
        cell[0, q] = _single_cell(
            alpha * x0 + beta * y0 + z0, alpha * x1 + beta * y1 + z1, alpha * x2 + beta * y2 + z2
        )
        cell[1, q] = _single_cell(
            alpha * y0 + beta * x0 - z0, alpha * y1 + beta * x1 - z1, alpha * y2 + beta * x2 - z2
        )


@njit(nogil=True, error_model="numpy", forceinline=True)
def cells_of_points(count, coefficients, x, y, cell):  # type: ignore[no-untyped-def]
    """Write the cells (count,) of many points' predicted places for one pair of stars."""
    x0, x1, x2, y0, y1, y2 = x[0], x[1], x[2], y[0], y[1], y[2]
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    alpha, beta, gamma = coefficients[0], coefficients[1], coefficients[2]
    for s in range(count):
        cell[s] = _single_cell(
            alpha[s] * x0 + beta[s] * y0 + gamma[s] * z0,
            alpha[s] * x1 + beta[s] * y1 + gamma[s] * z1,
            alpha[s] * x2 + beta[s] * y2 + gamma[s] * z2,
        )


def _disc(radius_rad: float) -> Vector:
    """Points (k, 2) of a disc and its rim, dense enough to hit every cell that the disc touches."""
    steps = np.arange(-int(radius_rad / SAMPLE_RAD), int(radius_rad / SAMPLE_RAD) + 1) * SAMPLE_RAD
    inner = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    rim_rad = radius_rad + RIM_RAD
    turn = np.linspace(0.0, 2.0 * math.pi, int(2.0 * math.pi * rim_rad / RIM_SAMPLE_RAD) + 2)[1:]
    rim = rim_rad * np.column_stack([np.cos(turn), np.sin(turn)])
    return np.concatenate([inner[np.hypot(*inner.T) <= radius_rad], rim])


@njit(nogil=True, error_model="numpy")
def _fill(direction, disc, bits):  # type: ignore[no-untyped-def]
    p, q = np.empty(3), np.empty(3)
    for row in range(len(direction)):
        star = direction[row]
        axes_across(star, p, q)
        for at in range(len(disc)):
            a, b = disc[at, 0], disc[at, 1]
            cell = cell_of(
                star[0] + a * p[0] + b * q[0],
                star[1] + a * p[1] + b * q[1],
                star[2] + a * p[2] + b * q[2],
            )
            bits[cell >> 3] |= np.uint8(1 << (cell & 7))
