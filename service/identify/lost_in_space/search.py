"""The search: pairs in the order of their cost, candidates sieved by bitmap and by exact place.

What survives is settled to an attitude and weighed.  The search ends with the
first attitude that is beyond doubt, else when all pairs are tried or the bound
on the work is reached.
"""

import math

import numpy as np
from numba import njit

from service.attitude.kernels import triad
from service.identify.lost_in_space import weighing
from service.identify.lost_in_space.matching import faintest_star, nearest_stars, settle
from service.identify.lost_in_space.pair_order import (
    buckets_of,
    chances_beyond,
    cheapest_pair,
    classes_of,
    magnitude_gate,
    pair_costs,
    rows_within,
)
from service.identify.lost_in_space.predictors import BEYOND, GATE, predict
from service.sky.sky_bitmap import star_near
from service.sky.sky_index import BITMAP_RADII_RAD

FIRST_POINTS = 7
MOST_POINTS = 24
"""Brightest points of which pairs are made: first of few, then of more."""
FIRST_TRIES = 3
"""Pairs tried for being cheap, before those that every attitude must have one of."""
NARROW_GATE, NARROW_MAG = 2.8, 0.75
"""First tries look less far: sigmas of a separation, and a share of the gate of magnitudes.
One in fifty true pairs is missed for half the work.  Of few points all is tried again in full."""
FEW_POINTS, MOST_FIRST = 6, 4
"""Of so few points a candidate is first held against all others; of more against three."""
SIEVES_IN_TURN = 6
"""Points of which three at a time are the first that a candidate is held against."""
MOST_SIEVES = 12
"""Further points that a candidate is held against."""
MOST_HITS = 6
"""Points of a candidate that is put off: its pair and up to three further ones, and one spare."""
MOST_PUT_OFF = 1500
"""Candidates with few further points wait until all pairs were tried for one that has more."""
SETTLE_WORK = 60
"""What settling costs, in candidates."""
MAX_WORK = 600_000
"""Candidates, at most: some 30 ms."""
SURE = 7.5
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


@njit(cache=True, nogil=True)
def levels_of(gate, beyond, order, sieves, level):  # type: ignore[no-untyped-def]
    """Fill `level` with the bitmap of every sieve, one of all stars for points that need it."""
    for s in range(sieves):
        k = order[s]
        level[k] = level_of(gate[k])
        if beyond[k] > BEYOND:
            level[k] += len(BITMAP_RADII_RAD)


