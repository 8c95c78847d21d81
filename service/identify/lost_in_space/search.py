"""The search: pairs in the order of their cost, candidates sieved by bitmap and by exact place.

What survives is settled to an attitude and weighed.  The search ends with the
first attitude that is beyond doubt, else when all pairs are tried or the bound
on the work is reached.
"""

import math

import numpy as np
from numba import njit

from service.attitude.kernels import triad
from service.identify.lost_in_space.matching import nearest_stars, settle
from service.identify.lost_in_space.pair_order import (
    buckets_of,
    cheapest_pair,
    classes_of,
    magnitude_gate,
    pair_costs,
    rows_within,
)
from service.identify.lost_in_space.predictors import predict
from service.sky.sky_bitmap import star_near
from service.sky.sky_index import BITMAP_RADII_RAD

FIRST_POINTS = 5
MOST_POINTS = 24
"""Brightest points of which pairs are made: first of few, then of more."""
FIRST_TRIES = 3
"""Pairs tried for being cheap, before those that every attitude must have one of."""
SIEVES_IN_TURN = 6
"""Points of which two at a time are the first that a candidate is held against."""
MOST_SIEVES = 12
"""Further points that a candidate is held against."""
SHARP_SIGMA_RAD = 3e-5
"""Up to 6 arcsec chance seldom puts a third star in its place: no fourth is asked for."""
SETTLE_WORK = 60
"""What settling costs, in candidates."""
MAX_WORK = 600_000
"""Candidates, at most: some 30 ms."""
SURE = 9.0
SURE_PER_CLUTTER = 0.5
"""Log evidence, and more for every point left unexplained, that ends the search."""
SAME_ATTITUDE_RAD = 2e-3
LEDGER = 12


@njit(cache=True, nogil=True)
def level_of(gate):  # type: ignore[no-untyped-def]
    """The least bitmap that no star within a gate escapes."""
    level = 0
    while BITMAP_RADII_RAD[level] < gate:
        level += 1
    return level


