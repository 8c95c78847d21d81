"""The search: pairs in the order of their cost, candidates filtered by bitmap and by exact place.

Those that survive are refined to an attitude and weighed.  The search ends with the
first attitude that is beyond doubt, else when all pairs are tried or the bound
on the work is reached.
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
"""Brightest points that make the first pairs of a field of many; later pairs take `MOST_POINTS`."""
FIRST_TRIES = 3
"""Pairs tried for being cheap, before those that every attitude must have one of."""
NARROW_GATE, NARROW_MAG = 2.8, 0.75
"""First tries look less far: sigmas of a separation, and a share of the gate of magnitudes.
One in fifty true pairs is missed for half the work.  Of few points all is tried again in full."""
FEW_POINTS, MOST_FIRST = 6, 4
"""Up to `FEW_POINTS` points, a candidate is first compared with all others; beyond, with three."""
PREFILTERED_IN_TURN = 6
"""Points of which three at a time are the first that a candidate is held against.
Later all are: the most telling are bright, and the bright ones may all be no stars."""
MAX_PREFILTERED = 12
"""Further points that a candidate is held against."""
REFINE_WORK = 60
"""What refining a candidate costs, in candidates."""
MAX_WORK = 600_000
"""Candidates, at most: some 30 ms."""
ACCEPT_LOG = 7.5
ACCEPT_LOG_PER_CLUTTER = 0.5
"""Log evidence, and more for every point left unexplained, that ends the search."""
SAME_ATTITUDE_RAD = 2e-3


WORK, COUNT, DEFERRED, BEST, LIMIT = 0, 1, 2, 3, 4
"""The counters: candidates looked at, ledger entries, deferred candidates, most stars matched,
and the candidates that may be looked at."""
PAIR, STAR_I, STAR_J, NEAR = 0, 1, 2, 3
"""Columns of a deferred candidate: its points as i * MOST_POINTS + j, their stars, and a bit for
each further point that may have a star."""
GOING_ON, ACCEPTED, AT_BOUND = 0, 1, 2


class Plan(NamedTuple):
    """How the candidates of a pair of points (i, j) are tried.

    At least `needed` of the `firsts` points in `turn` must possibly have a star,
    at least `further` of the first `prefiltered` in `order` must have one; `strong` are
    enough to be refined at once.  `gate` is for the separation in sigmas,
    `gate_mag` for the magnitudes.
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
    """Fill the ledger with weighed matches.

    Returns how many there are, the work done and whether it reached its bound; no
    work where even a perfect match would not be believed.
    """
    n = len(points.observed)
    gate_mag = magnitude_gate(field.magnitude_sigma)
    counters, pairs, prefilter = (
        counters_in(workspace),
        point_pairs_in(workspace),
        prefilter_in(workspace),
    )
    counters[:] = 0
    # Ranks that no point has are worked out too, in vain.
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
            # Any attitude that explains so many points has two of them in one of so many groups;
            # of few points pairs that share none will do.
            groups = max(further + 1, counters[BEST] - 1)
            if n <= 2 * groups:
                groups = 0
            elif tries < FIRST_TRIES:
                groups = 1
            elif done < most:
                break
            i, j = cheapest_pair(pairs, top, groups)
            if narrow_tries > 0 and (i < 0 or tries == narrow_tries):
                # Of few points every pair is needed: now all that count, in full.
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
            # A poor lever does not reach all points: others must try again.
            pairs.covered[i] = pairs.covered[j] = pairs.covered[i] or prefiltered == n - 2
            may_be_narrow = tries <= (narrow_tries if n <= FEW_POINTS else FIRST_TRIES)
            plan = plan_of(n, i, j, prefiltered, tries, may_be_narrow, further, gate_mag, prefilter)
            state = try_pair(points, index, field, gate_mag, plan, workspace)
    if state == GOING_ON:
        state = try_deferred(points, index, field, gate_mag, further, workspace)
    return counters[COUNT], counters[WORK], state == AT_BOUND


@njit(nogil=True)
def strong_of(further, prefiltered):  # type: ignore[no-untyped-def]
    """How many further points make a candidate worth refining before others."""
    return min(further + 2, (3 * prefiltered + 3) // 4)


@njit(nogil=True)
def plan_of(n, i, j, prefiltered, tries, may_be_narrow, further, gate_mag, prefilter):  # type: ignore[no-untyped-def]
    """How a pair's candidates are tried; which ranks are asked first goes to `prefilter.turn`."""
    prefiltered = min(prefiltered, MAX_PREFILTERED)
    narrow = prefiltered >= 2 and may_be_narrow
    # Other points every time: those that tell most may be no stars.  Of few points all.
    if narrow and (tries == 1 or n <= FEW_POINTS):
        firsts = needed = 2
    elif n <= FEW_POINTS:
        firsts, needed = prefiltered, further
    elif tries <= FIRST_TRIES:
        firsts, needed = min(prefiltered, 3), min(prefiltered, 2)
    else:
        # Where half of the points are no stars, two of three is too much to ask.
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
    """Try every star pair that a pair of points may be; whether the search goes on."""
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
    # So many of the points asked first that one of them must have a star.
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
    """How many bits are set."""
    count = 0
    while bits:
        bits &= bits - 1
        count += 1
    return count


@njit(nogil=True, error_model="numpy", forceinline=True)
def hits_of(points, index, gate_mag, plan, a, b, near, workspace):  # type: ignore[no-untyped-def]
    """How many further points have a star in their place where i and j are a and b.

    Of those that may, one by one until they are `strong`, or cannot be enough
    any more; their stars go to the candidate's match.
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
    """Put off the candidate in which points i and j are stars a and b, with what is near."""
    deferred, counters = deferred_in(workspace), counters_in(workspace)
    at = counters[DEFERRED]
    deferred[at, PAIR] = i * MOST_POINTS + j
    deferred[at, STAR_I], deferred[at, STAR_J], deferred[at, NEAR] = a, b, near
    counters[DEFERRED] += 1


@njit(nogil=True, forceinline=True)
def try_deferred(points, index, field, gate_mag, further, workspace):  # type: ignore[no-untyped-def]
    """Try the candidates that were put off, in their order; whether the search goes on."""
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
    """Refine the candidate and enter it in the ledger; whether it is beyond doubt."""
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
    """Enter a match in the ledger, for the lightest where it is full; how many there are."""
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
