"""Pyramid algorithm: a triangle matched by three separations, confirmed by a fourth star.

D. Mortari, M. A. Samaan, C. Bruccoleri & J. L. Junkins, "The Pyramid Star Identification
Technique", Navigation 51(3), 2004, 171-183.  Triangles are tried in an order that soon replaces
every star, so that a false point does not spoil many of them in a row.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from service.compiled.jit import njit
from service.identify.triangles.triangle_match import SIGMAS
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.directions import separation_rad
from service.sky.geometry.kvector import KVector, build_kvector, rows_within
from service.sky.geometry.pairs import build_pairs
from service.vectors import Vector, locked
from studies.ptp_2015.rivals.proposed import Proposed, Rows
from studies.scenes import Scene

SEPARATION_MAX_DEG = 14.2
"""Largest separation of indexed pairs in degrees, the diagonal of the field."""
MAX_TRIANGLES, MAX_CANDIDATES = 500, 2_000


class ObservedField(NamedTuple):
    """Observed stars (n): unit vectors, and noise in radians."""

    direction: Any
    sigma: Any


class GuidePairs(NamedTuple):
    """Catalog stars (m, 3) and their pairs sorted by separation, with a k-vector."""

    direction: Any
    brighter: Any
    dimmer: Any
    value: Any
    below: Any
    slope: Any
    intercept: Any


class Chains(NamedTuple):
    """Linked lists of catalog pairs by either star.

    From `head[a]` on, `link` leads through the pairs with star a, and `end` holds the other star of
    each.
    """

    head: Any
    link: Any
    end: Any


@dataclass(frozen=True)
class Pyramid:
    """Database of the pyramid algorithm: star pairs by separation in radians."""

    brighter: Rows
    dimmer: Rows
    separation: KVector
    direction: Vector

    @property
    def entries(self) -> int:
        """Number of pairs that fit into the field."""
        return len(self.brighter)

    @property
    def nbytes(self) -> int:
        """Size of pairs and k-vector in bytes."""
        return self.brighter.nbytes + self.dimmer.nbytes + self.separation.nbytes

    def identify(self, scene: Scene) -> Proposed:
        """Name the four stars of the first pyramid that fits at only one place of the sky."""
        image, star = np.empty((2, 4), np.int32)
        match = np.full(len(scene.direction), -1, np.int32)
        index = self.separation
        pairs = GuidePairs(
            *(self.direction, self.brighter, self.dimmer),
            *(index.value, index.below, index.slope, index.intercept),
        )
        field = ObservedField(locked(scene.direction), locked(scene.sigma_rad))
        if not _search(field, pairs, image, star):
            return Proposed(match, image[:0], star[:0])
        match[image] = star
        return Proposed(match, image, star)


def build_pyramid(stars: RunCatalog, separation_max_deg: float = SEPARATION_MAX_DEG) -> Pyramid:
    """Build the pair database of the pyramid algorithm for a star list."""
    pairs = build_pairs(stars.direction, separation_max_deg)
    kvector = build_kvector(pairs.separation_rad)
    return Pyramid(pairs.brighter, pairs.dimmer, kvector, stars.direction)


@njit(nogil=True)
def _pairs_like(field, i, j, pairs):  # type: ignore[no-untyped-def]
    """Range of the catalog pairs with the separation of observed stars i and j."""
    apart = separation_rad(field.direction[i], field.direction[j])
    tolerance = SIGMAS * math.sqrt(field.sigma[i] ** 2 + field.sigma[j] ** 2)
    return rows_within(
        *(pairs.value, pairs.below, pairs.slope, pairs.intercept),
        *(apart - tolerance, apart + tolerance),
    )


@njit(nogil=True)
def _chain(field, i, j, pairs, chains):  # type: ignore[no-untyped-def]
    """Link the catalog pairs with the separation of observed stars i and j, by either star."""
    head, link, end = chains
    first, last = _pairs_like(field, i, j, pairs)
    head[:] = -1
    for row in range(first, last):
        at = 2 * (row - first)
        if at + 1 >= len(link):
            break
        a, b = pairs.brighter[row], pairs.dimmer[row]
        end[at], link[at], head[a] = b, head[a], at
        end[at + 1], link[at + 1], head[b] = a, head[b], at + 1


@njit(nogil=True)
def _fits(field, i, j, a, b):  # type: ignore[no-untyped-def]
    """True if directions a and b have the separation of observed stars i and j."""
    off = separation_rad(field.direction[i], field.direction[j]) - separation_rad(a, b)
    return abs(off) <= SIGMAS * math.sqrt(field.sigma[i] ** 2 + field.sigma[j] ** 2)


@njit(nogil=True)
def _handed(a, b, c):  # type: ignore[no-untyped-def]
    """Triple product of three vectors; its sign distinguishes a triangle from its mirror image."""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


@njit(nogil=True)
def _search(field, pairs, image, star):  # type: ignore[no-untyped-def]
    """Search the first pyramid with a unique fit, into `image` and `star` (4,); True if found."""
    n = len(field.direction)
    capacity = 2 * len(pairs.brighter)
    chains = Chains(
        np.empty(len(pairs.direction), np.int32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.int32),
    )
    candidate = np.empty((MAX_CANDIDATES, 3), np.int32)
    tried = 0
    for dj in range(1, n - 1):
        for dk in range(1, n - dj):
            for i in range(n - dj - dk):
                j, k = i + dj, i + dj + dk
                if tried == MAX_TRIANGLES:
                    return False
                tried += 1
                count = _triangles(field, i, j, k, pairs, chains, candidate)
                if count == 0:
                    continue
                for r in range(n):
                    if r not in (i, j, k) and _confirmed(
                        field, (i, j, k, r), pairs, chains, candidate[:count], image, star
                    ):
                        return True
    return False


@njit(nogil=True)
def _confirmed(field, four, pairs, chains, candidate, image, star):  # type: ignore[no-untyped-def]
    """True if the fourth star confirms exactly one candidate, written to `image` and `star`."""
    i, j, k, r = four
    direction = pairs.direction
    _chain(field, i, r, pairs, chains)
    confirmed = 0
    for t in range(len(candidate)):
        a, b, c = candidate[t]
        at = chains.head[a]
        while at >= 0:
            d = chains.end[at]
            at = chains.link[at]
            if (
                d not in (b, c)
                and _fits(field, j, r, direction[b], direction[d])
                and _fits(field, k, r, direction[c], direction[d])
            ):
                confirmed += 1
                image[0], image[1], image[2], image[3] = i, j, k, r
                star[0], star[1], star[2], star[3] = a, b, c, d
    return confirmed == 1


@njit(nogil=True)
def _triangles(field, i, j, k, pairs, chains, candidate):  # type: ignore[no-untyped-def]
    """Find catalog triangles like stars i, j and k, with equal handedness; returns a count."""
    direction = pairs.direction
    first, last = _pairs_like(field, i, j, pairs)
    _chain(field, i, k, pairs, chains)
    hand = _handed(field.direction[i], field.direction[j], field.direction[k])
    count = 0
    for row in range(first, last):
        for swap in range(2):
            a, b = pairs.brighter[row], pairs.dimmer[row]
            if swap == 1:
                a, b = b, a
            at = chains.head[a]
            while at >= 0:
                c = chains.end[at]
                at = chains.link[at]
                if (
                    c != b
                    and _fits(field, j, k, direction[b], direction[c])
                    and hand * _handed(direction[a], direction[b], direction[c]) > 0.0
                    and count < len(candidate)
                ):
                    candidate[count, 0], candidate[count, 1], candidate[count, 2] = a, b, c
                    count += 1
    return count
