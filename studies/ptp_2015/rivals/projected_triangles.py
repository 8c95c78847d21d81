"""Algorithms that match triangles by their projection: PTP and the earlier P-vector.

PTP uses the service's own triangles, with its sharing stars as the answer.

The P-vector has one triangle per star, with its two brightest neighbours, matched by one number.
Yang Jian, Zhang Guangjun & Jiang Jie, "Fast Star Identification Algorithm Using P Vector", Acta
Aeronautica et Astronautica Sinica 28(4), 2007, 897-900; as described by Zhou & Ye.  The projection
is that of PTP.  Its weakness is the choice of the triangle: a neighbour lost or added by noise of
magnitude changes the triangle, and so does a neighbour outside of the field.
"""

from dataclasses import dataclass

import numpy as np

from service.compiled.jit import njit
from service.identify.triangles.ptp import propose
from service.identify.triangles.triangle_match import (
    MAX_MATCHES,
    ImageTriangles,
    guide_triangles,
    match_triangles,
)
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.triangles import (
    REACH_DEG,
    SLAVES,
    TriangleIndex,
    build_triangles,
    chords,
    index_triangles,
    make_triangles,
)
from service.vectors import locked
from studies.ptp_2015.rivals.proposed import Proposed, proposed_by_votes
from studies.scenes import Scene

NEIGHBOURS_WITHIN_DEG = 5.0
BRIGHTEST = 2


@dataclass(frozen=True)
class PVector:
    """Database of the P-vector: one triangle per star; only unique matches are accepted."""

    triangles: TriangleIndex
    stars: int

    @property
    def entries(self) -> int:
        """Number of catalog triangles: one for each star that has two neighbours."""
        return self.triangles.count

    @property
    def nbytes(self) -> int:
        """Size of triangles and k-vector in bytes."""
        return self.triangles.nbytes

    def identify(self, scene: Scene) -> Proposed:
        """Name stars by triangles with a unique match; of several names, take the most votes."""
        n = len(scene.direction)
        near = np.empty((n, BRIGHTEST), np.int32)
        # Scenes are in order of measured brightness, as the catalog is of true brightness.
        brightest_near(scene.direction, *chords(self.triangles.reach_deg), near)
        image, side = np.empty((n, 3), np.int32), np.empty((n, 3))
        count = make_triangles(scene.direction, near, image, side)
        matched, guide = np.empty((2, MAX_MATCHES), np.int32)
        direction, sigma_rad = locked(scene.direction), locked(scene.sigma_rad)
        field = ImageTriangles(direction, sigma_rad, 0.0, image[:count], side[:count])
        found, _, _ = match_triangles(field, guide_triangles(self.triangles), matched, guide)
        matched, guide = matched[:found], guide[:found]
        every = proposed_by_votes(image[matched], self.triangles.star[guide], self.stars, n, False)
        alone = np.bincount(matched, minlength=n)[matched] == 1
        believed = proposed_by_votes(
            image[matched[alone]], self.triangles.star[guide[alone]], self.stars, n, False
        )
        return Proposed(believed.match, every.image, every.star)


def build_p_vector(stars: RunCatalog, within_deg: float = NEIGHBOURS_WITHIN_DEG) -> PVector:
    """Build the P-vector's database for a star list in order of brightness."""
    near = np.empty((len(stars), BRIGHTEST), np.int32)
    brightest_near(stars.direction, *chords(within_deg), near)
    return PVector(index_triangles(stars.direction, near, within_deg), len(stars))


@njit(nogil=True)
def brightest_near(direction, least, most, near):  # type: ignore[no-untyped-def]
    """Write to `near` (n, k) the brightest stars at a range of chords from each star, -1: none."""
    n, wanted = near.shape
    near[:] = -1
    for master in range(n):
        found = 0
        for other in range(n):
            chord2 = 0.0
            for k in range(3):
                chord2 += (direction[other, k] - direction[master, k]) ** 2
            if least * least <= chord2 <= most * most:
                near[master, found] = other
                found += 1
                if found == wanted:
                    break


@dataclass(frozen=True)
class Ptp:
    """Database of PTP: guide triangles of all stars."""

    triangles: TriangleIndex
    stars: int

    @property
    def entries(self) -> int:
        """Number of triangles: five per star with four slave stars."""
        return self.triangles.count

    @property
    def nbytes(self) -> int:
        """Size of triangles and k-vector in bytes."""
        return self.triangles.nbytes

    def identify(self, scene: Scene) -> Proposed:
        """Identify stars by triangles that share stars, without a check of the attitude."""
        proposals = propose(scene.direction, scene.sigma_rad, 0.0, self.triangles, self.stars)
        match = proposals.validated(len(scene.direction))
        return Proposed(match, proposals.image, proposals.star)


def build_ptp(stars: RunCatalog, slaves: int = SLAVES) -> Ptp:
    """Build the guide triangles of a star list, with a number of slave stars per master."""
    return Ptp(build_triangles(stars.direction, REACH_DEG, slaves), len(stars))