@njit(cache=True, nogil=True, error_model="numpy")
def search(points, index, field, ledger, weights, attitudes, covariances):  # type: ignore[no-untyped-def]
    """Fill the ledger (LEDGER, n) with weighed matches, heaviest first by insertion.

    Returns how many there are, the work done and whether it reached its bound.
    """
    n = len(points.observed)
    stars, pairs, offset, faces = index.stars, index.pairs, index.offset, index.face
    cell_start, cell_rows = index.cell_start, index.cell_rows
    gate_mag = magnitude_gate(field.magnitude_sigma)
    coefficients, gate = np.empty((n, 3)), np.empty(n)
    order = np.empty(n, np.int64)
    match = np.empty(n, np.int64)
    t, covariance = np.empty((3, 3)), np.empty((3, 3))
    count = work = tries = 0
    further = 2 if n > 4 and points.sigma[0] > SHARP_SIGMA_RAD else 1
    most = min(n, MOST_POINTS)
    cost = np.empty((most, most))
    used = np.ones(most)
    covered = np.zeros(most, np.bool_)
    done = best = 0
    while done < most:
        top = FIRST_POINTS if done == 0 and n > 2 * further + 2 else most
        pair_costs(points, index, done, top, gate_mag, cost)
        done = top
        while True:
            # Any attitude that explains so many points has two of them in one of so many groups;
            # of few points pairs that share none will do.
            groups = max(further + 1, best - 1)
            if n <= 2 * groups:
                groups = 0
            elif tries < FIRST_TRIES:
                groups = 1
            elif done < most:
                break
            i, j = cheapest_pair(cost, top, used, groups, covered)
            if i < 0:
                break
            tries += 1
            sieves = predict(points, i, j, BITMAP_RADII_RAD[-1], coefficients, gate, order)
            if sieves < further:
                continue
            # A poor lever does not reach all points: others must try again.
            covered[i] = covered[j] = covered[i] or sieves == n - 2
            either = n <= 6 or tries > 1
            sieves = min(sieves, MOST_SIEVES)
            low, high = buckets_of(points, index, i, j)
            first, last = classes_of(points, index, i, j, gate_mag)
            low_i, high_i = rows_within(index, points.magnitude[i], gate_mag)
            low_j, high_j = rows_within(index, points.magnitude[j], gate_mag)
            # Other points every time: those that tell most may be no stars.
            turns = min(sieves, SIEVES_IN_TURN)
            turn = 2 * (tries - 1)
            k = order[turn % turns]
            a0, b0, g0 = coefficients[k, 0], coefficients[k, 1], coefficients[k, 2]
            bits = index.bits[level_of(gate[k])]
            k = order[(turn + 1) % turns]
            a1, b1, g1 = coefficients[k, 0], coefficients[k, 1], coefficients[k, 2]
            bits1 = index.bits[level_of(gate[k])]
            for c in range(first, last + 1):
                for at in range(offset[c, low], offset[c, high + 1]):
                    for swap in range(2):
                        a = np.int64(pairs[at, swap])
                        b = np.int64(pairs[at, 1 - swap])
                        if a < low_i or a >= high_i or b < low_j or b >= high_j:
                            continue
                        work += 1
                        x0, x1, x2 = stars[a, 0], stars[a, 1], stars[a, 2]
                        y0, y1, y2 = stars[b, 0], stars[b, 1], stars[b, 2]
                        z0 = x1 * y2 - x2 * y1
                        z1 = x2 * y0 - x0 * y2
                        z2 = x0 * y1 - x1 * y0
                        if not star_near(
                            bits,
                            a0 * x0 + b0 * y0 + g0 * z0,
                            a0 * x1 + b0 * y1 + g0 * z1,
                            a0 * x2 + b0 * y2 + g0 * z2,
                        ) and not (
                            either
                            and star_near(
                                bits1,
                                a1 * x0 + b1 * y0 + g1 * z0,
                                a1 * x1 + b1 * y1 + g1 * z1,
                                a1 * x2 + b1 * y2 + g1 * z2,
                            )
                        ):
                            continue
                        # Exactly now: how many of the other points have a star in their place?
                        hits = 0
                        match[:] = -1
                        for s in range(sieves):
                            if hits + sieves - s < further or hits > further:
                                break
                            k = order[s]
                            p0 = coefficients[k, 0] * x0 + coefficients[k, 1] * y0
                            p0 += coefficients[k, 2] * z0
                            p1 = coefficients[k, 0] * x1 + coefficients[k, 1] * y1
                            p1 += coefficients[k, 2] * z1
                            p2 = coefficients[k, 0] * x2 + coefficients[k, 1] * y2
                            p2 += coefficients[k, 2] * z2
                            if not star_near(index.bits[level_of(gate[k])], p0, p1, p2):
                                continue
                            norm = 1.0 / math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
                            m = points.magnitude[k]
                            row, _, _ = nearest_stars(
                                *(stars, faces, cell_start, cell_rows),
                                *(p0 * norm, p1 * norm, p2 * norm, gate[k]),
                                *(m - gate_mag, m + gate_mag),
                            )
                            work += 2
                            if row >= 0 and row != a and row != b:
                                match[k] = row
                                hits += 1
                        if hits < further:
                            continue
                        match[i], match[j] = a, b
                        known = False
                        for h in range(count):
                            if ledger[h, i] == a and ledger[h, j] == b:
                                known = True
                                break
                        if known:
                            continue
                        work += SETTLE_WORK
                        triad(
                            *(points.observed[i], points.observed[j]),
                            *(stars[a, :3], stars[b, :3], t),
                        )
                        matched, weight = settle(
                            points, index, field, gate_mag, t, covariance, match
                        )
                        if matched < 3 or weight < 0.0:
                            continue
                        count = enter(
                            *(match, weight, t, covariance),
                            *(ledger, weights, attitudes, covariances, count),
                        )
                        best = max(best, matched)
                        if weight > SURE + SURE_PER_CLUTTER * (n - matched):
                            return count, work, False
                if work > MAX_WORK:
                    return count, work, True
    return count, work, False


@njit(cache=True, nogil=True)
def enter(match, weight, t, covariance, ledger, weights, attitudes, covariances, count):  # type: ignore[no-untyped-def]
    """Enter a match in the ledger, in place of the lightest where it is full."""
    for h in range(count):
        same = True
        for k in range(len(match)):
            if ledger[h, k] != match[k]:
                same = False
                break
        if same:
            return count
    if count < len(weights):
        at = count
        count += 1
    else:
        at = np.argmin(weights)
        if weights[at] >= weight:
            return count
    ledger[at] = match
    weights[at] = weight
    attitudes[at] = t
    covariances[at] = covariance
    return count
