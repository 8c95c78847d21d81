"""Zone stars in voxels: whether a star may stand near a point, for one look at memory.

Space is cut into cubes, which are hashed into bits, many more than there are
stars.  A cube's bit is set where a star lies within reach of any of its points:
a bit that is not set rules a star out, one that is set only makes it possible.
There is no division and no branch on the way to it.  There are several levels,
with wider cubes for a wider reach.
"""

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit, njit_no_refcount
from service.vectors import Vector, read_only

REACH_RAD = 4.5e-4 * 2.0 ** (0.5 * np.arange(7))
"""How near a star is that the bits of a level tell of: 93 to 743 arcsec, as a chord."""
_SCALE = 0.5 / REACH_RAD
"""Cubes to a radian: a star's ball meets about six of them."""
_BITS_PER_STAR = 128
_X, _Y, _Z = 73856093, 19349663, 83492791
"""Odd multipliers that scatter neighbouring cubes."""

Bits = npt.NDArray[np.uint8]


def build_star_voxels(direction: Vector) -> Bits:
    """The bits (levels, bytes) of unit vectors (n, 3), in each level a power of two of them."""
    size = 1 << max(7, (len(direction) * _BITS_PER_STAR // 8 - 1).bit_length())
    bits = np.zeros((len(REACH_RAD), size), np.uint8)
    for level in range(len(REACH_RAD)):
        _fill(direction, REACH_RAD[level], _SCALE[level], bits[level])
    return read_only(bits)


@njit_no_refcount
def level_for(gate):  # type: ignore[no-untyped-def]
    """The finest level that reaches as far as a gate in radians, -1 where none does."""
    for level in range(len(REACH_RAD)):
        if gate <= REACH_RAD[level]:
            return level
    return -1


@njit(nogil=True, inline="always")
def star_within_reach(bits, level, x, y, z):  # type: ignore[no-untyped-def]
    """1 where a star may lie within a level's reach of a point not farther off than 2, else 0."""
    scale = _SCALE[level]
    # Counted from -2, so that cutting off the fraction rounds down.
    hashed = (
        int((x + 2.0) * scale) * _X ^ int((y + 2.0) * scale) * _Y ^ int((z + 2.0) * scale) * _Z
    ) & (8 * bits.shape[1] - 1)
    return (bits[level, hashed >> 3] >> (hashed & 7)) & 1


@njit(nogil=True)
def _fill(direction, reach, scale, bits):  # type: ignore[no-untyped-def]
    mask = 8 * len(bits) - 1
    edge = 1.0 / scale
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    for row in range(len(direction)):
        star = direction[row]
        for i in range(3):
            first[i] = int((star[i] - reach + 2.0) * scale)
            last[i] = int((star[i] + reach + 2.0) * scale)
        for x in range(first[0], last[0] + 1):
            for y in range(first[1], last[1] + 1):
                for z in range(first[2], last[2] + 1):
                    square = (
                        _outside(star[0], x, edge) ** 2
                        + _outside(star[1], y, edge) ** 2
                        + _outside(star[2], z, edge) ** 2
                    )
                    # A little more, against rounding on either side.
                    if square <= reach * reach * 1.0001:
                        hashed = (x * _X ^ y * _Y ^ z * _Z) & mask
                        bits[hashed >> 3] |= np.uint8(1 << (hashed & 7))


@njit(nogil=True)
def _outside(coordinate, cell, edge):  # type: ignore[no-untyped-def]
    """How far a coordinate lies outside a cell, zero within it."""
    low = cell * edge - 2.0
    return max(low - coordinate, coordinate - low - edge, 0.0)
