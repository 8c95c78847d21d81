"""Prediction of the places of all other points from one pair of points, without an attitude.

Every other point is b_k = alpha b_i + beta b_j + gamma (b_i x b_j). With stars r_a and r_b for i
and j the same coefficients give the point's place in the sky. The sign of gamma excludes a mirrored
sky.
"""

import math

from service.compiled.jit import njit

GATE = 3.6
"""Largest distance of a star from its prediction, and of a pair from its separation, in sigmas."""
SLACK_RAD = 2e-5
"""Largest change of a separation of 8 degrees by aberration in radians, 4 arcsec."""
RANK_WEIGHT = 0.04
"""Relative increase of a point's cost per rank: faint points are less likely index stars."""


BEYOND, DEEP_COST = 0.02, 1.5
"""Probability of a star beyond the limit from which a point counts as less useful; cost factor."""


@njit(nogil=True, error_model="numpy")
def predict(points, beyond, i, j, largest, prefilter):  # type: ignore[no-untyped-def]
    """Compute how a pair of points predicts the others, and sort the others by information.

    The results go into `prefilter`. `beyond` (n,) is each point's probability to be a star beyond
    the limit. Returns the number of points with a gate of at most `largest`.
    """
    observed, sigma = points.observed, points.sigma
    coefficients, gate, order, cost = (
        prefilter.coefficients,
        prefilter.gate,
        prefilter.order,
        prefilter.cost,
    )
    n = len(observed)
    i0, i1, i2 = observed[i, 0], observed[i, 1], observed[i, 2]
    j0, j1, j2 = observed[j, 0], observed[j, 1], observed[j, 2]
    cosine = i0 * j0 + i1 * j1 + i2 * j2
    c0, c1, c2 = i1 * j2 - i2 * j1, i2 * j0 - i0 * j2, i0 * j1 - i1 * j0
    per_sine2 = 1.0 / (c0 * c0 + c1 * c1 + c2 * c2)
    vi, vj = sigma[i] * sigma[i], sigma[j] * sigma[j]
    count = 0
    for k in range(n):
        if k in (i, j):
            continue
        k0, k1, k2 = observed[k, 0], observed[k, 1], observed[k, 2]
        di = k0 * i0 + k1 * i1 + k2 * i2
        dj = k0 * j0 + k1 * j1 + k2 * j2
        alpha = (di - cosine * dj) * per_sine2
        beta = (dj - cosine * di) * per_sine2
        gamma = (k0 * c0 + k1 * c1 + k2 * c2) * per_sine2
        coefficients[k, 0], coefficients[k, 1], coefficients[k, 2] = alpha, beta, gamma
        spread = (
            sigma[k] * sigma[k]
            + (alpha * alpha + gamma * gamma) * vi
            + (beta * beta + gamma * gamma) * vj
        )
        gate[k] = GATE * math.sqrt(spread) + SLACK_RAD
        if gate[k] > largest:
            continue
        cost[k] = (gate[k] + 1e-3) * (1.0 + RANK_WEIGHT * k)
        if beyond[k] > BEYOND:
            cost[k] *= DEEP_COST
        at = count
        while at > 0 and cost[order[at - 1]] > cost[k]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
        count += 1
    return count
