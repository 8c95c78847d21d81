"""Which pair of points to look up first: bright ones with few candidates and a good lever."""

import math

import numpy as np
from numba import njit

from service.identify.lost_in_space import weighing
from service.identify.lost_in_space.predictors import GATE, SLACK_RAD
from service.sky.sky_index import BUCKET_RAD

LEAST_PAIR_RAD = 0.006
"""A shorter pair fixes the turn about itself too poorly to predict anything."""
TYPICAL_REACH_RAD = 0.07
"""Where the other points of a field lie."""
CHORD_OF_LONGEST = 0.999
"""The chord of 8 degrees over its arc, less a little."""
CELL_RAD = 2.5e-3
"""What a bitmap's cell adds to the place of a star."""
EXACT_COST = 2.0
"""Of holding a candidate against the exact place of one more point, in candidates."""
PRIOR_COST = 40.0
"""Of trying a pair at all, in candidates."""
RANK_COST = 0.15
"""A pair of fainter points is less sure to be two stars of the index."""
USE_COST = 3.0
"""Each failed try of a point makes it this much less attractive."""
MOST_BEYOND = 0.9
"""Of a point fainter than the limit.  None is given up: magnitudes may be off together."""
MAGNITUDE_GATE = 3.3
"""In sigmas of magnitude."""
OFFSET_ALLOWED_MAG = 0.15


@njit(cache=True, nogil=True)
def magnitude_gate(sigma_mag):  # type: ignore[no-untyped-def]
    """How far a point's magnitude may be from its star's."""
    return MAGNITUDE_GATE * math.hypot(sigma_mag, OFFSET_ALLOWED_MAG)


@njit(cache=True, nogil=True)
def rows_within(index, magnitude, gate):  # type: ignore[no-untyped-def]
    """First row and the one past the last of the stars that a point of this magnitude may be."""
    n = len(index.stars)
    if np.isnan(magnitude):
        return 0, n
    low, high = 0, n
    while low < high:
        middle = (low + high) // 2
        if index.stars[middle, 3] < magnitude - gate:
            low = middle + 1
        else:
            high = middle
    first, high = low, n
    while low < high:
        middle = (low + high) // 2
        if index.stars[middle, 3] <= magnitude + gate:
            low = middle + 1
        else:
            high = middle
    return first, low


@njit(cache=True, nogil=True, error_model="numpy")
def chances_beyond(points, index, sigma_mag):  # type: ignore[no-untyped-def]
    """The chance (n,) of each point, if a star, to be one beyond the limit of pairs.

    Noise shows more faint stars as bright than bright ones as faint, for there
    are more of them: of a magnitude the likely truth is fainter.
    """
    limit = index.class_edge[-1, 0] - weighing.COUNT_SLOPE * sigma_mag * sigma_mag
    beyond = np.zeros(len(points.magnitude))
    for k in range(len(beyond)):
        if not np.isnan(points.magnitude[k]):
            off = (limit - points.magnitude[k]) / (sigma_mag * math.sqrt(2.0))
            beyond[k] = min(0.5 * math.erfc(off), MOST_BEYOND)
    return beyond


@njit(cache=True, nogil=True)
def chord(a, b):  # type: ignore[no-untyped-def]
    """The straight distance between two unit vectors."""
    dx, dy, dz = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@njit(cache=True, nogil=True, error_model="numpy")
def buckets_of(points, index, i, j, gate):  # type: ignore[no-untyped-def]
    """First and last bucket of separation that a pair's star pair may be in, by so many sigmas."""
    apart = 2.0 * math.asin(min(1.0, 0.5 * chord(points.observed[i], points.observed[j])))
    tolerance = gate * math.hypot(points.sigma[i], points.sigma[j]) + SLACK_RAD
    last = index.offset.shape[1] - 2
    return (
        max(int((apart - tolerance) / BUCKET_RAD), 0),
        min(int((apart + tolerance) / BUCKET_RAD), last),
    )


@njit(cache=True, nogil=True)
def classes_of(points, index, i, j, gate):  # type: ignore[no-untyped-def]
    """First and last class of the fainter star of the pair; all where a magnitude is unknown."""
    classes = len(index.class_edge)
    faint = max(points.magnitude[i], points.magnitude[j])
    if np.isnan(points.magnitude[i]) or np.isnan(points.magnitude[j]):
        return 0, classes - 1
    first = 0
    while first < classes - 1 and index.class_edge[first, 0] < faint - gate:
        first += 1
    last = first
    while last < classes - 1 and index.class_edge[last, 0] < faint + gate:
        last += 1
    return first, last


@njit(cache=True, nogil=True, error_model="numpy")
def pair_costs(points, index, first_fresh, count, gate, beyond, cost):  # type: ignore[no-untyped-def]
    """What each pair of the first `count` points costs to try, into `cost`; infinite: not at all.

    Pairs of the first `first_fresh` points keep what they have.  The number of
    candidates is that of evenly spread stars; `beyond` (n,) is each point's
    chance of being no star of any pair.
    """
    buckets = index.offset.shape[1] - 1
    longest = buckets * BUCKET_RAD
    density = math.sqrt(len(index.pairs) / (1.0 - math.cos(longest))) / (2.0 * math.pi)
    others = min(len(points.observed) - 2, 10)
    pairs_per_rad2 = 2.0 * len(index.pairs) / (longest * longest)
    for j in range(count):
        for i in range(j):
            if j < first_fresh:
                continue
            cost[i, j] = math.inf
            apart = chord(points.observed[i], points.observed[j])
            if apart < LEAST_PAIR_RAD or apart > longest * CHORD_OF_LONGEST:
                continue
            first, last = classes_of(points, index, i, j, gate)
            share = index.class_edge[last, 1]
            if first > 0:
                share -= index.class_edge[first - 1, 1]
            tolerance = GATE * math.hypot(points.sigma[i], points.sigma[j]) + SLACK_RAD
            candidates = share * pairs_per_rad2 * apart * 2.0 * tolerance
            lever = TYPICAL_REACH_RAD / apart
            around = GATE * points.sigma[i] * math.sqrt(1.0 + 2.0 * lever * lever) + CELL_RAD
            passing = density * math.pi * around * around * EXACT_COST * others
            sure = (1.0 - beyond[i]) * (1.0 - beyond[j]) / (1.0 + RANK_COST * (i + j))
            cost[i, j] = (PRIOR_COST + candidates * (1.0 + passing)) / sure


@njit(cache=True, nogil=True)
def cheapest_pair(cost, count, used, groups, covered):  # type: ignore[no-untyped-def]
    """The pair to try next, points tried in vain set back; (-1, -1) where none is left.

    Only pairs of one group: those whose ranks leave the same remainder.  With
    no groups (0) only pairs of points that are not `covered` yet.
    """
    left = right = -1
    least = math.inf
    for j in range(count):
        for i in range(j):
            if cost[i, j] == math.inf:
                continue
            if (covered[i] or covered[j]) if groups == 0 else (j - i) % groups != 0:
                continue
            value = cost[i, j] * used[i] * used[j]
            if value < least:
                least, left, right = value, i, j
    if left >= 0:
        cost[left, right] = math.inf
        used[left] *= USE_COST
        used[right] *= USE_COST
    return left, right
