"""The hypotheses of two stars alone, weighed where no larger one settles the matter."""

import math

import numpy as np
from numba import njit

from service.identify import evidence
from service.identify.evidence import PRIOR_ROTATION
from service.identify.fitting import most_log, weigh
from service.identify.hypotheses import NEGLIGIBLE, keep, known, log_sum
from service.identify.scene import within
from service.sky.pairs import separation_rad

MAX_WORK = 20_000_000
"""Stars looked up and fitted, at most, for one tracker: a second or two."""


@njit(cache=True, nogil=True)
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
    observed, axis = seen.observed, seen.prior_axis
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
            for c in range(first_pair[x, y], last_pair[x, y]):
                work += 1
                if work >= MAX_WORK:
                    return count, rest, work, True
                for swap in range(2):
                    a, b = pairs.brighter[c], pairs.dimmer[c]
                    if swap == 1:
                        a, b = b, a
                    if seen.prior_kind == PRIOR_ROTATION:
                        # No rotation moves a star farther than its own angle.
                        shift = max(
                            separation_rad(observed[i], stars.direction[a]),
                            separation_rad(observed[j], stars.direction[b]),
                        )
                    else:
                        shift = max(
                            abs(
                                separation_rad(observed[i], axis)
                                - separation_rad(stars.direction[a], axis)
                            ),
                            abs(
                                separation_rad(observed[j], axis)
                                - separation_rad(stars.direction[b], axis)
                            ),
                        )
                    if most + evidence.log_prior(shift, seen.prior_kind) < top - NEGLIGIBLE:
                        continue
                    if not within(a, stars) or not within(b, stars):
                        continue
                    match[:] = -1
                    match[i], match[j] = a, b
                    if known(match, ledger, count):
                        continue
                    value = weigh(seen, stars, match, scratch)
                    if value < top - NEGLIGIBLE:
                        rest = log_sum(rest, value)
                    else:
                        count, rest = keep(match, value, ledger, log_weight, count, rest)
                        top = max(top, value)
    return count, rest, work, False
