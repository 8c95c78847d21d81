"""The search for hypotheses: joint identifications of all observed stars.

Every catalog pair for an observed pair predicts the other stars; good predictions become a
hypothesis, which is weighed (see `evidence`). Pairs are not gated by steps 1 to 10: the prior and
the magnitudes contribute to the weight, they do not reject.

Pairs are scanned so that single stars grow into groups, the cheapest cross pairs first. A
hypothesis with two stars of one group was found when the group was formed. So a scan looks only for
stars of other groups, and with g groups left an unseen hypothesis matches at most one star of each,
g in all: at two groups all hypotheses of three stars were seen. Hypotheses of only two stars are
weighed last, if no larger one is decisive.
"""

import math
from typing import Any, NamedTuple

import numpy as np

from service.compiled.jit import njit_no_refcount
from service.identify.hypotheses import evidence
from service.identify.hypotheses.fitting import log_weight_bound, weigh
from service.identify.hypotheses.ledger import (
    at_bound,
    clear,
    keep,
    known,
    leaves_a_group,
    left_unexplored,
    spent,
)
from service.identify.hypotheses.local_search import NEGLIGIBLE
from service.identify.hypotheses.scan_pair import scan_pair, weight_bound
from service.identify.hypotheses.scene import (
    PREDICTION_GATE,
    Progress,
    polar_difference,
    with_magnitude,
    within_bounds,
)
from service.identify.sighting import PRIOR_ROTATION
from service.sky.geometry.directions import separation_rad

SHORT_PAIR_RAD = math.radians(0.35)
CHANCE_PER_STAR, CHANCE_MARGIN = math.log(3.0), 12.0
"""Log margin over the null, 3^n e^12 for n stars, at which a search may stop early.

The search stops only after a whole observed pair: stars may be spaced so evenly that a half turn
matches four of them, and it may be found first. And it stops only if too few stars remain
unexplained for a second attitude: see `leaves_a_group`.
"""
LARGEST_LOG = 1e5
"""A finite log weight that replaces an infinite one."""
CONVERGED_LOG = 10.0
"""Log weight below the best at which all unseen hypotheses together end an exhaustive search."""


@njit_no_refcount
def search(observed, stars, pairs, exhaustive, max_work, scratch, ledger):  # type: ignore[no-untyped-def]
    """Search and weigh hypotheses into the ledger; returns the progress, and true if cut short.

    `scratch` and `ledger` are work arrays for as many stars, possibly used before. With
    `exhaustive` the search continues after a hypothesis that outweighs chance. If the search ends
    at `max_work` without a significant hypothesis, unseen ones may outweigh the rest, and count as
    unexplored.
    """
    n = len(observed.direction)
    scratch.weight_bounds[:] = np.nan
    clear(ledger)
    null = evidence.log_null(n, with_magnitude(observed))
    accept_threshold = null + n * CHANCE_PER_STAR + CHANCE_MARGIN
    # Not plain zeros: numba would compile everything again for constant types.
    progress = Progress(0 * n, null, -math.inf, 0 * n, max_work)
    seeds, group, group_of = scratch.seeds, scratch.group, scratch.group_of
    first_pair, last_pair = scratch.first_pair, scratch.last_pair
    s = len(seeds)
    _choose_seeds(observed, stars, seeds)
    _find_candidates(observed, pairs, scratch)
    # Indexed by observed star; stars that are no seeds are groups of their own.
    for k in range(n):
        group_of[k] = s + k
    for x in range(s):
        group[x] = x
        group_of[seeds[x]] = x
    for groups in range(s, 2, -1):
        left, right = _cheapest(scratch)
        for x in range(s):
            for y in range(x + 1, s):
                joins = (group[x] == left and group[y] == right) or (
                    group[x] == right and group[y] == left
                )
                if not joins or first_pair[x, y] >= last_pair[x, y]:
                    continue
                pair = ObservedPair(seeds[x], seeds[y], first_pair[x, y], last_pair[x, y])
                threshold = math.inf if exhaustive else accept_threshold
                progress = scan_pair(
                    observed, stars, pairs, pair, threshold, scratch, ledger, progress
                )
                if progress.best > accept_threshold and not (
                    exhaustive or leaves_a_group(ledger.heaviest_match)
                ):
                    return progress, False
                if at_bound(progress):
                    if progress.best <= accept_threshold:
                        unseen = _most_unseen(observed, stars, groups, scratch)
                        progress = left_unexplored(progress, min(unseen, LARGEST_LOG))
                    return progress, True
        for x in range(s):
            if group[x] == right:
                group[x] = left
                group_of[seeds[x]] = left
        if progress.best > accept_threshold:
            unseen = _most_unseen(observed, stars, groups - 1, scratch)
            if unseen < progress.best - CONVERGED_LOG:
                return left_unexplored(progress, unseen), False
    if progress.best > accept_threshold:
        return progress, False
    return weigh_pairs(observed, stars, pairs, scratch, ledger, progress)