@njit(cache=True, nogil=True, error_model="numpy")
def search(points, index, field, ledger, weights, attitudes, covariances):  # type: ignore[no-untyped-def]
    """Fill the ledger (LEDGER, n) with weighed matches, heaviest first by insertion.

    Returns how many there are, the work done and whether it reached its bound; no
    work where even a perfect match would not be believed.
    """
    n = len(points.observed)
    stars, pairs, offset, faces = index.stars, index.pairs, index.offset, index.face
    cell_start, cell_rows = index.cell_start, index.cell_rows
    gate_mag = magnitude_gate(field.magnitude_sigma)
    coefficients, gate = np.empty((n, 3)), np.empty(n)
    order = np.empty(n, np.int64)
    match = np.empty(n, np.int64)
    level, turn = np.empty(n, np.int64), np.empty(MOST_FIRST, np.int64)
    bits = index.bits
    later = np.empty((MOST_PUT_OFF, 2 * MOST_HITS), np.int32)
    put_off = 0
    t, covariance = np.empty((3, 3)), np.empty((3, 3))
    count = work = tries = 0
    fewest = weighing.fewest_stars(points, field.area, field.magnitude_sigma)
    if fewest > n:
        return 0, 0, False
    further = fewest - 2
    most = min(n, MOST_POINTS)
    beyond = chances_beyond(points, index, field.magnitude_sigma)
    cost = np.empty((most, most))
    used = np.ones(most)
    covered = np.zeros(most, np.bool_)
    done = best = 0
    hasty = n - 3 if n <= FEW_POINTS else 0
    while done < most:
        top = min(FIRST_POINTS, most) if done == 0 and n > 2 * further + 2 else most
        pair_costs(points, index, done, top, gate_mag, beyond, cost)
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
            if hasty > 0 and (i < 0 or tries == hasty):
                # Of few points every pair is needed: now all that count, in full.
                hasty = 0
                used[:] = 1.0
                covered[:] = False
                pair_costs(points, index, 0, top, gate_mag, beyond, cost)
                i, j = cheapest_pair(cost, top, used, groups, covered)
            if i < 0:
                break
            tries += 1
            sieves = predict(points, beyond, i, j, BITMAP_RADII_RAD[-1], coefficients, gate, order)
            if sieves < further:
                continue
            # A poor lever does not reach all points: others must try again.
            covered[i] = covered[j] = covered[i] or sieves == n - 2
            sieves = min(sieves, MOST_SIEVES)
            narrow = sieves >= 2 and tries <= (hasty if n <= FEW_POINTS else FIRST_TRIES)
            low, high = buckets_of(points, index, i, j, NARROW_GATE if narrow else GATE)
            pair_mag = NARROW_MAG * gate_mag if narrow else gate_mag
            first, last = classes_of(points, index, i, j, pair_mag)
            low_i, high_i = rows_within(index, points.magnitude[i], pair_mag)
            low_j, high_j = rows_within(index, points.magnitude[j], pair_mag)
            levels_of(gate, beyond, order, sieves, level)
            # Other points every time: those that tell most may be no stars.  Of few points all.
            if narrow and (tries == 1 or n <= FEW_POINTS):
                firsts = needed = 2
            elif n <= FEW_POINTS:
                firsts, needed = sieves, further
            elif tries <= FIRST_TRIES:
                firsts, needed = min(sieves, 3), 2
            else:
                # Where half of the points are no stars, two of three is too much to ask.
                firsts, needed = min(sieves, 2), 1
            strong = min(further + 2, (3 * sieves + 3) // 4)
            turns = min(sieves, SIEVES_IN_TURN)
            for s in range(firsts):
                turn[s] = order[(firsts * (tries - 1) + s) % turns]
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
                        possible = 0
                        for s in range(firsts):
                            k = turn[s]
                            possible += star_near(
                                bits,
                                level[k],
                                coefficients[k, 0] * x0
                                + coefficients[k, 1] * y0
                                + coefficients[k, 2] * z0,
                                coefficients[k, 0] * x1
                                + coefficients[k, 1] * y1
                                + coefficients[k, 2] * z1,
                                coefficients[k, 0] * x2
                                + coefficients[k, 1] * y2
                                + coefficients[k, 2] * z2,
                            )
                            if possible == needed or possible + firsts - 1 - s < needed:
                                break
                        if possible < needed:
                            continue
                        # Exactly now: how many of the other points have a star in their place?
                        hits = 0
                        match[:] = -1
                        for s in range(sieves):
                            if hits + sieves - s < further or hits == strong:
                                break
                            k = order[s]
                            p0 = coefficients[k, 0] * x0 + coefficients[k, 1] * y0
                            p0 += coefficients[k, 2] * z0
                            p1 = coefficients[k, 0] * x1 + coefficients[k, 1] * y1
                            p1 += coefficients[k, 2] * z1
                            p2 = coefficients[k, 0] * x2 + coefficients[k, 1] * y2
                            p2 += coefficients[k, 2] * z2
                            if not star_near(bits, level[k], p0, p1, p2):
                                continue
                            norm = 1.0 / math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
                            m = points.magnitude[k]
                            row, _, _ = nearest_stars(
                                *(stars, faces, cell_start, cell_rows),
                                *(p0 * norm, p1 * norm, p2 * norm, gate[k]),
                                *(m - gate_mag, faintest_star(index, m, gate_mag)),
                            )
                            work += 2
                            if row >= 0 and row != a and row != b:
                                match[k] = row
                                hits += 1
                        if hits < further:
                            continue
                        match[i], match[j] = a, b
                        if hits < strong and put_off < MOST_PUT_OFF:
                            put_off = put(later, put_off, match, i, j)
                            continue
                        work += SETTLE_WORK
                        count, matched, sure = weigh(
                            *(points, index, field, gate_mag, i, j, t, covariance, match),
                            *(ledger, weights, attitudes, covariances, count),
                        )
                        best = max(best, matched)
                        if sure:
                            return count, work, False
                if work > MAX_WORK:
                    return count, work, True
    for at in range(put_off):
        i, j = take(later, at, match)
        work += SETTLE_WORK
        count, _, sure = weigh(
            *(points, index, field, gate_mag, i, j, t, covariance, match),
            *(ledger, weights, attitudes, covariances, count),
        )
        if sure:
            return count, work, False
        if work > MAX_WORK:
            return count, work, True
    return count, work, False


@njit(cache=True, nogil=True)
def put(later, at, match, i, j):  # type: ignore[no-untyped-def]
    """Put a candidate off: its pair of points first, then its further hits, each with its star."""
    later[at] = -1
    later[at, 0], later[at, 1] = i, match[i]
    later[at, 2], later[at, 3] = j, match[j]
    to = 4
    for k in range(len(match)):
        if match[k] >= 0 and k != i and k != j:
            later[at, to], later[at, to + 1] = k, match[k]
            to += 2
    return at + 1


@njit(cache=True, nogil=True)
def take(later, at, match):  # type: ignore[no-untyped-def]
    """The match of a candidate that was put off, and its pair of points."""
    match[:] = -1
    for to in range(0, later.shape[1], 2):
        if later[at, to] >= 0:
            match[later[at, to]] = later[at, to + 1]
    return np.int64(later[at, 0]), np.int64(later[at, 2])


@njit(cache=True, nogil=True)
def weigh(  # type: ignore[no-untyped-def]
    points,
    index,
    field,
    gate_mag,
    i,
    j,
    t,
    covariance,
    match,
    ledger,
    weights,
    attitudes,
    covariances,
    count,
):
    """Settle a candidate and enter it: how many there are, how many stars it has, is it sure."""
    for h in range(count):
        if ledger[h, i] == match[i] and ledger[h, j] == match[j]:
            return count, 0, False
    triad(
        *(points.observed[i], points.observed[j]),
        *(index.stars[match[i], :3], index.stars[match[j], :3], t),
    )
    matched, weight = settle(points, index, field, gate_mag, t, covariance, match)
    if matched < 3 or weight < 0.0:
        return count, 0, False
    count = enter(
        *(match, weight, t, covariance), *(ledger, weights, attitudes, covariances, count)
    )
    return count, matched, weight > SURE + SURE_PER_CLUTTER * (len(match) - matched)


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
