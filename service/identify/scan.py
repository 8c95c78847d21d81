"""One scan of the search: the candidates of one observed pair, each predicting the other stars."""

import math

import numpy as np
from numba import njit

from service.identify.evidence import PRIOR_DIRECTION
from service.identify.fitting import most_log
from service.identify.hypotheses import (
    LARGEST_GATE_RAD,
    NEGLIGIBLE,
    consider,
    heaviest,
    known,
    log_sum,
    part_of,
)
from service.identify.scene import with_magnitude, within
from service.identify.two_stars import MAX_WORK
from service.sky.pairs import separation_rad
from service.sky.star_buckets import nearest

PREDICTION_GATE = 20.0
"""In sigmas: how far a star may lie from where a pair of others puts it."""
MAX_THIRDS = 8
"""So many stars, those that a pair fixes best, are tried with it where all together do not fit."""
AGREEING_RAD = math.radians(0.25)
"""Pairs whose difference of angles to a presumed axis is within this of that observed go first."""


@njit(cache=True, nogil=True)
def most_of(count, seen, stars, most):  # type: ignore[no-untyped-def]
    """What so many stars can weigh at most, but for det N, worked out once in a search."""
    if np.isnan(most[count]):
        compared = min(count, with_magnitude(seen))
        most[count] = most_log(seen, stars, count, compared, 0.0)
    return most[count]


@njit(cache=True, nogil=True, error_model="numpy")
def scan(  # type: ignore[no-untyped-def]
    seen,
    stars,
    pairs,
    group_of,
    i,
    j,
    first,
    last,
    enough,
    scratch,
    ledger,
    log_weight,
    count,
    rest,
    best,
    work,
):
    """Try every candidate pair in the place of observed stars i and j, either way round.

    Where an axis is presumed, those go first that agree with it, and the others
    not at all once the best is heavier than `enough`.  A candidate is left as
    soon as the stars that it may still match cannot make it matter; the most
    that all those can weigh goes to the rest.
    """
    match, used, light = scratch.match, scratch.used, scratch.light
    order, parts, gate = scratch.order, scratch.parts, scratch.gate
    direction, polar = stars.direction, stars.polar
    start, rows, place = stars.grid_start, stars.grid_rows, stars.grid_direction
    others, sine2 = _predictors(seen, group_of, i, j, scratch)
    if sine2 <= 0.0:
        return count, rest, best, work
    half_log_det = 0.5 * math.log(sine2)
    light[:] = 0
    match[:] = -1
    # The fewest stars that matter beside the best, and the best that they were found for.
    fewest, fewest_for = 3, -math.inf
    leader = heaviest(log_weight, count)
    by_axis = seen.prior_kind == PRIOR_DIRECTION
    tilt = 0.0
    if by_axis:
        tilt = separation_rad(seen.observed[i], seen.prior_axis) - separation_rad(
            seen.observed[j], seen.prior_axis
        )
    for agreeing in (True, False):
        for c in range(first, last):
            work += 1
            a, b = pairs.brighter[c], pairs.dimmer[c]
            if not (within(a, stars) and within(b, stars)):
                continue
            for swap in range(2):
                if swap == 1:
                    a, b = b, a
                if by_axis and (abs(polar[a] - polar[b] - tilt) <= AGREEING_RAD) != agreeing:
                    continue
                if best > fewest_for:
                    fewest, fewest_for = _fewest(
                        seen, stars, others, half_log_det, fewest, best, scratch.most
                    )
                u, v = direction[a], direction[b]
                w0 = u[1] * v[2] - u[2] * v[1]
                w1 = u[2] * v[0] - u[0] * v[2]
                w2 = u[0] * v[1] - u[1] * v[0]
                used[0], used[1] = a, b
                matched = 2
                for at in range(others):
                    if matched + others - at < fewest:
                        break
                    work += 1
                    k = order[at]
                    match[k] = -1
                    alpha, beta, gamma = parts[k]
                    one, _ = nearest(
                        alpha * u[0] + beta * v[0] + gamma * w0,
                        alpha * u[1] + beta * v[1] + gamma * w1,
                        alpha * u[2] + beta * v[2] + gamma * w2,
                        gate[k],
                        start,
                        rows,
                        place,
                        used,
                        matched,
                    )
                    if one >= 0 and within(one, stars):
                        match[k] = one
                        used[matched] = one
                        matched += 1
                if matched < fewest:
                    # Fewer than three are no hypothesis of this search.
                    light[fewest - 1] += fewest > 3
                    continue
                match[i], match[j] = a, b
                if known(match, ledger, count) or (leader >= 0 and part_of(match, ledger[leader])):
                    continue
                count, rest, best, cost, fits = consider(
                    seen, stars, match, scratch, ledger, log_weight, count, rest, best
                )
                work += cost
                # Where gates are wide, clutter meets a star of the zone by chance: one such
                # spoils the fit of all, or has taken the star of another.  So each by itself.
                third = -1
                for at in range(0 if fits or matched > 3 else others):
                    if match[order[at]] >= 0:
                        third = order[at]
                for at in range(0 if fits else min(others, MAX_THIRDS)):
                    k = order[at]
                    if k == third:
                        continue
                    alpha, beta, gamma = parts[k]
                    one, _ = nearest(
                        alpha * u[0] + beta * v[0] + gamma * w0,
                        alpha * u[1] + beta * v[1] + gamma * w1,
                        alpha * u[2] + beta * v[2] + gamma * w2,
                        gate[k],
                        start,
                        rows,
                        place,
                        used,
                        2,
                    )
                    if one < 0 or not within(one, stars):
                        continue
                    match[:] = -1
                    match[i], match[j], match[k] = a, b, one
                    if known(match, ledger, count) or (
                        leader >= 0 and part_of(match, ledger[leader])
                    ):
                        continue
                    count, rest, best, cost, _ = consider(
                        seen, stars, match, scratch, ledger, log_weight, count, rest, best
                    )
                    work += cost
                if count > 0 and (leader < 0 or log_weight[leader] < best):
                    leader = heaviest(log_weight, count)
            if work >= MAX_WORK:
                break
        if not by_axis or best > enough:
            break
    for m in range(3, others + 3):
        if light[m]:
            most = most_of(m, seen, stars, scratch.most)
            rest = log_sum(rest, most - half_log_det + math.log(light[m]))
    return count, rest, best, work


