"""From one pair of points the places of all others, without an attitude.

Every other point is b_k = alpha b_i + beta b_j + gamma (b_i x b_j).  With the
stars r_a and r_b in the place of i and j the same coefficients give its place
in the sky.  Handedness is in gamma: a mirrored sky is never predicted.
"""

import math

from service.compiled.jit import njit

GATE = 3.6
"""In sigmas: how far a star may lie from its prediction, and a pair from its separation."""
SLACK_RAD = 2e-5
"""Aberration changes a separation of 8 degrees by as much as this, 4 arcsec."""
RANK_WEIGHT = 0.04
"""A faint point is less sure to be a star of the index: what each rank adds to its gate's cost."""


BEYOND, DEEP_COST = 0.02, 1.5
"""A point likelier than this to be a star beyond the limit tells less: such stars are many."""


@njit(nogil=True, error_model="numpy")
def predict(points, beyond, i, j, largest, prefilter):  # type: ignore[no-untyped-def]
    """Coefficients and gates of all points, and their order, the most telling first.

    They go into `prefilter`.  `beyond` (n,): the chance of each to be a star beyond the limit.
    Returns how many have a gate of at most `largest`.
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
