"""The hypotheses of two stars alone, weighed where no larger one settles the matter."""

import math
from typing import Any, NamedTuple

import numpy as np

from service.compiled.jit import njit_no_refcount
from service.identify.hypotheses import evidence
from service.identify.hypotheses.fitting import log_weight_bound, weigh
from service.identify.hypotheses.ledger import at_bound, keep, known, left_unexplored, spent
from service.identify.hypotheses.local_search import NEGLIGIBLE
from service.identify.hypotheses.scene import polar_difference, within_bounds
from service.identify.sighting import PRIOR_ROTATION
from service.sky.geometry.directions import separation_rad


class ObservedPair(NamedTuple):
    """Observed stars i and j, and the range of candidate pairs by their separation."""

    i: Any
    j: Any
    first: Any
    last: Any


@njit_no_refcount
def weigh_pairs(observed, stars, pairs, scratch, ledger, progress):  # type: ignore[no-untyped-def]
    """Weigh the hypotheses of two stars alone; the progress, and whether it was bounded."""
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
    """Weigh the candidates of one observed pair; the progress, and the heaviest of all."""
    i, j, kind = pair.i, pair.j, observed.prior_kind
    sine = math.sin(separation_rad(observed.direction[i], observed.direction[j]))
    if sine <= 0.0:
        return progress, top
    by_difference = kind != PRIOR_ROTATION and len(pairs.polar_difference) > 0
    compared = 0
    for k in (i, j):
        if not np.isnan(observed.magnitude[k]):
            compared += 1
    # At no shift; that of a candidate takes the prior's place.
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
    """The least angle by which the prior is off where the observed pair is stars a and b.

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
    """The largest angle, to a thousandth, at which the prior's logarithm reaches so much."""
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
