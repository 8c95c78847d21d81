"""The sky as bits: whether a star stands near a direction, for the price of one look at memory.

The sphere is unfolded to a square by way of an octahedron, which takes one
division and no branch, and the square cut into cells.  A cell's bit is set where
a star lies within a radius of any of its points: a bit that is not set rules a
star out, one that is set only makes it possible.
"""

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from service.vectors import Vector

CELLS = 1248
"""Along an edge of the square: cells of 4.8 to 14 arcmin, 195 kB; a cache holds several."""
SAMPLE_RAD = 6e-4
"""Discs are filled by points so far apart, less than the narrowest cell is wide."""

Bits = npt.NDArray[np.uint8]


def build_sky_bitmap(direction: Vector, radius_rad: float) -> Bits:
    """The bits of unit vectors (n, 3), eight to a byte."""
    bits = np.zeros(CELLS * CELLS // 8, np.uint8)
    _fill(direction, radius_rad + SAMPLE_RAD, bits)
    return bits


@njit(cache=True, nogil=True, inline="always")
def cell_of(x, y, z):  # type: ignore[no-untyped-def]
    """The cell of a direction of any length."""
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


@njit(cache=True, nogil=True, inline="always")
def star_near(bits, level, x, y, z):  # type: ignore[no-untyped-def]
    """Whether a star may stand near a direction of any length, by one of several bitmaps."""
    cell = cell_of(x, y, z)
    return (bits[level, cell >> 3] >> (cell & 7)) & 1 != 0


@njit(cache=True, nogil=True)
def _fill(direction, radius, bits):  # type: ignore[no-untyped-def]
    steps = int(radius / SAMPLE_RAD) + 1
    for row in range(len(direction)):
        star = direction[row]
        # Two directions across the star's.
        least = 0
        for i in range(3):
            if abs(star[i]) < abs(star[least]):
                least = i
        axis = np.zeros(3)
        axis[least] = 1.0
        p = np.cross(star, axis)
        p /= math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
        q = np.cross(star, p)
        for i in range(-steps, steps + 1):
            for j in range(-steps, steps + 1):
                a, b = i * SAMPLE_RAD, j * SAMPLE_RAD
                if a * a + b * b > (radius + SAMPLE_RAD) ** 2:
                    continue
                cell = cell_of(
                    star[0] + a * p[0] + b * q[0],
                    star[1] + a * p[1] + b * q[1],
                    star[2] + a * p[2] + b * q[2],
                )
                bits[cell >> 3] |= np.uint8(1 << (cell & 7))
