"""Planar triangle algorithm: triangles matched by area and polar moment, selected by pivoting.

C. L. Cole & J. L. Crassidis, "Fast Star-Pattern Recognition Using Planar Triangles", Journal of
Guidance, Control, and Dynamics 29(1), 2006, 64-71.  Every triangle of the sky is in the database.
Many agree with an observed one in both numbers; candidates remain if they share two stars with a
candidate of the next triangle, until one is left.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit
from service.identify.triangles.triangle_match import SIGMAS, spread_along
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.geometry.kvector import KVector, build_kvector, rows_within
from service.sky.geometry.pairs import build_pairs
from service.vectors import Vector, locked, read_only
from studies.ptp_2015.rivals.proposed import Proposed
from studies.scenes import Scene

SIDE_MAX_DEG = 10.0
"""Longest side of a triangle in degrees, equal to the field of view."""
BRIGHTEST = 20
"""Number of brightest stars of a field that form triangles."""
MAX_BASES, MAX_PIVOTS = 30, 40
MAX_CANDIDATES = 100_000


@dataclass(frozen=True)
class PlanarTriangle:
    """Triangles sorted by area: star rows (N, 3), ascending, and polar moments (N,)."""

    star: npt.NDArray[np.uint16]
    moment: npt.NDArray[np.float32]
    area: KVector
    direction: Vector

    @property
    def entries(self) -> int:
        """Number of triangles in the database, all without a side longer than the field."""
        return len(self.star)

    @property
    def nbytes(self) -> int:
        """Size of triangles and k-vector in bytes."""
        return self.star.nbytes + self.moment.nbytes + self.area.nbytes

    def identify(self, scene: Scene) -> Proposed:
        """Name the three stars of the first triangle for which pivoting leaves one candidate."""
        n = len(scene.direction)
        image, star = np.empty((2, 3), np.int32)
        found = _pivot(
            locked(scene.direction[:BRIGHTEST]),
            locked(scene.sigma_rad[:BRIGHTEST]),
            self.direction,
            self.star,
            self.moment,
            self.area.value,
            self.area.below,
            self.area.slope,
            self.area.intercept,
            2.0 * math.sin(math.radians(SIDE_MAX_DEG) / 2.0),
            image,
            star,
        )
        match = np.full(n, -1, np.int32)
        if not found:
            return Proposed(match, image[:0], star[:0])
        match[image] = star
        return Proposed(match, image, star)


def build_planar_triangle(stars: RunCatalog, side_max_deg: float = SIDE_MAX_DEG) -> PlanarTriangle:
    """Build a database of all planar triangles of a star list; `ValueError` above 65,535 stars."""
    if len(stars) > np.iinfo(np.uint16).max:
        raise ValueError(f"{len(stars)} stars: at most 65535 can be numbered")
    pairs = build_pairs(stars.direction, side_max_deg)
    order = np.lexsort((pairs.dimmer, pairs.brighter))
    other = pairs.dimmer[order]
    first = np.searchsorted(pairs.brighter[order], np.arange(len(stars) + 1))
    most = 2.0 * math.sin(math.radians(side_max_deg) / 2.0)
    nothing = np.empty((0, 3), np.uint16)
    count = _all_triangles(stars.direction, other, first, most, nothing, np.empty((0, 2)))
    star, feature = np.empty((count, 3), np.uint16), np.empty((count, 2))
    _all_triangles(stars.direction, other, first, most, star, feature)
    by_area = np.argsort(feature[:, 0], kind="stable")
    return PlanarTriangle(
        read_only(star[by_area]),
        read_only(feature[by_area, 1].astype(np.float32)),
        build_kvector(feature[by_area, 0]),
        stars.direction,
    )


@njit(nogil=True)
def _chord(a, b):  # type: ignore[no-untyped-def]
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@njit(nogil=True)
def area_and_moment(a, b, c):  # type: ignore[no-untyped-def]
    """Area of a triangle from its sides (Heron), and polar moment A (a^2 + b^2 + c^2) / 36."""
    s = 0.5 * (a + b + c)
    area = math.sqrt(max(s * (s - a) * (s - b) * (s - c), 0.0))
    return area, area * (a * a + b * b + c * c) / 36.0


@njit(nogil=True)
def area_and_moment_sigma(u, v, w, su, sv, sw):  # type: ignore[no-untyped-def]
    """Standard deviations of area and polar moment of three observed stars, from gradients.

    dA/da = a (b^2 + c^2 - a^2) / 8A, dJ/da = (a^2 + b^2 + c^2) / 36 dA/da + A a / 18.
    """
    a, b, c = _chord(v, w), _chord(u, w), _chord(u, v)
    area, _ = area_and_moment(a, b, c)
    squares = a * a + b * b + c * c
    da = a * (b * b + c * c - a * a) / (8.0 * area)
    db = b * (a * a + c * c - b * b) / (8.0 * area)
    dc = c * (a * a + b * b - c * c) / (8.0 * area)
    ja = squares / 36.0 * da + area * a / 18.0
    jb = squares / 36.0 * db + area * b / 18.0
    jc = squares / 36.0 * dc + area * c / 18.0
    variance = np.zeros(2)
    for k, (ga, gb, gc) in enumerate(((da, db, dc), (ja, jb, jc))):
        hu, hv, hw = np.empty(3), np.empty(3), np.empty(3)
        for x in range(3):
            e_a, e_b, e_c = (v[x] - w[x]) / a, (u[x] - w[x]) / b, (u[x] - v[x]) / c
            hu[x] = gb * e_b + gc * e_c
            hv[x] = ga * e_a - gc * e_c
            hw[x] = -ga * e_a - gb * e_b
        variance[k] = (
            spread_along(hu[0], hu[1], hu[2], u, su)
            + spread_along(hv[0], hv[1], hv[2], v, sv)
            + spread_along(hw[0], hw[1], hw[2], w, sw)
        )
    return math.sqrt(variance[0]), math.sqrt(variance[1])


@njit(nogil=True)
def _all_triangles(direction, other, first, most, star, feature):  # type: ignore[no-untyped-def]
    """Write all triangles of mutual neighbours to `star` and `feature`; only count if empty."""
    count = 0
    for i in range(len(direction)):
        for x in range(first[i], first[i + 1]):
            j = other[x]
            for y in range(x + 1, first[i + 1]):
                k = other[y]
                a = _chord(direction[j], direction[k])
                if a > most:
                    continue
                if len(star):
                    b, c = _chord(direction[i], direction[k]), _chord(direction[i], direction[j])
                    star[count, 0], star[count, 1], star[count, 2] = i, j, k
                    feature[count, 0], feature[count, 1] = area_and_moment(a, b, c)
                count += 1
    return count


@njit(nogil=True)
def _candidates(  # type: ignore[no-untyped-def]
    u, v, w, su, sv, sw, moment, value, below, slope, intercept, out
):
    """Write rows of catalog triangles with equal area and moment; their number, -1: too many."""
    area, polar = area_and_moment(_chord(v, w), _chord(u, w), _chord(u, v))
    if not area > 0.0:
        return 0
    area_sigma, polar_sigma = area_and_moment_sigma(u, v, w, su, sv, sw)
    low, high = area - SIGMAS * area_sigma, area + SIGMAS * area_sigma
    first, end = rows_within(value, below, slope, intercept, low, high)
    count = 0
    for row in range(first, end):
        if abs(moment[row] - polar) <= SIGMAS * polar_sigma:
            if count == len(out):
                return -1
            out[count] = row
            count += 1
    return count


@njit(nogil=True)
def _pivot(  # type: ignore[no-untyped-def]
    observed, sigma, direction, star, moment, value, below, slope, intercept, most, image, out
):
    """Search the first triangle of a field reduced to one candidate by pivoting; True if found."""
    n = len(observed)
    kept, others = np.empty(MAX_CANDIDATES, np.int32), np.empty(MAX_CANDIDATES, np.int32)
    bases = 0
    for k in range(2, n):
        for j in range(1, k):
            for i in range(j):
                u, v, w = observed[i], observed[j], observed[k]
                if max(_chord(u, v), _chord(u, w), _chord(v, w)) > most:
                    continue
                if bases == MAX_BASES:
                    return False
                bases += 1
                count = _candidates(
                    u, v, w, sigma[i], sigma[j], sigma[k],
                    moment, value, below, slope, intercept, kept,
                )  # fmt: skip
                pivots = 0
                for other in range(n):
                    if other in (i, j, k):
                        continue
                    for x, y in ((i, j), (i, k), (j, k)):
                        if count <= 0 or pivots >= MAX_PIVOTS or (count == 1 and pivots > 1):
                            continue
                        p, q, r = observed[x], observed[y], observed[other]
                        if max(_chord(p, r), _chord(q, r)) > most:
                            continue
                        found = _candidates(
                            p, q, r, sigma[x], sigma[y], sigma[other],
                            moment, value, below, slope, intercept, others,
                        )  # fmt: skip
                        if found >= 0:
                            count = _sharing_two(star, kept, count, others, found)
                            pivots += 1
                if count == 1 and pivots > 1:
                    image[0], image[1], image[2] = i, j, k
                    if _corners(observed, sigma, direction, star[kept[0]], image, out):
                        return True
    return False


@njit(nogil=True)
def _sharing_two(star, kept, count, others, found):  # type: ignore[no-untyped-def]
    """Keep candidates that share two stars with one of another triangle; returns their number."""
    edge = np.empty(3 * found, np.int64)
    for at in range(found):
        a, b, c = star[others[at]]
        edge[3 * at] = (np.int64(a) << 16) | b
        edge[3 * at + 1] = (np.int64(a) << 16) | c
        edge[3 * at + 2] = (np.int64(b) << 16) | c
    edge.sort()
    left = 0
    for at in range(count):
        a, b, c = star[kept[at]]
        shares = False
        for x, y in ((a, b), (a, c), (b, c)):
            key = (np.int64(x) << 16) | y
            place = np.searchsorted(edge, key)
            if place < len(edge) and edge[place] == key:
                shares = True
        if shares:
            kept[left] = kept[at]
            left += 1
    return left


@njit(nogil=True)
def _corners(observed, sigma, direction, stars, image, out):  # type: ignore[no-untyped-def]
    """Assign catalog stars to the corners of a triangle by its sides; True if the sides agree."""
    best = math.inf
    for a, b, c in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        order = (stars[a], stars[b], stars[c])
        worst = 0.0
        for x, y in ((0, 1), (0, 2), (1, 2)):
            should = _chord(direction[order[x]], direction[order[y]])
            apart = _chord(observed[image[x]], observed[image[y]])
            spread = math.sqrt(sigma[image[x]] ** 2 + sigma[image[y]] ** 2)
            worst = max(worst, abs(apart - should) / spread)
        if worst < best:
            best = worst
            out[0], out[1], out[2] = order
    return best <= SIGMAS
