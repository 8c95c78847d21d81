"""The hypotheses of two stars alone, weighed where no larger one settles the matter."""

import math

import numpy as np

from service.identify import evidence
from service.identify.evidence import PRIOR_ROTATION
from service.identify.fitting import most_log, weigh
from service.identify.hypotheses import NEGLIGIBLE, keep, known, log_sum
from service.identify.scene import polar_difference, within
from service.sky.pairs import separation_rad
from service.uncounted import borrowing

MAX_WORK = 20_000_000
"""Stars looked up and fitted, at most, for one tracker: a second or two."""


@borrowing
def two_stars(  # type: ignore[no-untyped-def]
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
):
    """The hypotheses of two stars alone, where no larger one outweighs what chance can do."""
    observed, axis, direction = seen.observed, seen.prior_axis, stars.direction
    by_rotation = seen.prior_kind == PRIOR_ROTATION
    by_difference = not by_rotation and len(pairs.polar_difference) > 0
    s = len(seeds)
    match = scratch.match
    top = rest
    for h in range(count):
        top = max(top, log_weight[h])
    for x in range(s):
        for y in range(x + 1, s):
            i, j = seeds[x], seeds[y]
            sine = math.sin(separation_rad(observed[i], observed[j]))
            if sine <= 0.0:
                continue
            compared = 0
            for k in (i, j):
                if not np.isnan(seen.magnitude[k]):
                    compared += 1
            # At no shift; that of a candidate takes the prior's place.
            most = (
                most_log(seen, stars, 2, compared)
                - evidence.LOG_PRIOR_AT_BEST[seen.prior_kind]
                - math.log(sine)
            )
            farthest = _farthest(top - NEGLIGIBLE - most, seen.prior_kind)
            polar_i, polar_j = separation_rad(observed[i], axis), separation_rad(observed[j], axis)
            polar = tolerance = 0.0
            if by_difference:
                polar, tolerance = polar_difference(seen, i, j, farthest + pairs.off_axis)
            for c in range(first_pair[x, y], last_pair[x, y]):
                work += 1
                if work >= MAX_WORK:
                    return count, rest, work, True
                for swap in range(2):
                    if by_difference:
                        difference = pairs.polar_difference[c]
                        if abs((-difference if swap else difference) - polar) > tolerance:
                            continue
                    a, b = pairs.brighter[c], pairs.dimmer[c]
                    if swap == 1:
                        a, b = b, a
                    if by_rotation:
                        # No rotation moves a star farther than its own angle.
                        shift = max(
                            separation_rad(observed[i], direction[a]),
                            separation_rad(observed[j], direction[b]),
                        )
                    else:
                        shift = max(
                            abs(polar_i - separation_rad(direction[a], axis)),
                            abs(polar_j - separation_rad(direction[b], axis)),
                        )
                    if shift > farthest or not (within(a, stars) and within(b, stars)):
                        continue
                    match[:] = -1
                    match[i], match[j] = a, b
                    if known(match, ledger, count, scratch.table):
                        continue
                    value = weigh(seen, stars, match, scratch)
                    if value < top - NEGLIGIBLE:
                        rest = log_sum(rest, value)
                        continue
                    count, rest = keep(
                        match,
                        value,
                        ledger,
                        log_weight,
                        count,
                        rest,
                        scratch.table,
                        scratch.range_kept,
                        scratch.leader,
                    )
                    if value > top:
                        top = value
                        farthest = _farthest(top - NEGLIGIBLE - most, seen.prior_kind)
    return count, rest, work, False


@borrowing
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
