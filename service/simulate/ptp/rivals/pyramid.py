"""The pyramid: a triangle found by its three separations, confirmed by a fourth star.

D. Mortari, M. A. Samaan, C. Bruccoleri & J. L. Junkins, "The Pyramid Star
Identification Technique", Navigation 51(3), 2004, 171-183.  Triangles are tried
in an order that exchanges every star soon, so that a point that is no star
does not spoil one after another.
"""

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from service.identify.triangle_match import SIGMAS
from service.simulate.ptp.rivals.proposed import Proposed, Rows
from service.simulate.scenes import Scene
from service.sky.kvector import KVector, build_kvector, rows_within
from service.sky.pairs import build_pairs, separation_rad
from service.sky.run_catalog import RunCatalog
from service.vectors import Vector

SEPARATION_MAX_DEG = 14.2
"""The diagonal of the field."""
MAX_TRIANGLES, MAX_CANDIDATES = 500, 2_000


@dataclass(frozen=True)
class Pyramid:
    """Pairs of stars by separation in radians."""

    brighter: Rows
    dimmer: Rows
    separation: KVector
    direction: Vector

    @property
    def entries(self) -> int:
        """Every pair that fits into the field."""
        return len(self.brighter)

    @property
    def nbytes(self) -> int:
        """Bytes of pairs and k-vector."""
        return self.brighter.nbytes + self.dimmer.nbytes + self.separation.nbytes

    def identify(self, scene: Scene) -> Proposed:
        """The four stars of the first pyramid that fits at one place of the sky alone."""
        image, star = np.empty((2, 4), np.int32)
        match = np.full(len(scene.direction), -1, np.int32)
        index = self.separation
        found = _search(
            scene.direction,
            scene.sigma_rad,
            self.direction,
            self.brighter,
            self.dimmer,
            index.value,
            index.below,
            index.slope,
            index.intercept,
            image,
            star,
        )
        if not found:
            return Proposed(match, image[:0], star[:0])
        match[image] = star
        return Proposed(match, image, star)


def build_pyramid(stars: RunCatalog, separation_max_deg: float = SEPARATION_MAX_DEG) -> Pyramid:
    """The pyramid's pairs of a star list."""
    pairs = build_pairs(stars.direction, separation_max_deg)
    kvector = build_kvector(pairs.separation_rad)
    return Pyramid(pairs.brighter, pairs.dimmer, kvector, stars.direction)


@njit(cache=True, nogil=True)
def _partners(  # type: ignore[no-untyped-def]
    observed, sigma, i, j, brighter, dimmer, value, below, slope, intercept, head, link, end
):
    """Chain the catalog pairs that are as far apart as stars i and j, by either star.

    From `head[a]` on, `link` leads through the pairs with star a, and `end`
    holds the other star of each.  Returns the range of pairs.
    """
    apart = separation_rad(observed[i], observed[j])
    tolerance = SIGMAS * math.sqrt(sigma[i] ** 2 + sigma[j] ** 2)
    first, last = rows_within(value, below, slope, intercept, apart - tolerance, apart + tolerance)
    head[:] = -1
    for row in range(first, last):
        at = 2 * (row - first)
        if at + 1 >= len(link):
            break
        a, b = brighter[row], dimmer[row]
        end[at], link[at], head[a] = b, head[a], at
        end[at + 1], link[at + 1], head[b] = a, head[b], at + 1
    return first, last


@njit(cache=True, nogil=True)
def _fits(observed, sigma, i, j, a, b):  # type: ignore[no-untyped-def]
    """Whether stars a and b are as far apart as observed i and j."""
    off = separation_rad(observed[i], observed[j]) - separation_rad(a, b)
    return abs(off) <= SIGMAS * math.sqrt(sigma[i] ** 2 + sigma[j] ** 2)


@njit(cache=True, nogil=True)
def _handed(a, b, c):  # type: ignore[no-untyped-def]
    """The triple product: its sign tells a triangle from its mirror image."""
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


@njit(cache=True, nogil=True)
def _search(  # type: ignore[no-untyped-def]
    observed, sigma, direction, brighter, dimmer, value, below, slope, intercept, image, star
):
    n = len(observed)
    head = np.empty(len(direction), np.int32)
    link, end = np.empty(2 * len(brighter), np.int32), np.empty(2 * len(brighter), np.int32)
    candidate = np.empty((MAX_CANDIDATES, 3), np.int32)
    tried = 0
    for dj in range(1, n - 1):
        for dk in range(1, n - dj):
            for i in range(n - dj - dk):
                j, k = i + dj, i + dj + dk
                if tried == MAX_TRIANGLES:
                    return False
                tried += 1
                count = _triangles(
                    observed, sigma, direction, i, j, k,
                    brighter, dimmer, value, below, slope, intercept, head, link, end, candidate,
                )  # fmt: skip
                if count == 0:
                    continue
                for r in range(n):
                    if r in (i, j, k):
                        continue
                    _partners(
                        observed, sigma, i, r,
                        brighter, dimmer, value, below, slope, intercept, head, link, end,
                    )  # fmt: skip
                    confirmed = 0
                    for t in range(count):
                        a, b, c = candidate[t]
                        at = head[a]
                        while at >= 0:
                            d = end[at]
                            at = link[at]
                            if (
                                d not in (b, c)
                                and _fits(observed, sigma, j, r, direction[b], direction[d])
                                and _fits(observed, sigma, k, r, direction[c], direction[d])
                            ):
                                confirmed += 1
                                image[0], image[1], image[2], image[3] = i, j, k, r
                                star[0], star[1], star[2], star[3] = a, b, c, d
                    if confirmed == 1:
                        return True
    return False


@njit(cache=True, nogil=True)
def _triangles(  # type: ignore[no-untyped-def]
    observed, sigma, direction, i, j, k,
    brighter, dimmer, value, below, slope, intercept, head, link, end, candidate,
):  # fmt: skip
    """Catalog triangles in the place of stars i, j and k, of the same hand; how many."""
    apart = separation_rad(observed[i], observed[j])
    tolerance = SIGMAS * math.sqrt(sigma[i] ** 2 + sigma[j] ** 2)
    first, last = rows_within(value, below, slope, intercept, apart - tolerance, apart + tolerance)
    _partners(
        observed, sigma, i, k, brighter, dimmer, value, below, slope, intercept, head, link, end
    )
    hand = _handed(observed[i], observed[j], observed[k])
    count = 0
    for row in range(first, last):
        for swap in range(2):
            a, b = brighter[row], dimmer[row]
            if swap == 1:
                a, b = b, a
            at = head[a]
            while at >= 0:
                c = end[at]
                at = link[at]
                if (
                    c != b
                    and _fits(observed, sigma, j, k, direction[b], direction[c])
                    and hand * _handed(direction[a], direction[b], direction[c]) > 0.0
                    and count < len(candidate)
                ):
                    candidate[count, 0], candidate[count, 1], candidate[count, 2] = a, b, c
                    count += 1
    return count
