"""The lost-in-space search: point pairs by cost, candidates filtered by bitmap and exact place.

Surviving candidates are refined to an attitude and weighed. The search ends with the first attitude
beyond doubt, when all pairs were tried, or at the work limit.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from service.attitude.triad import triad
from service.compiled.arrays import copy_rows
from service.compiled.jit import njit
from service.identify.lost_in_space import posterior
from service.identify.lost_in_space.matching import faintest_star, nearest_stars, refine
from service.identify.lost_in_space.pair_order import (
    buckets_of,
    cheapest_pair,
    classes_of,
    describe_points,
    magnitude_gate,
    pair_costs,
    rows_of_magnitude,
)
from service.identify.lost_in_space.predictors import GATE, predict
from service.identify.lost_in_space.prefilter import pairs_of, possible_of, ranked, stars_near
from service.identify.lost_in_space.workspace import (
    CHUNK,
    MAX_DEFERRED,
    MOST_POINTS,
    candidate_in,
    chunk_in,
    counters_in,
    deferred_in,
    ledger_in,
    point_pairs_in,
    prefilter_in,
)
from service.sky.whole_sky.index import BITMAP_RADII_RAD

FIRST_POINTS = 7
"""Number of brightest points whose pairs are tried first in rich fields."""
FIRST_TRIES = 3
"""Number of pairs tried by cost alone, before the sets of which every attitude contains a pair."""
NARROW_GATE, NARROW_MAG = 2.8, 0.75
"""Reduced gates of the first tries: sigmas of a separation, and a factor on the magnitude gate.
They miss one in fifty true pairs for half the work. With few points all pairs are repeated in full.
"""
FEW_POINTS, MOST_FIRST = 6, 4
"""Number of points up to which candidates are compared with all others first, else with three."""
PREFILTERED_IN_TURN = 6
"""Number of most informative points among which the three points of the first comparison rotate.
Later tries rotate among all points, since the bright ones may all be false.
"""
MAX_PREFILTERED = 12
"""Largest number of further points that bitmaps and exact places test for a candidate."""
REFINE_WORK = 60
"""Work of refining a candidate attitude, in units of examining one."""
MAX_WORK = 600_000
"""Work limit of a search of the whole sky, in examined candidates: about 30 ms."""
ACCEPT_LOG = 7.5
ACCEPT_LOG_PER_CLUTTER = 0.5
"""Additional log evidence per unexplained point that is needed to end the search."""
SAME_ATTITUDE_RAD = 2e-3


WORK, COUNT, DEFERRED, BEST, LIMIT = 0, 1, 2, 3, 4
"""Indices of the counters: candidates examined, ledger entries, deferred candidates, most stars
matched, and the work limit.
"""
PAIR, STAR_I, STAR_J, NEAR = 0, 1, 2, 3
"""Columns of a deferred candidate: its points as i * MOST_POINTS + j, their stars, and a bit mask
of further points that may have a star.
"""
GOING_ON, ACCEPTED, AT_BOUND = 0, 1, 2


class Plan(NamedTuple):
    """The plan for testing the candidates of a pair of points (i, j).

    By bitmap, at least `needed` of the `firsts` points in `turn` must be able to have a star. At
    least `further` of the first `prefiltered` in `order` must have one; `strong` are enough for
    immediate refinement. `gate` is for the separation in sigmas, `gate_mag` for the magnitudes.
    """

    i: Any
    j: Any
    prefiltered: Any
    firsts: Any
    needed: Any
    further: Any
    strong: Any
    gate: Any
    gate_mag: Any


@njit(nogil=True, error_model="numpy")
def search(points, index, field, max_work, workspace):  # type: ignore[no-untyped-def]
    """Search for attitudes of the points, and fill the ledger with weighed matches.

    Returns the number of matches, the work, and true at the work limit; the work is zero if even a
    perfect match would not be believed.
    """
    n = len(points.observed)
    gate_mag = magnitude_gate(field.magnitude_sigma)
    counters, pairs, prefilter = (
        counters_in(workspace),
        point_pairs_in(workspace),
        prefilter_in(workspace),
    )
    counters[:] = 0
    # Unused ranks are computed too, with harmless values.
    prefilter.single[:] = 1.0
    counters[LIMIT] = min(MAX_WORK, max_work)
    fewest = posterior.fewest_stars(points, field.area, field.magnitude_sigma)
    if fewest > n:
        return 0, 0, False
    further = fewest - 2
    most = min(n, MOST_POINTS)
    describe_points(points, index, field.magnitude_sigma, gate_mag, pairs)
    pairs.used[:] = 1.0
    pairs.covered[:] = 0
    done = tries = 0
    narrow_tries = n - 3 if n <= FEW_POINTS else 0
    state = GOING_ON
    while done < most and state == GOING_ON:
        top = min(FIRST_POINTS, most) if done == 0 and n > 2 * further + 2 else most
        pair_costs(points, index, done, top, pairs)
        done = top
        while state == GOING_ON:
            # A match of this many points has two in one of this many groups; with few points, pairs
            # without a common point suffice.
            groups = max(further + 1, counters[BEST] - 1)
            if n <= 2 * groups:
                groups = 0
            elif tries < FIRST_TRIES:
                groups = 1
            elif done < most:
                break
            i, j = cheapest_pair(pairs, top, groups)
            if narrow_tries > 0 and (i < 0 or tries == narrow_tries):
                # With few points every pair is needed: now all possible pairs, in full.
                narrow_tries = 0
                pairs.used[:] = 1.0
                pairs.covered[:] = 0
                pair_costs(points, index, 0, top, pairs)
                i, j = cheapest_pair(pairs, top, groups)
            if i < 0:
                break
            tries += 1
            prefiltered = predict(points, pairs.beyond, i, j, BITMAP_RADII_RAD[-1], prefilter)
            if prefiltered < further:
                continue
            # A short baseline does not predict all points: its points must be tried again.
            pairs.covered[i] = pairs.covered[j] = pairs.covered[i] or prefiltered == n - 2
            may_be_narrow = tries <= (narrow_tries if n <= FEW_POINTS else FIRST_TRIES)
            plan = plan_of(n, i, j, prefiltered, tries, may_be_narrow, further, gate_mag, prefilter)
            state = try_pair(points, index, field, gate_mag, plan, workspace)
    if state == GOING_ON:
        state = try_deferred(points, index, field, gate_mag, further, workspace)
    return counters[COUNT], counters[WORK], state == AT_BOUND


@njit(nogil=True)
def strong_of(further, prefiltered):  # type: ignore[no-untyped-def]
    """The number of further matched points from which a candidate is refined before others."""
    return min(further + 2, (3 * prefiltered + 3) // 4)


@njit(nogil=True)
def plan_of(n, i, j, prefiltered, tries, may_be_narrow, further, gate_mag, prefilter):  # type: ignore[no-untyped-def]
    """The plan for testing the star pairs that a pair of points may be."""
    prefiltered = min(prefiltered, MAX_PREFILTERED)
    narrow = prefiltered >= 2 and may_be_narrow
    # Other points at every try, since the most informative may be false; with few points all of
    # them.
    if narrow and (tries == 1 or n <= FEW_POINTS):
        firsts = needed = 2
    elif n <= FEW_POINTS:
        firsts, needed = prefiltered, further
    elif tries <= FIRST_TRIES:
        firsts, needed = min(prefiltered, 3), min(prefiltered, 2)
    else:
        # If half of the points are false, two of three is too much to ask.
        firsts, needed = min(prefiltered, 2), 1
    turns = min(prefiltered, PREFILTERED_IN_TURN) if tries <= FIRST_TRIES else prefiltered
    for s in range(firsts):
        prefilter.turn[s] = (firsts * (tries - 1) + s) % turns
    strong = strong_of(further, prefiltered)
    gate = NARROW_GATE if narrow else GATE
    gate_mag = NARROW_MAG * gate_mag if narrow else gate_mag
    return Plan(i, j, prefiltered, firsts, needed, further, strong, gate, gate_mag)


@njit(nogil=True, error_model="numpy", forceinline=True)
def try_pair(points, index, field, gate_mag, plan, workspace):  # type: ignore[no-untyped-def]
    """Test every star pair of the index for a pair of points; returns if and why to end."""
    i, j = plan.i, plan.j
    prefilter, chunk, counters = (
        prefilter_in(workspace),
        chunk_in(workspace),
        counters_in(workspace),
    )
    ranked(prefilter, point_pairs_in(workspace).beyond, plan.prefiltered)
    low, high = buckets_of(points, index, i, j, plan.gate)
    first, last = classes_of(points.magnitude[j], index.class_edge, plan.gate_mag)
    rows_i = rows_of_magnitude(index.brighter, points.magnitude[i], plan.gate_mag)
    rows_j = rows_of_magnitude(index.brighter, points.magnitude[j], plan.gate_mag)
    # Among this number of the first points at least one must have a star.
    asked = plan.firsts - plan.needed + 1
    for c in range(first, last + 1):
        at, end = np.int64(index.offset[c, low]), np.int64(index.offset[c, high + 1])
        while at < end:
            upto = min(at + CHUNK, end)
            count = upto - at
            counters[WORK] += pairs_of(index.pairs, index.place, at, count, rows_i, rows_j, chunk)
            for left in range(possible_of(index.bits, count, asked, prefilter, chunk)):
                pair, turned = at + (chunk.possible[left] >> 1), chunk.possible[left] & 1
                a, b = np.int64(index.pairs[pair, turned]), np.int64(index.pairs[pair, 1 - turned])
                near = stars_near(index.bits, prefilter, plan, index.place[a], index.place[b])
                possible = bit_count(near)
                if possible < plan.further:
                    continue
                if possible < plan.strong and counters[DEFERRED] < MAX_DEFERRED:
                    defer(workspace, i, j, a, b, near)
                    continue
                hits = hits_of(points, index, gate_mag, plan, a, b, near, workspace)
                if hits < plan.further:
                    continue
                if hits < plan.strong and counters[DEFERRED] < MAX_DEFERRED:
                    defer(workspace, i, j, a, b, near)
                    continue
                if weigh(points, index, field, gate_mag, i, j, workspace):
                    return ACCEPTED
            at = upto
            if counters[WORK] > counters[LIMIT]:
                return AT_BOUND
    return GOING_ON


@njit(nogil=True)
def bit_count(bits):  # type: ignore[no-untyped-def]
    """The number of set bits in a mask."""
    count = 0
    while bits:
        bits &= bits - 1
        count += 1
    return count


@njit(nogil=True, error_model="numpy", forceinline=True)
def hits_of(points, index, gate_mag, plan, a, b, near, workspace):  # type: ignore[no-untyped-def]
    """The number of further points with a star at their exact place if i and j are stars a and b.

    Possible points are checked one by one until they are `strong`, or too few remain; their stars
    go to the candidate's match.
    """
    prefilter, match, counters = (
        prefilter_in(workspace),
        candidate_in(workspace).match,
        counters_in(workspace),
    )
    coefficients, gate, order = prefilter.coefficients, prefilter.gate, prefilter.order
    stars = index.stars
    limit_mag = index.class_edge[-1, 0]
    x0, x1, x2 = stars[a, 0], stars[a, 1], stars[a, 2]
    y0, y1, y2 = stars[b, 0], stars[b, 1], stars[b, 2]
    z0, z1, z2 = x1 * y2 - x2 * y1, x2 * y0 - x0 * y2, x0 * y1 - x1 * y0
    hits, left = 0, bit_count(near)
    match[:] = -1
    for s in range(plan.prefiltered):
        if hits + left < plan.further or hits == plan.strong:
            break
        if (near >> s) & 1 == 0:
            continue
        left -= 1
        k = order[s]
        f, g, h = coefficients[k, 0], coefficients[k, 1], coefficients[k, 2]
        p0, p1, p2 = f * x0 + g * y0 + h * z0, f * x1 + g * y1 + h * z1, f * x2 + g * y2 + h * z2
        norm = 1.0 / math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
        m = points.magnitude[k]
        row, _, _ = nearest_stars(
            *(index.cell_place, index.face, index.cell_start, index.cell_rows),
            *(p0 * norm, p1 * norm, p2 * norm, gate[k]),
            *(m - gate_mag, faintest_star(limit_mag, m, gate_mag)),
        )
        counters[WORK] += 2
        if row >= 0 and row != a and row != b:
            match[k] = row
            hits += 1
    match[plan.i], match[plan.j] = a, b
    return hits


@njit(nogil=True)
def defer(workspace, i, j, a, b, near):  # type: ignore[no-untyped-def]
    """Store a weak candidate for later: stars a and b for points i and j, and a mask of others."""
    deferred, counters = deferred_in(workspace), counters_in(workspace)
    at = counters[DEFERRED]
    deferred[at, PAIR] = i * MOST_POINTS + j
    deferred[at, STAR_I], deferred[at, STAR_J], deferred[at, NEAR] = a, b, near
    counters[DEFERRED] += 1


@njit(nogil=True, forceinline=True)
def try_deferred(points, index, field, gate_mag, further, workspace):  # type: ignore[no-untyped-def]
    """Test the deferred candidates in their order; returns the state of the search."""
    prefilter, counters, deferred = (
        prefilter_in(workspace),
        counters_in(workspace),
        deferred_in(workspace),
    )
    beyond = point_pairs_in(workspace).beyond
    last_i = last_j = np.int64(-1)
    prefiltered = 0
    for at in range(counters[DEFERRED]):
        pair = np.int64(deferred[at, PAIR])
        i, j = pair // MOST_POINTS, pair % MOST_POINTS
        a, b = np.int64(deferred[at, STAR_I]), np.int64(deferred[at, STAR_J])
        near = np.int64(deferred[at, NEAR])
        if i != last_i or j != last_j:
            prefiltered = predict(points, beyond, i, j, BITMAP_RADII_RAD[-1], prefilter)
            prefiltered = min(prefiltered, MAX_PREFILTERED)
            last_i, last_j = i, j
        plan = Plan(
            i, j, prefiltered, 0, 0, further, strong_of(further, prefiltered), GATE, gate_mag
        )
        if hits_of(points, index, gate_mag, plan, a, b, near, workspace) < further:
            continue
        if weigh(points, index, field, gate_mag, i, j, workspace):
            return ACCEPTED
        if counters[WORK] > counters[LIMIT]:
            return AT_BOUND
    return GOING_ON


@njit(nogil=True)
def weigh(points, index, field, gate_mag, i, j, workspace):  # type: ignore[no-untyped-def]
    """Refine a candidate and enter it in the ledger; true if it is beyond doubt."""
    candidate, ledger, counters = (
        candidate_in(workspace),
        ledger_in(workspace),
        counters_in(workspace),
    )
    match, stars = candidate.match, index.stars
    counters[WORK] += REFINE_WORK
    for h in range(counters[COUNT]):
        if ledger.match[h, i] == match[i] and ledger.match[h, j] == match[j]:
            return False
    triad(
        *(points.observed[i], points.observed[j]),
        *(stars[match[i], :3], stars[match[j], :3], candidate.t),
    )
    matched, weight = refine(points, index, field, gate_mag, candidate)
    if matched < 3 or weight < 0.0:
        return False
    counters[COUNT] = enter(candidate, weight, ledger, counters[COUNT])
    counters[BEST] = max(counters[BEST], matched)
    return weight > ACCEPT_LOG + ACCEPT_LOG_PER_CLUTTER * (len(match) - matched)


@njit(nogil=True)
def enter(candidate, weight, ledger, count):  # type: ignore[no-untyped-def]
    """Enter a match in the ledger, replacing the lightest if full; returns the count."""
    match, weights = candidate.match, ledger.weight
    for h in range(count):
        same = True
        for k in range(len(match)):
            if ledger.match[h, k] != match[k]:
                same = False
                break
        if same:
            return count
    at = count
    if count == len(weights):
        at = np.argmin(weights)
        if weights[at] >= weight:
            return count
    copy_rows(match, ledger.match[at])
    weights[at] = weight
    copy_rows(candidate.t, ledger.attitude[at])
    copy_rows(candidate.covariance, ledger.covariance[at])
    return max(count, at + 1)
