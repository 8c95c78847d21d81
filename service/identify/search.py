"""The search for hypotheses: which stars these could be, all together.

Every candidate pair of an observed pair predicts every other star; what it
predicts well becomes a hypothesis and is weighed (see `evidence`).  Pairs are
not gated by steps 1 to 10: the prior and the magnitudes weigh, they do not
reject.

Pairs are scanned so that single stars grow into groups, the cheapest cross
pairs first.  A hypothesis with two stars of one group has been seen when the
group grew together.  So a scan looks only for stars of other groups, and with
g groups left what was not seen matches at most one star of each, g in all: at
two groups all those of three stars are seen.
"""

import math

import numpy as np
from numba import njit

from service.identify import evidence
from service.identify.hypotheses import leaves_a_group, log_sum
from service.identify.scan import most_of, scan
from service.identify.scene import MAX_SEEDS, PREDICTION_GATE, scratch_for, with_magnitude
from service.identify.two_stars import MAX_WORK, two_stars
from service.sky.pairs import separation_rad
from service.uncounted import borrowing, owning

SHORT_PAIR_RAD = math.radians(0.35)
CHANCE_PER_STAR, CHANCE_MARGIN = math.log(3.0), 12.0
"""Stop early once a hypothesis of three stars or more outweighs the null by 3^n e^12.

Only after a whole observed pair: the stars of an empty sky may stand so evenly
that a half turn matches four of them, and it is found first as often as not.
And only where it leaves so few stars unexplained that no other attitude can
explain them: see `leaves_a_group`.
"""
SETTLED = 10.0
"""Exhaustive, stop once all that was not seen is lighter than the best by this, in logarithms."""


@njit(cache=True, nogil=True, error_model="numpy")
def search(seen, stars, pairs, exhaustive, ledger, log_weight):  # type: ignore[no-untyped-def]
    """Search and weigh: the number of hypotheses, the rest, the work, whether it was bounded."""
    scratch = scratch_for(len(seen.observed))
    return search_in(scratch, seen, stars, pairs, exhaustive, ledger, log_weight)


@borrowing
def search_in(scratch, seen, stars, pairs, exhaustive, ledger, log_weight):  # type: ignore[no-untyped-def]
    """As `search`, in the arrays of `scratch_for`, which a caller with many views makes once."""
    n = len(seen.observed)
    scratch.most[:] = np.nan
    scratch.range_kept[:] = -math.inf
    scratch.leader[:] = -1
    rest = evidence.log_null(n, with_magnitude(seen))
    enough = rest + n * CHANCE_PER_STAR + CHANCE_MARGIN
    best = -math.inf
    # No plain zeros: numba would compile all below for those constants as well.
    count = work = 0 * n
    seeds, group, group_of = scratch.seeds, scratch.group, scratch.group_of
    first_pair, last_pair, separation = scratch.first_pair, scratch.last_pair, scratch.separation
    s = len(seeds)
    _choose_seeds(seen.magnitude, seeds)
    _candidates(seen, seeds, pairs, first_pair, last_pair, separation)
    # By observed star; those that are no seeds are each by themselves.
    for k in range(n):
        group_of[k] = s + k
    for x in range(s):
        group[x] = x
        group_of[seeds[x]] = x
    for groups in range(s, 2, -1):
        left, right = _cheapest(group, first_pair, last_pair, separation, scratch.cost)
        for x in range(s):
            for y in range(x + 1, s):
                joins = (group[x] == left and group[y] == right) or (
                    group[x] == right and group[y] == left
                )
                if not joins or first_pair[x, y] >= last_pair[x, y]:
                    continue
                count, rest, best, work = scan(
                    seen,
                    stars,
                    pairs,
                    group_of,
                    seeds[x],
                    seeds[y],
                    first_pair[x, y],
                    last_pair[x, y],
                    math.inf if exhaustive else enough,
                    scratch,
                    ledger,
                    log_weight,
                    count,
                    rest,
                    best,
                    work,
                )
                if best > enough and not (exhaustive or leaves_a_group(scratch.leader)):
                    return count, rest, work, False
                if work >= MAX_WORK:
                    return count, rest, work, True
        for x in range(s):
            if group[x] == right:
                group[x] = left
                group_of[seeds[x]] = left
        if best > enough:
            unseen = _most_unseen(
                seen, stars, groups - 1, group, first_pair, last_pair, separation, scratch
            )
            if unseen < best - SETTLED:
                return count, log_sum(rest, unseen), work, False
    if best > enough:
        return count, rest, work, False
    return two_stars(
        seen,
        stars,
        pairs,
        scratch,
        seeds,
        first_pair,
        last_pair,
        ledger,
        log_weight,
        count,
        rest,
        work,
    )


@borrowing
def _most_unseen(  # type: ignore[no-untyped-def]
    seen, stars, groups, group, first_pair, last_pair, separation, scratch
):
    """What all hypotheses can weigh that have at most one star of each group.

    Each holds a candidate of a pair across groups, either way round; a third
    star that it predicts is rarely more than one.
    """
    s = len(group)
    candidates = 0
    least = math.pi
    for x in range(s):
        for y in range(x + 1, s):
            if group[x] != group[y]:
                candidates += 2 * (last_pair[x, y] - first_pair[x, y])
                least = min(least, separation[x, y])
    sine = math.sin(least)
    if sine <= 0.0:
        return math.inf
    count = groups + len(seen.observed) - s
    return most_of(count, seen, stars, scratch.most) - math.log(sine) + math.log(max(candidates, 1))


@owning
def _choose_seeds(magnitude, seeds):  # type: ignore[no-untyped-def]
    """The stars whose pairs are scanned: all, or the brightest; those without a magnitude last."""
    if len(magnitude) <= MAX_SEEDS:
        for x in range(len(seeds)):
            seeds[x] = x
        return
    ranked = np.argsort(np.where(np.isnan(magnitude), 99.0, magnitude), kind="mergesort")
    seeds[:] = np.sort(ranked[:MAX_SEEDS])


@borrowing
def _candidates(seen, seeds, pairs, first, last, separation):  # type: ignore[no-untyped-def]
    """Per pair of seeds the range of candidate pairs by separation, and the separation."""
    s = len(seeds)
    for x in range(s):
        for y in range(x + 1, s):
            i, j = seeds[x], seeds[y]
            angle = separation_rad(seen.observed[i], seen.observed[j])
            gate = PREDICTION_GATE * math.sqrt(seen.sigma_rad[i] ** 2 + seen.sigma_rad[j] ** 2)
            first[x, y] = _first_at(angle - gate, pairs)
            last[x, y] = _first_at(angle + gate, pairs)
            separation[x, y] = angle


@borrowing
def _first_at(angle, pairs):  # type: ignore[no-untyped-def]
    """The first pair not closer than an angle."""
    k = min(max(int(angle * pairs.bins_per_rad), 0), len(pairs.bin_start) - 1)
    at = pairs.bin_start[k]
    while at > 0 and pairs.separation[at - 1] >= angle:
        at -= 1
    while at < len(pairs.separation) and pairs.separation[at] < angle:
        at += 1
    return at


@borrowing
def _cheapest(group, first, last, separation, cost):  # type: ignore[no-untyped-def]
    """The two groups whose cross pairs cost least to scan.

    Short pairs predict badly and cost more than their number.
    """
    s = len(group)
    cost[:] = -1.0
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
