"""The guide database for identification without a prior: all stars by position, and triangles."""

import math
from dataclasses import dataclass

import numpy as np

from service.compiled.jit import njit
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.star_hashes import StarBuckets, build_star_buckets
from service.sky.geometry.triangles import SLAVES, TriangleIndex, build_triangles
from service.vectors import Vector, read_only

CROWD_RAD = math.radians(1.0)
"""Radius in radians of the neighbourhood that measures a star's crowding."""


@dataclass(frozen=True)
class Guide:
    """The guide database of PTP: `direction` (n, 3) of a run catalog's stars in its own order.

    `density` (n,) is the number of stars per steradian at each star: the sky's mean, or more in a
    cluster.
    """

    direction: Vector
    density: Vector
    grid: StarBuckets
    triangles: TriangleIndex

    @property
    def nbytes(self) -> int:
        """The size of the guide database in memory beyond the run catalog, in bytes."""
        return self.density.nbytes + self.grid.nbytes + self.triangles.nbytes


@dataclass(frozen=True)
class GuideKey:
    """The inputs of a guide database: its key in the cache."""

    run_catalog: str
    reach_deg: float
    slaves: int


def build_guide(run_catalog: RunCatalog, reach_deg: float) -> Guide:
    """The guide database of a run catalog for fields of view of a given radius."""
    return Guide(
        run_catalog.direction,
        read_only(densities(run_catalog.direction)),
        build_star_buckets(run_catalog.direction),
        build_triangles(run_catalog.direction, reach_deg, SLAVES),
    )


def densities(direction: Vector) -> Vector:
    """Stars per steradian about each star (n, 3), without that star; at least the sky's mean."""
    crowd = np.zeros(len(direction), np.int64)
    order = np.argsort(direction[:, 2])
    _count_near(direction, order, 2.0 * math.sin(CROWD_RAD / 2.0), crowd)
    mean = len(direction) / (4.0 * math.pi)
    return np.maximum(mean, crowd / (2.0 * math.pi * (1.0 - math.cos(CROWD_RAD))))


@njit(nogil=True)
def _count_near(direction, order, most, count):  # type: ignore[no-untyped-def]
    """Add to `count` (n,) the number of other stars within a chord of each star."""
    for at in range(len(order)):
        one = order[at]
        for other_at in range(at + 1, len(order)):
            other = order[other_at]
            if direction[other, 2] - direction[one, 2] > most:
                break
            chord2 = 0.0
            for k in range(3):
                chord2 += (direction[other, k] - direction[one, k]) ** 2
            if chord2 <= most * most:
                count[one] += 1
                count[other] += 1
