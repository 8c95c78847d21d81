"""The guide triangles of PTP: planar triangles of neighbouring stars, looked up by one number.

Every star is a master once; with two of its nearest neighbours, the slaves, it makes triangles
whose sides do not depend on the attitude. A principal component analysis of all sides gives the
axis of largest variance; a triangle is looked up by its projection on that axis.

F. Zhou & T. Ye, "Lost-in-Space Star Identification Using Planar Triangle
Principal Component Analysis Algorithm", Mathematical Problems in Engineering
2015, 982420: sections 2.1 and 2.2, equations 1 to 3.

The paper uses five triangles of four slaves without naming them. Here they are those with the
nearest or the second nearest slave: of the six choices, only this one reproduces the axis behind
the paper's Table 1.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit
from service.sky.geometry.kvector import KVector, build_kvector
from service.vectors import Matrix, Vector, locked, read_only

SIDE_SCALE = 1e4
"""Scale of triangle sides, which are chords of the unit sphere, as in the paper: 5 deg is 872.4."""
SLAVES = 4
LEAST_SEPARATION_DEG = 0.05
"""Least distance of a slave from its master in degrees, to exclude double stars."""
REACH_DEG = 5.0
"""Largest distance of a slave from its master in degrees: half the paper's field of view."""


Slaves = npt.NDArray[np.int32]


@dataclass(frozen=True)
class TriangleIndex:
    """Guide triangles sorted by their projection on the principal axis.

    `star` (N, 3) holds rows of the star list: master, the nearer slave, the farther one. `side` (N,
    3) are |master - nearer|, |master - farther| and |nearer - farther|, times SIDE_SCALE. The same
    three stars may occur up to three times, once for each of them as master, with different
    columns.
    """

    star: npt.NDArray[np.int32]
    side: npt.NDArray[np.float32]
    projection: KVector  # P
    axis: Vector  # w
    mean: Vector  # mu
    explained: Vector
    """Shares of the sides' variance along the three principal axes, largest first."""
    reach_deg: float
    slaves: int

    @property
    def count(self) -> int:
        """The number of guide triangles."""
        return len(self.star)

    @property
    def nbytes(self) -> int:
        """The size of the triangle index in memory in bytes, 36 per triangle."""
        return self.star.nbytes + self.side.nbytes + self.projection.nbytes


def build_triangles(
    direction: Vector, reach_deg: float = REACH_DEG, slaves: int = SLAVES
) -> TriangleIndex:
    """The guide triangles of stars, given as unit vectors (n, 3).

    Too few or too sparse stars give an empty index.
    """
    direction = np.ascontiguousarray(direction)
    near = np.empty((len(direction), slaves), np.int32)
    nearest_slaves(direction, *chords(reach_deg), near)
    return index_triangles(direction, near, reach_deg)


def index_triangles(direction: Vector, near: Slaves, reach_deg: float) -> TriangleIndex:
    """The index of guide triangles for chosen slaves: rows (n, slaves), -1 for none."""
    slaves = near.shape[1]
    star = np.empty((len(direction) * len(pairs_of_slaves(slaves)), 3), np.int32)
    side = np.empty((len(star), 3))
    count = make_triangles(direction, near, star, side)
    star, side = star[:count], side[:count]
    mean, axis, explained = principal_axis(side)
    value = project(side, axis, mean)
    order = np.argsort(value, kind="stable")
    return TriangleIndex(
        star=read_only(star[order]),
        side=read_only(side[order].astype(np.float32)),
        projection=build_kvector(value[order]),
        axis=read_only(axis),
        mean=read_only(mean),
        explained=read_only(explained),
        reach_deg=reach_deg,
        slaves=slaves,
    )


def chords(reach_deg: float) -> tuple[float, float]:
    """The least and largest chord from a master to a slave on the unit sphere."""
    least, most = np.radians([LEAST_SEPARATION_DEG, min(reach_deg, 180.0)]).tolist()
    return 2.0 * math.sin(0.5 * least), 2.0 * math.sin(0.5 * most)


