"""Matching of observed triangles to guide triangles, and votes for star identities (PTP).

The position errors of an observed triangle's stars give the error of its projection, which sets the
range of guide triangles to compare, and the error of each side, which selects among them (section
2.2).

A star must then have the same identity in two triangles: the sharing-star validation (section 2.3).
A false match names three stars at random; two false matches seldom agree on the identity of a star.
A star with one identity in two triangles validates itself and every triangle that contains it.
Distinct triangles of the image are counted: a triangle seen from two of its corners counts once.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit
from service.sky.geometry.kvector import rows_within
from service.sky.geometry.triangles import SIDE_SCALE, TriangleIndex, chord

SIGMAS = 3.0
"""Largest error of a true triangle, in its own standard deviations: 99.7 % are within."""
MAX_MATCHES = 20_000
"""Largest number of triangle matches kept for one sighting; a real field gives tens."""
Rows = npt.NDArray[np.int32]
Held = npt.NDArray[np.bool_]
LEAST_TRIANGLES = 2
"""Least number of matched triangles in which a sharing star must have the same identity."""


@njit(nogil=True)
def spread_along(h0, h1, h2, b, sigma):  # type: ignore[no-untyped-def]
    """The variance along a gradient h of a unit vector b with isotropic noise in its tangent plane.

    It is h R h^T with R = sigma^2 (I - b b^T), the tangent-plane model of equation 12.
    """
    along = h0 * b[0] + h1 * b[1] + h2 * b[2]
    return sigma * sigma * (h0 * h0 + h1 * h1 + h2 * h2 - along * along)


@njit(nogil=True)
def side_sigma(a, b, sigma_a, sigma_b):  # type: ignore[no-untyped-def]
    """The standard deviation of the scaled chord between two observed stars."""
    length = chord(a, b) / SIDE_SCALE
    x, y, z = (a[0] - b[0]) / length, (a[1] - b[1]) / length, (a[2] - b[2]) / length
    return SIDE_SCALE * math.sqrt(
        spread_along(x, y, z, a, sigma_a) + spread_along(x, y, z, b, sigma_b)
    )


@njit(nogil=True)
def projection_sigma(m, i, j, axis, sigma_m, sigma_i, sigma_j):  # type: ignore[no-untyped-def]
    """sigma_P, the standard deviation of an observed triangle's projection; equations 6 to 14.

    `m`, `i` and `j` are the unit vectors of the master and its two slaves,
    `axis` the principal axis w.
    """
    ab, ac, bc = chord(m, i) / SIDE_SCALE, chord(m, j) / SIDE_SCALE, chord(i, j) / SIDE_SCALE
    h_m, h_i, h_j = np.empty(3), np.empty(3), np.empty(3)
    for k in range(3):
        e_ab, e_ac, e_bc = (m[k] - i[k]) / ab, (m[k] - j[k]) / ac, (i[k] - j[k]) / bc
        h_m[k] = axis[0] * e_ab + axis[1] * e_ac
        h_i[k] = -axis[0] * e_ab + axis[2] * e_bc
        h_j[k] = -axis[1] * e_ac - axis[2] * e_bc
    return SIDE_SCALE * math.sqrt(
        spread_along(h_m[0], h_m[1], h_m[2], m, sigma_m)
        + spread_along(h_i[0], h_i[1], h_i[2], i, sigma_i)
        + spread_along(h_j[0], h_j[1], h_j[2], j, sigma_j)
    )


class ImageTriangles(NamedTuple):
    """The triangles (t) of n observed stars, with the stars, in the form that kernels take.

    `direction` (n, 3) are unit vectors in any axes, `sigma_rad` (n,) their noise. `speed_c` is the
    observer's speed: the largest relative change of a side by aberration. `star` (t, 3) are rows of
    `direction`: master, nearer slave, farther slave; `side` (t, 3) as in `TriangleIndex`.
    """

    direction: Any
    sigma_rad: Any
    speed_c: Any
    star: Any
    side: Any


class GuideTriangles(NamedTuple):
    """The guide triangles of an index for kernels: sides, projection, principal axis and mean."""

    side: Any
    value: Any
    below: Any
    slope: Any
    intercept: Any
    axis: Any
    mean: Any


def guide_triangles(index: TriangleIndex) -> GuideTriangles:
    """The guide triangles of an index, converted for kernels."""
    projection = index.projection
    return GuideTriangles(
        side=index.side,
        value=projection.value,
        below=projection.below,
        slope=projection.slope,
        intercept=projection.intercept,
        axis=index.axis,
        mean=index.mean,
    )


@njit(nogil=True)
def match_triangles(image, guide, matched_image, matched_guide):  # type: ignore[no-untyped-def]
    """Find every pair of an observed and a guide triangle that agree in all three sides.

    Their rows go to `matched_image` and `matched_guide`. Returns the number of matches, the number
    of guide triangles compared, and true if more matched than can be kept.
    """
    count = searched = 0
    tolerance = np.empty(3)
    direction, speed_c, axis = image.direction, image.speed_c, guide.axis
    for t in range(len(image.star)):
        one, two, three = image.star[t, 0], image.star[t, 1], image.star[t, 2]
        m, i, j = direction[one], direction[two], direction[three]
        sm, si, sj = image.sigma_rad[one], image.sigma_rad[two], image.sigma_rad[three]
        side = image.side[t]
        if not (side[0] > 0.0 and side[1] > 0.0 and side[2] > 0.0):
            continue
        projection = 0.0
        shift = 0.0
        for k in range(3):
            projection += axis[k] * (side[k] - guide.mean[k])
            shift += abs(axis[k]) * side[k] * speed_c
        reach = SIGMAS * projection_sigma(m, i, j, axis, sm, si, sj) + shift
        tolerance[0] = SIGMAS * side_sigma(m, i, sm, si) + speed_c * side[0]
        tolerance[1] = SIGMAS * side_sigma(m, j, sm, sj) + speed_c * side[1]
        tolerance[2] = SIGMAS * side_sigma(i, j, si, sj) + speed_c * side[2]
        first, end = rows_within(
            *(guide.value, guide.below, guide.slope, guide.intercept),
            *(projection - reach, projection + reach),
        )
        searched += end - first
        for row in range(first, end):
            if (
                abs(guide.side[row, 0] - side[0]) <= tolerance[0]
                and abs(guide.side[row, 1] - side[1]) <= tolerance[1]
                and abs(guide.side[row, 2] - side[2]) <= tolerance[2]
            ):
                if count == len(matched_guide):
                    return count, searched, True
                matched_image[count], matched_guide[count] = t, row
                count += 1
    return count, searched, False


def count_pairs(
    image: Rows, star: Rows, stars: int, pair_image: Rows, pair_star: Rows, votes: Rows, held: Held
) -> int:
    """Count votes for (observed star, catalog star) pairs over triangle matches, most votes first.

    `image` and `star` (m, 3) hold the three observed rows and the three catalog rows of each match,
    in corresponding order; `stars` is the number of catalog rows. Returns how many pairs were
    written to `pair_image`, `pair_star`, `votes` and `held`, each of length 3 m. A vote is a
    distinct set of three observed stars; `held` marks pairs with a sharing star in some match.
    """
    low, middle, high = np.sort(image, axis=1).astype(np.int64).T
    triples, number = np.unique((low << 40) | (middle << 20) | high, return_inverse=True)
    distinct = max(len(triples), 1)
    of_corner = image.astype(np.int64) * stars + star
    counted = np.unique(of_corner * distinct + number[:, None]) // distinct
    pair, tally = np.unique(counted, return_counts=True)
    place = np.searchsorted(pair, of_corner)
    is_held = np.zeros(len(pair), np.bool_)
    is_held[place[(tally[place] >= LEAST_TRIANGLES).any(axis=1)]] = True
    ranked = np.argsort(-tally, kind="stable")
    count = len(pair)
    pair_image[:count], pair_star[:count] = np.divmod(pair[ranked], stars)
    votes[:count], held[:count] = tally[ranked], is_held[ranked]
    return count


@njit(nogil=True)
def validate(pair_image, pair_star, votes, held, match):  # type: ignore[no-untyped-def]
    """Choose the catalog row of each observed star by sharing stars into `match` (n,), -1 for none.

    Pairs are sorted by votes. Among the held pairs of a star that with the most votes counts, and
    none if two are tied; a catalog star likewise goes to the observed star with the most votes for
    it.
    """
    match[:] = -1
    n = len(match)
    best, tied = np.zeros(n, np.int64), np.zeros(n, np.bool_)
    for at in range(len(votes)):
        k = pair_image[at]
        if not held[at]:
            continue
        if best[k] == 0:
            best[k] = votes[at]
            match[k] = pair_star[at]
        elif votes[at] == best[k]:
            tied[k] = True
    for k in range(n):
        if tied[k]:
            match[k] = -1
    dropped = np.zeros(n, np.bool_)
    for k in range(n):
        for other in range(n):
            if other != k and match[k] >= 0 and match[other] == match[k] and best[other] >= best[k]:
                dropped[k] = True
    for k in range(n):
        if dropped[k]:
            match[k] = -1
