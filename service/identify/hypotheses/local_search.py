"""Local improvement of a hypothesis: matched again at its attitude, and similar ones weighed."""

import math

from service.compiled.jit import njit, njit_no_refcount
from service.identify.hypotheses import evidence
from service.identify.hypotheses.fitting import (
    fit_match,
    log_weight_of,
    weigh,
    weigh_without,
    work_of_fit,
)
from service.identify.hypotheses.ledger import is_part, keep, known, spent
from service.identify.hypotheses.scene import Progress, within_bounds
from service.sky.geometry.star_hashes import nearest

MATCH_GATE = 34.0
"""Largest distance of a star from its predicted place, in sigmas, for matching again."""
LARGEST_GATE_RAD = 0.009
NEGLIGIBLE = 18.0
"""Log weight below the best at which a hypothesis is only summed, not kept."""
NEAR_SIGMAS, NEAR_MAG, RARE = 3.0, 0.5, -6.0
"""Limits for a star that is surely no clutter: sigmas, magnitude difference, log of chance."""


@njit_no_refcount
def consider(observed, stars, match, scratch, ledger, progress):  # type: ignore[no-untyped-def]
    """Fit a hypothesis, match all stars again at its attitude, and weigh it and similar ones.

    Similar hypotheses lack one of its stars, unless that star fits well, or have a star's
    second-nearest neighbour instead. Returns the progress, and whether the stars fit together at
    all.
    """
    n = len(match)
    matched, square, log_det = fit_match(observed, stars, match, scratch, 1)
    progress = spent(progress, work_of_fit(n, matched))
    if matched == 0:
        return progress, True
    misfit = math.sqrt(square / matched) > evidence.POSITION_SCALES[-1] * observed.reference_sigma
    if matched > 3 and misfit:
        return progress, False
    fresh, second = scratch.nearest, scratch.second
    _match_at(observed, stars, scratch.t, fresh, second)
    progress = spent(progress, n)
    if known(fresh, ledger, progress.count):
        return progress, not misfit
    if not (is_part(fresh, match) and is_part(match, fresh)):
        matched, square, log_det = fit_match(observed, stars, fresh, scratch, 1)
        progress = spent(progress, work_of_fit(n, matched))
        if matched < 2:
            return progress, not misfit
    base = log_weight_of(observed, stars, fresh, scratch.t, matched, square, log_det)
    progress = _keep_best(fresh, base, ledger, progress)
    if base < max(progress.best, progress.unexplored_weight) - NEGLIGIBLE:
        return progress, not misfit
    rare = _neighbours_are_rare(observed, stars)
    for k in range(n):
        if fresh[k] < 0 or (rare and _sits_well(observed, stars, fresh, k, scratch)):
            continue
        mine = fresh[k]
        fresh[k] = -1
        if not known(fresh, ledger, progress.count):
            value = weigh_without(observed, stars, fresh, k, square, scratch)
            progress = _keep_best(fresh, value, ledger, spent(progress, 4 + n // 32))
        fresh[k] = mine
    for k in range(n):
        if fresh[k] < 0 or second[k] < 0 or _names(fresh, second[k]):
            continue
        mine = fresh[k]
        fresh[k] = second[k]
        if not known(fresh, ledger, progress.count):
            # This refits the attitude: nothing below may rely on the fit of the given hypothesis.
            value = weigh(observed, stars, fresh, scratch)
            progress = _keep_best(fresh, value, ledger, spent(progress, work_of_fit(n, matched)))
        fresh[k] = mine
    return progress, not misfit


@njit_no_refcount
def _keep_best(match, value, ledger, progress):  # type: ignore[no-untyped-def]
    """Add a hypothesis of three or more stars to the ledger, and update the best weight."""
    after = keep(match, value, ledger, progress)
    return Progress(
        *(after.count, after.unexplored_weight, max(after.best, value)),
        *(after.work, after.max_work),
    )


@njit_no_refcount
def _names(match, row):  # type: ignore[no-untyped-def]
    """True if a match contains a given zone star."""
    for one in match:  # noqa: SIM110 - compiled, without a generator
        if one == row:
            return True
    return False


@njit_no_refcount
def _neighbours_are_rare(observed, stars):  # type: ignore[no-untyped-def]
    """True if chance rarely puts a zone star within the widest scale of noise.

    Its probability is rho 2 pi s^2; where that is as rare as e^-6, the hypothesis without a
    well-fitting star weighs less than about e^-8 of the one with it.
    """
    widest = evidence.POSITION_SCALES[-1] * observed.reference_sigma
    return stars.log_density + math.log(2.0 * math.pi * widest * widest) <= RARE


@njit(nogil=True, inline="always")
def _sits_well(observed, stars, match, k, scratch):  # type: ignore[no-untyped-def]
    """True if a star fits so well in place and magnitude that it can hardly be clutter."""
    # Comparison with NaN gives False where there is no magnitude.
    if abs(observed.magnitude[k] - stars.magnitude[match[k]]) > NEAR_MAG:
        return False
    t, direction, references = scratch.t, observed.direction, scratch.references
    r0, r1, r2 = references[k, 0], references[k, 1], references[k, 2]
    square = 0.0
    for i in range(3):
        square += (direction[k, i] - t[i, 0] * r0 - t[i, 1] * r1 - t[i, 2] * r2) ** 2
    return square < (NEAR_SIGMAS * observed.sigma_rad[k]) ** 2


@njit(nogil=True, inline="always")
def _match_at(observed, stars, t, first, second):  # type: ignore[no-untyped-def]
    """Find each observed star's nearest and second-nearest zone star at an attitude; else -1."""
    direction, velocity = observed.direction, observed.velocity
    n = len(direction)
    first[:] = -1
    second[:] = -1
    for k in range(n):
        o0, o1, o2 = direction[k, 0], direction[k, 1], direction[k, 2]
        p0 = t[0, 0] * o0 + t[1, 0] * o1 + t[2, 0] * o2 - velocity[0]
        p1 = t[0, 1] * o0 + t[1, 1] * o1 + t[2, 1] * o2 - velocity[1]
        p2 = t[0, 2] * o0 + t[1, 2] * o1 + t[2, 2] * o2 - velocity[2]
        norm = math.sqrt(p0 * p0 + p1 * p1 + p2 * p2)
        gate = min(MATCH_GATE * observed.sigma_rad[k], LARGEST_GATE_RAD)
        one, other = nearest(
            p0 / norm,
            p1 / norm,
            p2 / norm,
            gate,
            stars.grid_start,
            stars.grid_rows,
            stars.grid_direction,
            first,
            k,
        )
        if one >= 0 and within_bounds(one, stars):
            first[k] = one
        if other >= 0 and within_bounds(other, stars):
            second[k] = other
