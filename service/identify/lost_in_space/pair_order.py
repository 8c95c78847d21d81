"""Order in which point pairs are looked up: bright ones with few candidates and a long baseline."""

import math

import numpy as np

from service.compiled.jit import njit
from service.identify.lost_in_space import posterior
from service.identify.lost_in_space.predictors import GATE, SLACK_RAD
from service.sky.whole_sky.index import BRIGHTEST_MAG, BUCKET_RAD, STEP_MAG

LEAST_PAIR_RAD = 0.006
"""Least separation of a pair of points; shorter ones fix a rotation too poorly."""
TYPICAL_REACH_RAD = 0.07
"""Typical distance of the other points of a field from a pair."""
CHORD_OF_LONGEST = 0.999
"""Ratio of the chord to the arc of 8 degrees, rounded down."""
CELL_RAD = 2.5e-3
"""Error of a star's place from the cell size of a sky bitmap, in radians."""
EXACT_COST = 2.0
"""Cost of comparing a candidate with the exact place of one more point, in candidates."""
PRIOR_COST = 40.0
"""Fixed cost of trying a pair of points, in units of examining one candidate."""
RANK_COST = 0.15
"""Relative increase of a pair's cost per rank of its points, as fainter ones are less useful."""
USE_COST = 3.0
"""Factor on the cost of a point's other pairs after each try of a pair."""
MOST_BEYOND = 0.9
"""Bound on the probability that a point is too faint; below 1: magnitudes may share an offset."""
SURELY_WITHIN = 5.0
"""Sigmas by which a point is brighter than the limit from which it is surely no star beyond it."""
NO_ROW = 1 << 16
"""A row number larger than any in the index."""
MAGNITUDE_GATE = 3.3
"""Largest difference of a point's and a star's magnitude, in sigmas."""
OFFSET_ALLOWED_MAG = 0.15


@njit(nogil=True)
def magnitude_gate(sigma_mag):  # type: ignore[no-untyped-def]
    """The largest accepted difference between the magnitudes of a point and its star."""
    return MAGNITUDE_GATE * math.hypot(sigma_mag, OFFSET_ALLOWED_MAG)


@njit(nogil=True)
def rows_of_magnitude(brighter, magnitude, gate):  # type: ignore[no-untyped-def]
    """The range of index rows (first, one past the last) of stars that a point's magnitude allows.

    The range is rounded to steps of the table `brighter`, so that it has a few stars more.
    """
    last = len(brighter) - 1
    if np.isnan(magnitude):
        return 0, NO_ROW
    low = math.floor((magnitude - gate - BRIGHTEST_MAG) * (1.0 / STEP_MAG))
    high = math.floor((magnitude + gate - BRIGHTEST_MAG) * (1.0 / STEP_MAG)) + 1
    first = brighter[min(max(low, 0), last)]
    return first, NO_ROW if high > last else brighter[max(high, 0)]


@njit(nogil=True, error_model="numpy")
def describe_points(points, index, sigma_mag, gate, pairs):  # type: ignore[no-untyped-def]
    """Fill `pairs` with each point's pair classes, and its chance to be a star beyond the limit.

    Since faint stars are more numerous, noise makes more of them look bright than the reverse: the
    likely true magnitude is fainter than the measured one.
    """
    limit = index.class_edge[-1, 0] - posterior.COUNT_SLOPE * sigma_mag * sigma_mag
    for k in range(len(points.magnitude)):
        first, last = classes_of(points.magnitude[k], index.class_edge, gate)
        pairs.first[k], pairs.last[k] = first, last
        pairs.share[k] = index.class_edge[last, 1]
        if first > 0:
            pairs.share[k] -= index.class_edge[first - 1, 1]
        pairs.beyond[k] = 0.0
        brighter = (limit - points.magnitude[k]) / sigma_mag
        # Does not apply to unknown magnitudes (NaN).
        if brighter < SURELY_WITHIN:
            chance = 0.5 * math.erfc(brighter * math.sqrt(0.5))
            pairs.beyond[k] = min(chance, MOST_BEYOND)


@njit(nogil=True)
def chord(a, b):  # type: ignore[no-untyped-def]
    """The length of the chord between two unit vectors."""
    dx, dy, dz = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@njit(nogil=True, error_model="numpy")
