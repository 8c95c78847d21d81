"""The decision over weighed attitudes: acceptance or refusal, and a probability for each point."""

import math

import numpy as np

from service.attitude.covariance import within
from service.compiled.jit import njit
from service.identify.lost_in_space import posterior
from service.identify.lost_in_space.matching import LARGEST_GATE_RAD, nearest_stars
from service.identify.lost_in_space.search import SAME_ATTITUDE_RAD

LARGEST_SIGMA_RAD = math.radians(0.25)
"""Largest sigma of an accepted attitude about its worst axis (a corner cluster gives no roll)."""

LEAST = 1e-300
"""Least probability relative to the best attitude, as evidence may exceed exponents."""

FOUND, TOO_FEW, NOTHING, DOUBTFUL, DEGENERATE = 0, 1, 2, 3, 4


@njit(nogil=True)
def decide(ledger, count):  # type: ignore[no-untyped-def]
    """The index of the ledger's heaviest match, its attitude's log odds, and the decision code."""
    weights, attitudes, covariances = ledger.weight, ledger.attitude, ledger.covariance
    if count == 0:
        return -1, -math.inf, NOTHING
    best = 0
    for h in range(count):
        if weights[h] > weights[best]:
            best = h
    same, others = 0.0, max(math.exp(posterior.LOG_NULL - weights[best]), LEAST)
    for h in range(count):
        share = math.exp(weights[h] - weights[best])
        # The trace of the rotation between two attitudes is 1 + 2 cos of its angle.
        trace = 0.0
        for i in range(3):
            for j in range(3):
                trace += attitudes[h, i, j] * attitudes[best, i, j]
        sigma2 = covariances[best, 0, 0] + covariances[best, 1, 1] + covariances[best, 2, 2]
        apart2 = SAME_ATTITUDE_RAD**2 + 9.0 * sigma2
        if h == best or 3.0 - trace < apart2:
            same += share
        else:
            others += share
    log_odds = math.log(same / others)
    if others > posterior.DOUBT * (same + others):
        return best, log_odds, DOUBTFUL
    if not within(covariances[best], LARGEST_SIGMA_RAD**2):
        return best, log_odds, DEGENERATE
    return best, log_odds, FOUND


@njit(nogil=True, error_model="numpy")
def star_probabilities(  # type: ignore[no-untyped-def]
    points, index, field, magnitude_gate, t, covariance, match, doubt
):
    """Most likely star of each point, the probabilities of it and of no star, and the second star.

    A point may be its match, the second star near its place, or clutter with the density of the
    unexplained points. `doubt` is the probability that the attitude is wrong, which reduces every
    star's probability.
    """
    n = len(match)
    star, rival = np.full(n, -1, np.int64), np.full(n, -1, np.int64)
    probability, none = np.empty(n), np.empty(n)
    matched = 0
    for k in range(n):
        if match[k] >= 0:
            matched += 1
    clutter = (n - matched + 0.5) / field.area
    found = np.empty(2, np.int64)
    shares = np.empty(2)
    for k in range(n):
        b = points.observed[k]
        x = t[0, 0] * b[0] + t[1, 0] * b[1] + t[2, 0] * b[2] - points.velocity[0]
        y = t[0, 1] * b[0] + t[1, 1] * b[1] + t[2, 1] * b[2] - points.velocity[1]
        z = t[0, 2] * b[0] + t[1, 2] * b[1] + t[2, 2] * b[2] - points.velocity[2]
        norm = 1.0 / math.sqrt(x * x + y * y + z * z)
        x, y, z = x * norm, y * norm, z * norm
        spread = 0.0
        for i in range(3):
            spread += covariance[i, i]
            for j in range(3):
                spread -= b[i] * covariance[i, j] * b[j]
        variance = points.sigma[k] ** 2 + 0.5 * spread
        gate = min(6.0 * math.sqrt(variance), LARGEST_GATE_RAD)
        m = points.magnitude[k]
        found[0], found[1], _ = nearest_stars(
            *(index.cell_place, index.face, index.cell_start, index.cell_rows),
            *(x, y, z, gate, m - magnitude_gate, m + magnitude_gate),
        )
        total = clutter
        for which in range(2):
            row = found[which]
            shares[which] = 0.0
            if row < 0:
                continue
            elsewhere = False
            for other in range(n):
                if other != k and match[other] == row:
                    elsewhere = True
            if elsewhere:
                continue
            chord2 = (
                (index.stars[row, 0] - x) ** 2
                + (index.stars[row, 1] - y) ** 2
                + (index.stars[row, 2] - z) ** 2
            )
            density = 0.0
            for weight, scale in posterior.POSITION_SCALES:
                v = variance * scale * scale
                density += weight * math.exp(-0.5 * chord2 / v) / (2.0 * math.pi * v)
            if not np.isnan(m):
                sigma2 = field.magnitude_sigma**2 + posterior.OFFSET_SIGMA_MAG**2
                density *= math.exp(-0.5 * (m - index.stars[row, 3]) ** 2 / sigma2)
            shares[which] = density
            total += density
        which = 0 if shares[0] >= shares[1] else 1
        none[k] = clutter / total * (1.0 - doubt) + doubt
        probability[k] = shares[which] / total * (1.0 - doubt)
        if shares[which] > 0.0:
            star[k] = found[which]
        if shares[1 - which] > 0.0:
            rival[k] = found[1 - which]
    return star, probability, none, rival