@njit_no_refcount
def _most_unseen(observed, stars, groups, scratch):  # type: ignore[no-untyped-def]
    """An upper bound on the total weight of hypotheses with at most one star of each group.

    Each of them contains a candidate of a pair across groups, in either order; it rarely predicts
    more than one third star.
    """
    group, first_pair, last_pair = scratch.group, scratch.first_pair, scratch.last_pair
    s = len(group)
    candidates = 0
    least = math.pi
    for x in range(s):
        for y in range(x + 1, s):
            if group[x] != group[y]:
                candidates += 2 * (last_pair[x, y] - first_pair[x, y])
                least = min(least, scratch.separation[x, y])
    sine = math.sin(least)
    if sine <= 0.0:
        return math.inf
    count = groups + len(observed.direction) - s
    bound = weight_bound(count, observed, stars, scratch.weight_bounds)
    return bound - math.log(sine) + math.log(max(candidates, 1))


@njit_no_refcount
def _choose_seeds(observed, stars, seeds):  # type: ignore[no-untyped-def]
    """The stars whose pairs are scanned: all, or the brightest; unknown magnitudes last.

    Stars outside of the zone by the presumed attitude come after all others, since no zone star
    matches them. Sorted by insertion, because numba's sorts take longer to compile than the rest of
    this module.
    """
    magnitude, direction = observed.magnitude, observed.direction
    chosen = first = 0
    for inside in (True, False):
        for k in range(len(magnitude)):
            at = chosen
            if len(magnitude) > len(seeds):
                polar = separation_rad(direction[k], stars.axis)
                if (stars.least <= polar <= stars.most) != inside:
                    continue
                while at > first and _is_brighter(magnitude[k], magnitude[seeds[at - 1]]):
                    at -= 1
            if at < len(seeds):
                _insert(seeds, min(chosen, len(seeds) - 1), at, k)
                chosen = min(chosen + 1, len(seeds))
        first = chosen
    for x in range(1, len(seeds)):
        at = x
        while at > 0 and seeds[x] < seeds[at - 1]:
            at -= 1
        _insert(seeds, x, at, seeds[x])


@njit_no_refcount
def _is_brighter(one, other):  # type: ignore[no-untyped-def]
    """True if one magnitude is brighter than another; NaN counts as faintest."""
    return one < other or (math.isnan(other) and not math.isnan(one))


@njit_no_refcount
def _insert(seeds, last, at, k):  # type: ignore[no-untyped-def]
    """Insert a star into a list at an index, moving later entries up to `last` by one."""
    for x in range(last, at, -1):
        seeds[x] = seeds[x - 1]
    seeds[at] = k


@njit_no_refcount
def _find_candidates(observed, pairs, scratch):  # type: ignore[no-untyped-def]
    """Separation of each pair of seeds, and the range of catalog pairs within its tolerance."""
    seeds, direction, sigma_rad = scratch.seeds, observed.direction, observed.sigma_rad
    s = len(seeds)
    for x in range(s):
        for y in range(x + 1, s):
            i, j = seeds[x], seeds[y]
            angle = separation_rad(direction[i], direction[j])
            gate = PREDICTION_GATE * math.sqrt(sigma_rad[i] ** 2 + sigma_rad[j] ** 2)
            scratch.first_pair[x, y] = _first_at(angle - gate, pairs)
            scratch.last_pair[x, y] = _first_at(angle + gate, pairs)
            scratch.separation[x, y] = angle


@njit_no_refcount
def _first_at(angle, pairs):  # type: ignore[no-untyped-def]
    """The index of the first pair in the zone's index with at least a given separation."""
    k = min(max(int(angle * pairs.bins_per_rad), 0), len(pairs.bin_start) - 1)
    at = pairs.bin_start[k]
    while at > 0 and pairs.separation[at - 1] >= angle:
        at -= 1
    while at < len(pairs.separation) and pairs.separation[at] < angle:
        at += 1
    return at


@njit_no_refcount
def _cheapest(scratch):  # type: ignore[no-untyped-def]
    """The two groups of stars whose cross pairs cost least to scan.

    Short pairs predict inaccurately and cost more than their number of candidates.
    """
    group, separation, cost = scratch.group, scratch.separation, scratch.cost
    first, last = scratch.first_pair, scratch.last_pair
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