def buckets_of(points, index, i, j, gate):  # type: ignore[no-untyped-def]
    """The range (first, last) of the index's separation buckets that a pair of points may match."""
    apart = 2.0 * math.asin(min(1.0, 0.5 * chord(points.observed[i], points.observed[j])))
    variance = points.sigma[i] * points.sigma[i] + points.sigma[j] * points.sigma[j]
    tolerance = gate * math.sqrt(variance) + SLACK_RAD
    last = index.offset.shape[1] - 2
    return (
        max(int((apart - tolerance) / BUCKET_RAD), 0),
        min(int((apart + tolerance) / BUCKET_RAD), last),
    )


@njit(nogil=True)
def classes_of(magnitude, class_edge, gate):  # type: ignore[no-untyped-def]
    """The range (first, last) of pair classes for a fainter star's magnitude; all if unknown."""
    classes = len(class_edge)
    if np.isnan(magnitude):
        return 0, classes - 1
    first = 0
    while first < classes - 1 and class_edge[first, 0] < magnitude - gate:
        first += 1
    last = first
    while last < classes - 1 and class_edge[last, 0] < magnitude + gate:
        last += 1
    return first, last


@njit(nogil=True, error_model="numpy")
def pair_costs(points, index, first_fresh, count, pairs):  # type: ignore[no-untyped-def]
    """Compute the cost of trying each pair of the first `count` points; infinite for useless pairs.

    Costs among the first `first_fresh` points are left unchanged. The number of candidates is
    estimated for uniformly distributed stars. Points are sorted brightest first, with unknown
    magnitudes last, so that a pair's classes are those of its later point.
    """
    longest = (index.offset.shape[1] - 1) * BUCKET_RAD
    density = math.sqrt(len(index.pairs) / (1.0 - math.cos(longest))) / (2.0 * math.pi)
    others = min(len(points.observed) - 2, 10)
    pairs_per_rad2 = 2.0 * len(index.pairs) / (longest * longest)
    observed, sigma = points.observed, points.sigma
    cost, beyond = pairs.cost, pairs.beyond
    for j in range(first_fresh, count):
        per_rad = pairs.share[j] * pairs_per_rad2 * 2.0
        y0, y1, y2 = observed[j, 0], observed[j, 1], observed[j, 2]
        for i in range(j):
            x0, x1, x2 = observed[i, 0] - y0, observed[i, 1] - y1, observed[i, 2] - y2
            apart = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
            if apart < LEAST_PAIR_RAD or apart > longest * CHORD_OF_LONGEST:
                cost[i, j] = math.inf
                continue
            variance = sigma[i] * sigma[i] + sigma[j] * sigma[j]
            candidates = per_rad * apart * (GATE * math.sqrt(variance) + SLACK_RAD)
            lever = TYPICAL_REACH_RAD / apart
            around = GATE * sigma[i] * math.sqrt(1.0 + 2.0 * lever * lever) + CELL_RAD
            passing = density * math.pi * around * around * EXACT_COST * others
            sure = (1.0 - beyond[i]) * (1.0 - beyond[j]) / (1.0 + RANK_COST * (i + j))
            cost[i, j] = (PRIOR_COST + candidates * (1.0 + passing)) / sure


@njit(nogil=True)
def cheapest_pair(pairs, count, groups):  # type: ignore[no-untyped-def]
    """The cheapest pair to try next, with failed points penalised; (-1, -1) if none is left.

    Only pairs within a group are considered, whose ranks have the same remainder. With no groups
    (0) only pairs of points that are not `covered` yet are.
    """
    cost, used, covered = pairs.cost, pairs.used, pairs.covered
    left = right = -1
    least = math.inf
    for j in range(count):
        for i in range(j):
            if cost[i, j] == math.inf:
                continue
            if (covered[i] != 0 or covered[j] != 0) if groups == 0 else (j - i) % groups != 0:
                continue
            value = cost[i, j] * used[i] * used[j]
            if value < least:
                least, left, right = value, i, j
    if left >= 0:
        cost[left, right] = math.inf
        used[left] *= USE_COST
        used[right] *= USE_COST
    return left, right
