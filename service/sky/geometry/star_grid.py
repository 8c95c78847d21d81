"""A spatial grid of zone stars, for finding the stars within a small angle of a direction.

The sphere is projected on the six faces of a cube, and each face is divided into square cells that
cover only its stars. A star near an edge is on both faces, so that a look-up needs only one face.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit
from service.vectors import Vector, read_only

CELL = 0.03
"""Width of a grid cell in face coordinates: about one star of a bright catalog for each cell.

Narrower cells hold fewer stars, but the look-up of a cell takes longer than its stars.
"""
EDGE = 0.03
"""Distance in face coordinates beyond the edge of a face to which its stars extend."""


@dataclass(frozen=True)
class StarGrid:
    """Grid of zone stars: their rows sorted by cell, and the start of each cell.

    `box` (6, 4) holds each face's first cell along u and v and the number of cells along either;
    `offset` (6,) is the index of its cells in `start`, which has the index of each cell's first
    star in `rows`.
    """

    box: npt.NDArray[np.int32]
    offset: npt.NDArray[np.int32]
    start: npt.NDArray[np.int32]
    rows: npt.NDArray[np.int32]

    @property
    def nbytes(self) -> int:
        """The size of the star grid in memory, in bytes."""
        return self.box.nbytes + self.offset.nbytes + self.start.nbytes + self.rows.nbytes


def build_star_grid(direction: Vector) -> StarGrid:
    """The star grid of unit vectors (n, 3)."""
    row_of, cell_u, cell_v = [], [], []
    for face in range(6):
        axis, sign = divmod(face, 2)
        depth = direction[:, axis] * (1.0 - 2.0 * sign)
        front = np.flatnonzero(depth > 0.1)
        u = direction[front, (axis + 1) % 3] / depth[front]
        v = direction[front, (axis + 2) % 3] / depth[front]
        on = (np.abs(u) <= 1.0 + EDGE) & (np.abs(v) <= 1.0 + EDGE)
        row_of.append(front[on])
        cell_u.append(np.floor(u[on] / CELL).astype(np.int64))
        cell_v.append(np.floor(v[on] / CELL).astype(np.int64))
    box, offset = np.zeros((6, 4), np.int32), np.zeros(6, np.int32)
    cells, total = [], 0
    for face in range(6):
        u, v = cell_u[face], cell_v[face]
        offset[face] = total
        if len(u):
            box[face] = u.min(), v.min(), np.ptp(u) + 1, np.ptp(v) + 1
        cells.append(total + (u - box[face, 0]) * box[face, 3] + (v - box[face, 1]))
        total += int(box[face, 2]) * int(box[face, 3])
    cell = np.concatenate(cells)
    # Stable, so that the stars of a cell stay in order of brightness.
    order = np.argsort(cell, kind="stable")
    start = np.searchsorted(cell[order], np.arange(total + 1))
    return StarGrid(
        read_only(box),
        read_only(offset),
        read_only(start.astype(np.int32)),
        read_only(np.concatenate(row_of)[order].astype(np.int32)),
    )


@njit(nogil=True)
def cells_about(p, gate, box, out):  # type: ignore[no-untyped-def]
    """The cube face of a direction, and the block of grid cells that a gate in radians touches.

    Into `out`: face, first and last cell along u, first and last along v; in an empty block last is
    before first.
    """
    axis = 0
    if abs(p[1]) > abs(p[axis]):
        axis = 1
    if abs(p[2]) > abs(p[axis]):
        axis = 2
    face = 2 * axis + (1 if p[axis] < 0.0 else 0)
    depth = abs(p[axis])
    u = p[(axis + 1) % 3] / depth
    v = p[(axis + 2) % 3] / depth
    # The projection stretches an angle by at most 1 + u^2 + v^2.
    reach = gate * (1.0 + u * u + v * v)
    out[0] = face
    out[1] = max(int(np.floor((u - reach) / CELL)), box[face, 0])
    out[2] = min(int(np.floor((u + reach) / CELL)), box[face, 0] + box[face, 2] - 1)
    out[3] = max(int(np.floor((v - reach) / CELL)), box[face, 1])
    out[4] = min(int(np.floor((v + reach) / CELL)), box[face, 1] + box[face, 3] - 1)
