"""The hypotheses of two stars alone, weighed where no larger one settles the matter."""

import math

import numpy as np
from numba import njit

from service.identify import evidence
from service.identify.evidence import PRIOR_ROTATION
from service.identify.fitting import weigh
from service.identify.hypotheses import NEGLIGIBLE, keep, known, log_sum
from service.identify.scene import within
from service.sky.pairs import separation_rad

MAX_WORK = 20_000_000
"""Stars looked up and fitted, at most, for one tracker: a second or two."""


@njit(cache=True, nogil=True)
def two_stars(  # type: ignore[no-untyped-def]
    seen, stars, pairs, density, seeds, first_pair, last_pair, ledger, log_weight, count, rest, work
):
    """The hypotheses of two stars alone, where no larger one outweighs what chance can do."""
    observed, axis = seen.observed, seen.prior_axis
    n, s = len(observed), len(seeds)
    match = np.full(n, -1, np.int32)
    t, references = np.empty((3, 3)), np.empty((n, 3))
    top = rest
    for h in range(count):
        top = max(top, log_weight[h])
    for x in range(s):
        for y in range(x + 1, s):
            i, j = seeds[x], seeds[y]
            sine = math.sin(separation_rad(observed[i], observed[j]))
            if sine <= 0.0:
                continue
            # The most that any candidate can weigh: no residual, equal magnitudes.
            compared = 0
            for k in (i, j):
                if not np.isnan(seen.magnitude[k]):
                    compared += 1
            clutter = 0
            for k in range(n):
                if k != i and k != j and not np.isnan(seen.magnitude[k]):
                    clutter += 1
            most_log = (
                evidence.log_positions(2, 0.0, math.log(sine * sine), seen.reference_sigma)
                + evidence.log_magnitudes(compared, 0.0, 0.0)
                + evidence.log_clutter(n - 2, 2)
                - clutter * math.log(evidence.CLUTTER_SPAN_MAG)
                - 2 * density
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
                    if most_log + evidence.log_prior(shift, seen.prior_kind) < top - NEGLIGIBLE:
                        continue
                    if not within(a, stars) or not within(b, stars):
                        continue
                    match[:] = -1
                    match[i], match[j] = a, b
                    if known(match, ledger, count):
                        continue
                    value = weigh(seen, stars, density, match, t, references)
                    if value < top - NEGLIGIBLE:
                        rest = log_sum(rest, value)
                    else:
                        count, rest = keep(match, value, ledger, log_weight, count, rest)
                        top = max(top, value)
    return count, rest, work, False