def pairs_of_slaves(slaves: int) -> list[tuple[int, int]]:
    """Pairs of a master's slaves, numbered from the nearest, that make a triangle with it."""
    return [(i, j) for i in range(min(2, slaves)) for j in range(i + 1, slaves)]


def principal_axis(side: Matrix) -> tuple[Vector, Vector, Vector]:
    """The mean of triangle sides (N, 3), their principal axis, and each axis' share of variance.

    The axis is a unit vector whose components have a positive sum.
    """
    if len(side) < 2:
        return side.mean(axis=0) if len(side) else np.zeros(3), np.full(3, 3**-0.5), np.zeros(3)
    mean = side.mean(axis=0)
    centred = side - mean
    values, vectors = np.linalg.eigh(centred.T @ centred / (len(side) - 1))
    axis = vectors[:, 2] * (1.0 if vectors[:, 2].sum() > 0 else -1.0)
    total = float(values.sum())
    return mean, axis, values[::-1] / total if total > 0.0 else np.zeros(3)


def project(side: Matrix, axis: Vector, mean: Vector) -> Vector:
    """Projections of triangle sides (N, 3), less their mean, on the principal axis (equation 3)."""
    return np.asarray((side - mean) @ axis)


def nearest_slaves(direction: Vector, least: float, most: float, near: Slaves) -> None:
    """Fill `near` (n, slaves) with the rows of each star's nearest neighbours, -1 for none.

    `least` and `most` bound the chord. Of equally near stars the lower row comes first.
    """
    order = np.argsort(direction[:, 2], kind="stable")
    _choose_slaves(locked(direction), order, least, most, near)


@njit(nogil=True)
def _choose_slaves(direction, order, least, most, near):  # type: ignore[no-untyped-def]
    n, slaves = near.shape
    distance2 = np.empty(slaves)
    for at in range(n):
        master = order[at]
        near[master] = -1
        found = 0
        for step in (-1, 1):
            other_at = at + step
            while 0 <= other_at < n:
                other = order[other_at]
                dz = direction[other, 2] - direction[master, 2]
                if abs(dz) > most or (found == slaves and dz * dz > distance2[slaves - 1]):
                    break
                other_at += step
                dx = direction[other, 0] - direction[master, 0]
                dy = direction[other, 1] - direction[master, 1]
                chord2 = dx * dx + dy * dy + dz * dz
                if chord2 < least * least or chord2 > most * most:
                    continue
                place = found
                while place > 0 and (
                    distance2[place - 1] > chord2
                    or (distance2[place - 1] == chord2 and near[master, place - 1] > other)
                ):
                    place -= 1
                if place >= slaves:
                    continue
                found = min(found + 1, slaves)
                for k in range(found - 1, place, -1):
                    distance2[k] = distance2[k - 1]
                    near[master, k] = near[master, k - 1]
                distance2[place] = chord2
                near[master, place] = other


def make_triangles(direction: Vector, near: Slaves, star: Slaves, side: Matrix) -> int:
    """Fill `star` and `side`, both (N, 3), with every master's triangles; returns their number.

    Each contains the nearest or the second nearest slave: five triangles for four slaves.
    """
    return int(_fill_triangles(locked(direction), near, star, side))


@njit(nogil=True)
def _fill_triangles(direction, near, star, side):  # type: ignore[no-untyped-def]
    count = 0
    for master in range(len(near)):
        for a in range(min(2, near.shape[1])):
            for b in range(a + 1, near.shape[1]):
                i, j = near[master, a], near[master, b]
                if i < 0 or j < 0:
                    continue
                star[count, 0], star[count, 1], star[count, 2] = master, i, j
                side[count, 0] = chord(direction[master], direction[i])
                side[count, 1] = chord(direction[master], direction[j])
                side[count, 2] = chord(direction[i], direction[j])
                count += 1
    return count


@njit(nogil=True)
def chord(a, b):  # type: ignore[no-untyped-def]
    """The chord between two unit vectors times SIDE_SCALE; equations 1 and 2."""
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return SIDE_SCALE * math.sqrt(x * x + y * y + z * z)
