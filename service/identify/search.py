"""The search for hypotheses: which stars these could be, all together.

Every candidate pair of an observed pair predicts every other star; what it
predicts well becomes a hypothesis and is weighed (see `evidence`).  Pairs are
not gated by steps 1 to 10: the prior and the magnitudes weigh, they do not
reject.

Pairs are scanned so that single stars grow into groups, the cheapest cross
pairs first.  With g groups left, a hypothesis that was not seen matches at most
one star of each, g in all: at two groups all those of three stars are seen.
"""

import math

import numpy as np
from numba import njit

from service.identify import evidence
from service.identify.hypotheses import LARGEST_GATE_RAD, consider, known
from service.identify.scene import log_density, nearest, within
from service.identify.two_stars import MAX_WORK, two_stars
from service.sky.pairs import separation_rad

MAX_SEEDS = 12
"""Pairs of at most so many stars, the brightest, are scanned; all are matched."""
PREDICTION_GATE = 20.0
"""In sigmas: how far a star may lie from where a pair of others puts it."""
SHORT_PAIR_RAD = math.radians(0.35)
CHANCE_PER_STAR, CHANCE_MARGIN = math.log(3.0), 12.0
"""Stop early once a hypothesis of three stars or more outweighs the null by 3^n e^12.

Only after a whole observed pair: the stars of an empty sky may stand so evenly
that a half turn matches four of them, and it is found first as often as not.
"""


@njit(cache=True, nogil=True, error_model="numpy")
def search(seen, stars, pairs, exhaustive, ledger, log_weight):  # type: ignore[no-untyped-def]
    """Search and weigh: the number of hypotheses, the rest, the work, whether it was bounded."""
    n = len(seen.observed)
    density = log_density(stars)
    with_magnitude = n - np.isnan(seen.magnitude).sum()
    rest = evidence.log_null(n, with_magnitude)
    enough = rest + n * CHANCE_PER_STAR + CHANCE_MARGIN
    best = -math.inf
    count = work = 0
    seeds = _seeds(seen.magnitude)
    s = len(seeds)
    first_pair, last_pair, separation = _candidates(seen, seeds, pairs)
    group = np.arange(s)
    for _ in range(s - 2):
        left, right = _cheapest(group, first_pair, last_pair, separation)
        for x in range(s):
            for y in range(x + 1, s):
                joins = (group[x] == left and group[y] == right) or (
                    group[x] == right and group[y] == left
                )
                if not joins or first_pair[x, y] >= last_pair[x, y]:
                    continue
                before = count
                count, rest, work = _scan(
                    seen,
                    stars,
                    pairs,
                    density,
                    seeds[x],
                    seeds[y],
                    first_pair[x, y],
                    last_pair[x, y],
                    ledger,
                    log_weight,
                    count,
                    rest,
                    work,
                )
                best = max(best, log_weight[before:count].max() if count > before else best)
                if best > enough and not exhaustive:
                    return count, rest, work, False
                if work >= MAX_WORK:
                    return count, rest, work, True
        for x in range(s):
            if group[x] == right:
                group[x] = left
    if best > enough:
        return count, rest, work, False
    return two_stars(
        seen,
        stars,
        pairs,
        density,
        seeds,
        first_pair,
        last_pair,
        ledger,
        log_weight,
        count,
        rest,
        work,
    )


@njit(cache=True, nogil=True, error_model="numpy")
def _scan(  # type: ignore[no-untyped-def]
    seen, stars, pairs, density, i, j, first, last, ledger, log_weight, count, rest, work
):
    """Try every candidate pair in the place of observed stars i and j, either way round."""
    n = len(seen.observed)
    match = np.full(n, -1, np.int32)
    used = np.full(n, -1, np.int32)
    found, p = np.empty(2, np.int32), np.empty(3)
    order, parts, gate, others = _predictors(seen, i, j)
    for c in range(first, last):
        work += others
        for swap in range(2):
            a, b = pairs.brighter[c], pairs.dimmer[c]
            if swap == 1:
                a, b = b, a
            u, v = stars.direction[a], stars.direction[b]
            w0 = u[1] * v[2] - u[2] * v[1]
            w1 = u[2] * v[0] - u[0] * v[2]
            w2 = u[0] * v[1] - u[1] * v[0]
            match[:] = -1
            match[i], match[j] = a, b
            used[0], used[1] = a, b
            matched = 2
            for k in order[:others]:
                alpha, beta, gamma = parts[k]
                p[0] = alpha * u[0] + beta * v[0] + gamma * w0
                p[1] = alpha * u[1] + beta * v[1] + gamma * w1
                p[2] = alpha * u[2] + beta * v[2] + gamma * w2
                nearest(p, gate[k], stars, used[:matched], found)
                if found[0] >= 0 and within(found[0], stars):
                    match[k] = found[0]
                    used[matched] = found[0]
                    matched += 1
            if matched < 3 or not (within(a, stars) and within(b, stars)):
                continue
            if known(match, ledger, count):
                continue
            count, rest = consider(seen, stars, density, match, ledger, log_weight, count, rest)
            work += n * n
        if work >= MAX_WORK:
            break
    return count, rest, work