@njit(cache=True, nogil=True)
def _fewest(seen, stars, others, half_log_det, fewest, best, most):  # type: ignore[no-untyped-def]
    """The fewest stars with which a candidate matters beside the best, and that best."""
    while fewest <= others + 2 and (
        most_of(fewest, seen, stars, most) - half_log_det < best - NEGLIGIBLE
    ):
        fewest += 1
    return fewest, best


@njit(cache=True, nogil=True)
def _predictors(seen, group_of, i, j, scratch):  # type: ignore[no-untyped-def]
    """Write every star of other groups as alpha V_i + beta V_j + gamma V_i x V_j.

    A catalog pair (a, b) in the place of (i, j) then puts it at
    alpha a + beta b + gamma a x b, without an attitude.  Returns how many there
    are, in order with the best fixed first, and the squared sine of the pair's angle.
    """
    observed, sigma_rad = seen.observed, seen.sigma_rad
    n = len(observed)
    order, parts, gate = scratch.order, scratch.parts, scratch.gate
    vi, vj = observed[i], observed[j]
    cosine = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
    c0 = vi[1] * vj[2] - vi[2] * vj[1]
    c1 = vi[2] * vj[0] - vi[0] * vj[2]
    c2 = vi[0] * vj[1] - vi[1] * vj[0]
    sine2 = c0 * c0 + c1 * c1 + c2 * c2
    others = 0
    if sine2 <= 0.0:
        return others, sine2
    for k in range(n):
        if group_of[k] == group_of[i] or group_of[k] == group_of[j]:
            continue
        v = observed[k]
        di = v[0] * vi[0] + v[1] * vi[1] + v[2] * vi[2]
        dj = v[0] * vj[0] + v[1] * vj[1] + v[2] * vj[2]
        alpha = (di - cosine * dj) / sine2
        beta = (dj - cosine * di) / sine2
        gamma = (v[0] * c0 + v[1] * c1 + v[2] * c2) / sine2
        parts[k] = alpha, beta, gamma
        spread = (
            sigma_rad[k] ** 2
            + (alpha**2 + gamma**2) * sigma_rad[i] ** 2
            + (beta**2 + gamma**2) * sigma_rad[j] ** 2
        )
        gate[k] = min(PREDICTION_GATE * math.sqrt(spread), LARGEST_GATE_RAD)
        at = others
        while at > 0 and gate[order[at - 1]] > gate[k]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
        others += 1
    return others, sine2
