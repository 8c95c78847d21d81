"""Zone stars by place: which stars lie within a small angle of a direction.

The sphere is projected on the six faces of a cube and each face cut into square
cells, which are hashed into four times as many buckets as there are stars: a
look-up mostly finds an empty bucket, whatever the shape of the zone.  A star
near an edge stands on both faces, so that a look-up never leaves its own.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit_no_refcount
from service.vectors import Vector, read_only

CELL = 0.004
"""Width of a cell, about 0.23 deg at the middle of a face."""
_PER_CELL = 1.0 / CELL
EDGE = 0.03
"""How far, in face coordinates, a star may stand over the edge of a face and still be on it."""
BUCKETS_PER_STAR = 4
_FACE, _U, _V = 83492791, 73856093, 19349663
"""Odd multipliers that scatter neighbouring cells."""


@dataclass(frozen=True)
class StarBuckets:
    """Rows of zone stars and their directions (k, 3), bucket by bucket.

    `start` tells where those of a bucket begin; its length less one, the number
    of buckets, is a power of two.
    """

    start: npt.NDArray[np.int32]
    rows: npt.NDArray[np.int32]
    direction: Vector

    @property
    def nbytes(self) -> int:
        """Bytes held."""
        return self.start.nbytes + self.rows.nbytes + self.direction.nbytes


def build_star_buckets(direction: Vector) -> StarBuckets:
    """Sort unit vectors (n, 3) into buckets."""
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


@njit_no_refcount
def cells_about(x, y, z, gate):  # type: ignore[no-untyped-def]
    """The face of a direction and the block of cells within `gate` radians of it.

    Returns the face, the first and last cell along u, the first and last along v.
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


@njit_no_refcount
def nearest(px, py, pz, gate, start, rows, direction, used, taken):  # type: ignore[no-untyped-def]
    """The two stars nearest to a direction within `gate` radians, -1 where there is none.

    `start`, `rows` and `direction` are the grid's.  The first `taken` of the
    rows `used` are left out.
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
                # Cells of one bucket would bring a star twice.
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