@njit(cache=True, nogil=True)
def _seeds(magnitude):  # type: ignore[no-untyped-def]
    """The stars whose pairs are scanned: all, or the brightest; those without a magnitude last."""
    ranked = np.argsort(np.where(np.isnan(magnitude), 99.0, magnitude), kind="mergesort")
    return np.sort(ranked[:MAX_SEEDS])


@njit(cache=True, nogil=True)
def _candidates(seen, seeds, pairs):  # type: ignore[no-untyped-def]
    """Per pair of seeds the range of candidate pairs by separation, and the separation."""
    s = len(seeds)
    first = np.zeros((s, s), np.int64)
    last = np.zeros((s, s), np.int64)
    separation = np.zeros((s, s))
    for x in range(s):
        for y in range(x + 1, s):
            i, j = seeds[x], seeds[y]
            angle = separation_rad(seen.observed[i], seen.observed[j])
            gate = PREDICTION_GATE * math.sqrt(seen.sigma_rad[i] ** 2 + seen.sigma_rad[j] ** 2)
            first[x, y] = _first_at(angle - gate, pairs)
            last[x, y] = _first_at(angle + gate, pairs)
            separation[x, y] = angle
    return first, last, separation


@njit(cache=True, nogil=True)
def _first_at(angle, pairs):  # type: ignore[no-untyped-def]
    """The first pair not closer than an angle."""
    k = min(max(int(angle * pairs.bins_per_rad), 0), len(pairs.bin_start) - 1)
    at = pairs.bin_start[k]
    while at > 0 and pairs.separation[at - 1] >= angle:
        at -= 1
    while at < len(pairs.separation) and pairs.separation[at] < angle:
        at += 1
    return at


@njit(cache=True, nogil=True)
def _cheapest(group, first, last, separation):  # type: ignore[no-untyped-def]
    """The two groups whose cross pairs cost least to scan.

    Short pairs predict badly and cost more than their number.
    """
    s = len(group)
    cost = np.full((s, s), -1.0)
    for x in range(s):
        for y in range(x + 1, s):
            low, high = min(group[x], group[y]), max(group[x], group[y])
            if low == high:
                continue
            if cost[low, high] < 0.0:
                cost[low, high] = 0.0
            apart = max(separation[x, y], 1e-6)
            cost[low, high] += (last[x, y] - first[x, y]) * (1.0 + (SHORT_PAIR_RAD / apart) ** 2)
    left = right = -1
    least = math.inf
    for low in range(s):
        for high in range(low + 1, s):
            if 0.0 <= cost[low, high] < least:
                least, left, right = cost[low, high], low, high
    return left, right


@njit(cache=True, nogil=True)
def _predictors(seen, i, j):  # type: ignore[no-untyped-def]
    """Write every other star as alpha V_i + beta V_j + gamma V_i x V_j, the best fixed first.

    A catalog pair (a, b) in the place of (i, j) then puts it at
    alpha a + beta b + gamma a x b, without an attitude.
    """
    observed, sigma_rad = seen.observed, seen.sigma_rad
    n = len(observed)
    order, parts, gate = np.empty(n, np.int64), np.empty((n, 3)), np.empty(n)
    vi, vj = observed[i], observed[j]
    cosine = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
    c0 = vi[1] * vj[2] - vi[2] * vj[1]
    c1 = vi[2] * vj[0] - vi[0] * vj[2]
    c2 = vi[0] * vj[1] - vi[1] * vj[0]
    sine2 = c0 * c0 + c1 * c1 + c2 * c2
    others = 0
    if sine2 <= 0.0:
        return order, parts, gate, others
    for k in range(n):
        if k in (i, j):
            continue
        v = observed[k]
        di = v[0] * vi[0] + v[1] * vi[1] + v[2] * vi[2]
        dj = v[0] * vj[0] + v[1] * vj[1] + v[2] * vj[2]
        alpha = (di - cosine * dj) / sine2
        beta = (dj - cosine * di) / sine2
        gamma = (v[0] * c0 + v[1] * c1 + v[2] * c2) / sine2
        parts[k] = alpha, beta, gamma
        spread = (
            sigma_rad[k] ** 2
            + (alpha**2 + gamma**2) * sigma_rad[i] ** 2
            + (beta**2 + gamma**2) * sigma_rad[j] ** 2
        )
        gate[k] = min(PREDICTION_GATE * math.sqrt(spread), LARGEST_GATE_RAD)
        at = others
        while at > 0 and gate[order[at - 1]] > gate[k]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
        others += 1
    return order, parts, gate, others
