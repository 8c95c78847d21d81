"""Spatial hashes of zone stars: the stars near a direction, and a test whether there are any.

**Buckets.** The sphere is projected on the six faces of a cube and each face is divided into square
cells, which are hashed into four times as many buckets as there are stars: most look-ups find an
empty bucket, whatever the shape of the zone. A star near an edge is on both faces, so that a
look-up needs only one face.

**Voxels.** Space is divided into cubes, which are hashed into bits, many more than stars. A cube's
bit is set if a star is within reach of any of its points: a cleared bit excludes a star, a set bit
does not prove one. A test needs no division, no branch and one memory access. Several levels have
wider cubes for a wider reach.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit, njit_inlined, njit_no_refcount
from service.vectors import Vector, locked, read_only

CELL = 0.004
"""Width of a hash cell in face coordinates, about 0.23 deg at the middle of a face."""
_PER_CELL = 1.0 / CELL
EDGE = 0.03
"""Distance in face coordinates beyond the edge of a face to which its stars extend."""
BUCKETS_PER_STAR = 4
_FACE, _U, _V = 83492791, 73856093, 19349663
"""Odd multipliers that hash neighbouring cells to different buckets."""
REACH_RAD = 4.5e-4 * 2.0 ** (0.5 * np.arange(7))
"""Distance from a star that its bits cover at each voxel level, as a chord in radians."""
_SCALE = 0.5 / REACH_RAD
"""Voxels per unit of chord at each level, so that the ball about a star meets about six."""
_BITS_PER_STAR = 128
_X, _Y, _Z = 73856093, 19349663, 83492791
"""Odd multipliers that hash neighbouring voxels to different bits."""
Bits = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class StarBuckets:
    """Hash of zone stars by cell: their rows and directions (k, 3), sorted by bucket.

    `start` has the first entry of each bucket and the end of the last; the number of buckets is a
    power of two.
    """

    start: npt.NDArray[np.int32]
    rows: npt.NDArray[np.int32]
    direction: Vector

    @property
    def nbytes(self) -> int:
        """The size of the buckets in memory, in bytes."""
        return self.start.nbytes + self.rows.nbytes + self.direction.nbytes


def build_star_buckets(direction: Vector) -> StarBuckets:
    """The hash buckets of unit vectors (n, 3)."""
    row_of, bucket_of = [], []
    buckets = 1 << max(4, math.ceil(math.log2(max(1, BUCKETS_PER_STAR * len(direction)))))
    for face in range(6):
        axis, sign = divmod(face, 2)
        depth = direction[:, axis] * (1.0 - 2.0 * sign)
        front = np.flatnonzero(depth > 0.1)
        u = direction[front, (axis + 1) % 3] / depth[front]
        v = direction[front, (axis + 2) % 3] / depth[front]
        on = (np.abs(u) <= 1.0 + EDGE) & (np.abs(v) <= 1.0 + EDGE)
        cell_u = np.floor(u[on] * _PER_CELL).astype(np.int64)
        cell_v = np.floor(v[on] * _PER_CELL).astype(np.int64)
        row_of.append(front[on])
        bucket_of.append((face * _FACE ^ cell_u * _U ^ cell_v * _V) & (buckets - 1))
    bucket = np.concatenate(bucket_of)
    # Stable, so that the stars of a bucket stay in order of brightness.
    order = np.argsort(bucket, kind="stable")
    rows = np.concatenate(row_of)[order]
    start = np.zeros(buckets + 1, np.int32)
    np.cumsum(np.bincount(bucket, minlength=buckets), out=start[1:])
    return StarBuckets(
        read_only(start),
        read_only(rows.astype(np.int32)),
        read_only(np.ascontiguousarray(direction[rows])),
    )


@njit_inlined
def cells_about(x, y, z, gate):  # type: ignore[no-untyped-def]
    """The cube face of a direction, and the block of hash cells that a gate in radians touches.

    Returns the face, the first and last cell along u, and the first and last along v.
    """
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, depth, p, q = 0 if x >= 0.0 else 1, ax, y, z
    elif ay >= az:
        face, depth, p, q = 2 if y >= 0.0 else 3, ay, z, x
    else:
        face, depth, p, q = 4 if z >= 0.0 else 5, az, x, y
    shallow = 1.0 / depth
    u, v = p * shallow, q * shallow
    # The projection stretches an angle by at most 1 + u^2 + v^2.
    reach = gate * (1.0 + u * u + v * v)
    return (
        face,
        math.floor((u - reach) * _PER_CELL),
        math.floor((u + reach) * _PER_CELL),
        math.floor((v - reach) * _PER_CELL),
        math.floor((v + reach) * _PER_CELL),
    )


@njit_inlined
def nearest(px, py, pz, gate, start, rows, direction, used, taken):  # type: ignore[no-untyped-def]
    """The two stars nearest to a direction within `gate` radians, -1 for none.

    `start`, `rows` and `direction` are those of `StarBuckets`. The first `taken` of the rows `used`
    are excluded.
    """
    face, first_u, last_u, first_v, last_v = cells_about(px, py, pz, gate)
    buckets = len(start) - 1
    one = other = -1
    best = second = 4.0 * math.sin(0.5 * gate) ** 2
    for u in range(first_u, last_u + 1):
        for v in range(first_v, last_v + 1):
            bucket = (face * _FACE ^ u * _U ^ v * _V) & (buckets - 1)
            for at in range(start[bucket], start[bucket + 1]):
                x = direction[at, 0] - px
                y = direction[at, 1] - py
                z = direction[at, 2] - pz
                chord2 = x * x + y * y + z * z
                row = rows[at]
                # Several cells in one bucket would give a star twice.
                if chord2 >= second or row == one:
                    continue
                free = True
                for k in range(taken):
                    if used[k] == row:
                        free = False
                if not free:
                    continue
                if chord2 < best:
                    second, other = best, one
                    best, one = chord2, row
                else:
                    second, other = chord2, row
    return one, other


def build_star_voxels(direction: Vector) -> Bits:
    """Bits (levels, bytes) of the voxels near unit vectors (n, 3), a power of two at each level."""
    size = 1 << max(7, (len(direction) * _BITS_PER_STAR // 8 - 1).bit_length())
    bits = np.zeros((len(REACH_RAD), size), np.uint8)
    for level in range(len(REACH_RAD)):
        _fill(locked(direction), REACH_RAD[level], _SCALE[level], bits[level])
    return read_only(bits)


@njit_no_refcount
def level_for(gate):  # type: ignore[no-untyped-def]
    """The finest voxel level whose reach covers a gate in radians; -1 if none does."""
    for level in range(len(REACH_RAD)):
        if gate <= REACH_RAD[level]:
            return level
    return -1


@njit(nogil=True, inline="always")
def star_within_reach(bits, level, x, y, z):  # type: ignore[no-untyped-def]
    """1 if a star may be within a level's reach of a point (at most 2 from the origin), else 0."""
    scale = _SCALE[level]
    # Offset by -2, so that truncation rounds down.
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
                    # With a small margin against rounding.
                    if square <= reach * reach * 1.0001:
                        hashed = (x * _X ^ y * _Y ^ z * _Z) & mask
                        bits[hashed >> 3] |= np.uint8(1 << (hashed & 7))


@njit(nogil=True)
def _outside(coordinate, cell, edge):  # type: ignore[no-untyped-def]
    """The distance of a coordinate outside of a cell; zero inside."""
    low = cell * edge - 2.0
    return max(low - coordinate, coordinate - low - edge, 0.0)
