"""Liebe's algorithm: a star is identified by two neighbours' distances and the angle between.

C. C. Liebe, "Pattern Recognition of Star Constellations for Spacecraft Applications", IEEE
Aerospace and Electronic Systems Magazine 7(6), 1992, 34-41.  Liebe kept 1,000 stars in 185,000
triangles, to allow for any missing star; here every star has the triangles with each two of its
four nearest, and the distance to the nearer one is looked up by k-vector.
"""

import math
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from service.compiled.jit import njit
from service.identify.triangles.triangle_match import MAX_MATCHES, SIGMAS
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.directions import separation_rad
from service.sky.geometry.kvector import KVector, build_kvector, rows_within
from service.sky.geometry.triangles import REACH_DEG, chords, nearest_slaves
from service.vectors import Vector, locked, read_only
from studies.ptp_2015.rivals.proposed import Proposed, Rows, proposed_by_votes
from studies.scenes import Scene

NEIGHBOURS = 4
_PAIRS = np.array(list(combinations(range(NEIGHBOURS), 2)))


@dataclass(frozen=True)
class Liebe:
    """Database of Liebe's algorithm: triangles sorted by the distance of the nearer neighbour.

    `star` (N, 3): master, nearer and farther neighbour; `feature` (N, 3): their
    distances from the master and the angle at it, in radians.
    """

    star: Rows
    feature: Vector
    nearer: KVector
    stars: int

    @property
    def entries(self) -> int:
        """Number of triangles in Liebe's database: six per star."""
        return len(self.star)

    @property
    def nbytes(self) -> int:
        """Size of triangles and k-vector in bytes."""
        return self.star.nbytes + self.feature.nbytes + self.nearer.nbytes

    def identify(self, scene: Scene) -> Proposed:
        """Name each observed star by the catalog star with the most votes of matching triangles."""
        image, feature = features(scene.direction)
        matched, guide = np.empty((2, MAX_MATCHES), np.int32)
        index = self.nearer
        count = _match(
            image,
            feature,
            locked(scene.sigma_rad),
            self.feature,
            index.value,
            index.below,
            index.slope,
            index.intercept,
            matched,
            guide,
        )
        triangles, found = image[matched[:count]], self.star[guide[:count]]
        return proposed_by_votes(triangles, found, self.stars, len(scene.direction), True)


def build_liebe(stars: RunCatalog) -> Liebe:
    """Build the database of Liebe's algorithm for a star list."""
    star, feature = features(stars.direction)
    order = np.argsort(feature[:, 0], kind="stable")
    star, feature = star[order], feature[order]
    # Single precision as in flight: a hundredth of an arcsecond.
    return Liebe(
        read_only(star),
        read_only(feature.astype(np.float32)),
        build_kvector(feature[:, 0]),
        len(stars),
    )


def features(direction: Vector) -> tuple[Rows, Vector]:
    """Triangles (t, 3) of every star with each two of its nearest, and their features (t, 3)."""
    near = np.empty((len(direction), NEIGHBOURS), np.int32)
    nearest_slaves(direction, *chords(REACH_DEG), near)
    star = np.empty((len(direction) * len(_PAIRS), 3), np.int32)
    feature = np.empty((len(star), 3))
    count = _measure(direction, near, _PAIRS, star, feature)
    return star[:count], feature[:count]


@njit(nogil=True)
def _measure(direction, near, pairs, star, feature):  # type: ignore[no-untyped-def]
    count = 0
    for master in range(len(direction)):
        m = direction[master]
        for at in range(len(pairs)):
            i, j = near[master, pairs[at, 0]], near[master, pairs[at, 1]]
            if i < 0 or j < 0:
                continue
            u, v = direction[i], direction[j]
            along_u = m[0] * u[0] + m[1] * u[1] + m[2] * u[2]
            along_v = m[0] * v[0] + m[1] * v[1] + m[2] * v[2]
            dot = uu = vv = 0.0
            for k in range(3):
                x, y = u[k] - along_u * m[k], v[k] - along_v * m[k]
                dot, uu, vv = dot + x * y, uu + x * x, vv + y * y
            star[count, 0], star[count, 1], star[count, 2] = master, i, j
            feature[count, 0] = separation_rad(m, u)
            feature[count, 1] = separation_rad(m, v)
            feature[count, 2] = math.acos(max(-1.0, min(1.0, dot / math.sqrt(uu * vv))))
            count += 1
    return count


@njit(nogil=True)
def _match(  # type: ignore[no-untyped-def]
    image, feature, sigma_rad, guide_feature, value, below, slope, intercept, matched, guide
):
    """Find pairs of observed and catalog triangles that agree in both distances and the angle."""
    count = 0
    for t in range(len(image)):
        near, far, angle = feature[t]
        sm, si, sj = sigma_rad[image[t, 0]], sigma_rad[image[t, 1]], sigma_rad[image[t, 2]]
        near_off = SIGMAS * math.sqrt(sm * sm + si * si)
        far_off = SIGMAS * math.sqrt(sm * sm + sj * sj)
        # The neighbours' noise across their arms, and the master's across both.
        lever = 1.0 / (near * near) + 1.0 / (far * far) - 2.0 * math.cos(angle) / (near * far)
        angle_off = SIGMAS * math.sqrt((si / near) ** 2 + (sj / far) ** 2 + sm * sm * lever)
        first, end = rows_within(value, below, slope, intercept, near - near_off, near + near_off)
        for row in range(first, end):
            if (
                abs(guide_feature[row, 1] - far) <= far_off
                and abs(guide_feature[row, 2] - angle) <= angle_off
            ):
                if count == len(matched):
                    return count
                matched[count], guide[count] = t, row
                count += 1
    return count