class ObservedPair(NamedTuple):
    """A pair of observed stars i and j, and the range of candidate pairs by their separation."""

    i: Any
    j: Any
    first: Any
    last: Any


@njit_no_refcount
def weigh_pairs(observed, stars, pairs, scratch, ledger, progress):  # type: ignore[no-untyped-def]
    """Weigh the hypotheses of only two stars; returns the progress, and true if cut short."""
    seeds = scratch.seeds
    s = len(seeds)
    top = progress.unexplored_weight
    for h in range(progress.count):
        top = max(top, ledger.log_weight[h])
    for x in range(s):
        for y in range(x + 1, s):
            pair = ObservedPair(
                seeds[x], seeds[y], scratch.first_pair[x, y], scratch.last_pair[x, y]
            )
            progress, top = _weigh_pair(
                observed, stars, pairs, pair, scratch, ledger, progress, top
            )
            if at_bound(progress):
                return progress, True
    return progress, False


@njit_no_refcount
def _weigh_pair(observed, stars, pairs, pair, scratch, ledger, progress, top):  # type: ignore[no-untyped-def]
    """Weigh the candidates of one observed pair; returns progress and largest log weight."""
    i, j, kind = pair.i, pair.j, observed.prior_kind
    sine = math.sin(separation_rad(observed.direction[i], observed.direction[j]))
    if sine <= 0.0:
        return progress, top
    by_difference = kind != PRIOR_ROTATION and len(pairs.polar_difference) > 0
    compared = 0
    for k in (i, j):
        if not np.isnan(observed.magnitude[k]):
            compared += 1
    # The bound assumes no error of the prior; a candidate's own prior replaces it.
    bound = (
        log_weight_bound(observed, stars, 2, compared)
        - evidence.LOG_PRIOR_AT_BEST[kind]
        - math.log(sine)
    )
    farthest = _farthest(top - NEGLIGIBLE - bound, kind)
    polar_i = separation_rad(observed.direction[i], observed.prior_axis)
    polar_j = separation_rad(observed.direction[j], observed.prior_axis)
    polar = tolerance = 0.0
    if by_difference:
        polar, tolerance = polar_difference(observed, i, j, farthest + pairs.off_axis)
    match = scratch.match
    for c in range(pair.first, pair.last):
        progress = spent(progress, 1)
        if at_bound(progress):
            break
        for swap in range(2):
            if by_difference:
                difference = pairs.polar_difference[c]
                if abs((-difference if swap else difference) - polar) > tolerance:
                    continue
            a, b = pairs.brighter[c], pairs.dimmer[c]
            if swap == 1:
                a, b = b, a
            shift = _shift(observed, stars, pair, polar_i, polar_j, a, b)
            if shift > farthest or not (within_bounds(a, stars) and within_bounds(b, stars)):
                continue
            match[:] = -1
            match[i], match[j] = a, b
            if known(match, ledger, progress.count):
                continue
            value = weigh(observed, stars, match, scratch)
            progress = spent(progress, 6 + len(match) // 24)
            if value < top - NEGLIGIBLE:
                progress = left_unexplored(progress, value)
                continue
            progress = keep(match, value, ledger, progress)
            if value > top:
                top = value
                farthest = _farthest(top - NEGLIGIBLE - bound, kind)
    return progress, top


@njit_no_refcount
def _shift(observed, stars, pair, polar_i, polar_j, a, b):  # type: ignore[no-untyped-def]
    """The least error of the a priori attitude if the observed pair is zone stars a and b.

    `polar_i` and `polar_j` are the angles of the observed stars to the presumed axis.
    """
    if observed.prior_kind == PRIOR_ROTATION:
        # No rotation moves a star farther than its own angle.
        return max(
            separation_rad(observed.direction[pair.i], stars.direction[a]),
            separation_rad(observed.direction[pair.j], stars.direction[b]),
        )
    return max(
        abs(polar_i - separation_rad(stars.direction[a], observed.prior_axis)),
        abs(polar_j - separation_rad(stars.direction[b], observed.prior_axis)),
    )


@njit_no_refcount
def _farthest(least, kind):  # type: ignore[no-untyped-def]
    """The largest angle, to a thousandth, at which the log prior density reaches a bound."""
    low, high = 0.0, math.pi
    if evidence.log_prior(high, kind) >= least:
        return high
    while high - low > 1e-3 * high and high > 1e-9:
        middle = 0.5 * (low + high)
        if evidence.log_prior(middle, kind) >= least:
            low = middle
        else:
            high = middle
    return high
