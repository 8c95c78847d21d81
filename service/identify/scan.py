"""One scan of the search: the candidates of one observed pair, each predicting the other stars."""

import math

import numpy as np
from numba import njit

from service.identify.evidence import LOG_PRIOR_AT_BEST, PRIOR_DIRECTION, log_prior
from service.identify.fitting import most_log
from service.identify.hypotheses import (
    LARGEST_GATE_RAD,
    NEGLIGIBLE,
    consider,
    known,
    leaves_a_group,
    log_sum,
    part_of,
)
from service.identify.scene import PREDICTION_GATE, polar_difference, with_magnitude, within
from service.identify.two_stars import MAX_WORK
from service.sky.star_buckets import nearest
from service.sky.star_voxels import level_for, star_within_reach
from service.uncounted import borrowing

MAX_THIRDS = 8
"""So many stars, those that a pair fixes best, are tried with it where all together do not fit."""
AGREEING_TILT_RAD = math.radians(3.0)
"""Pairs whose difference of angles to a presumed axis a tilt so small explains go first."""
HOPED = 12.0
"""A hypothesis of all stars is hoped to be lighter than it could be by no more than this."""


@borrowing
def most_of(count, seen, stars, most):  # type: ignore[no-untyped-def]
    """What so many stars can weigh at most, but for det N, worked out once in a search."""
    if np.isnan(most[count]):
        compared = min(count, with_magnitude(seen))
        most[count] = most_log(seen, stars, count, compared)
    return most[count]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
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
    not at all once the best is heavier than `enough` and leaves no group of stars.
    A candidate is left as soon as the stars that it may still match cannot make it
    matter; the most that all those can weigh goes to the rest.  How many stars
    matter depends on the best, which is not known at first: what is found with a
    hope that it did not fulfil is looked through again.
    """
    others, sine2 = _predictors(seen, group_of, i, j, scratch)
    if sine2 <= 0.0 or others == 0:
        return count, rest, best, work
    lost = _half_log_det(seen, i, j, scratch.order, others)
    light, most = scratch.light, scratch.most
    hoped = most_of(others + 2, seen, stars, most) - lost - HOPED
    by_axis = seen.prior_kind == PRIOR_DIRECTION and len(pairs.polar_difference) > 0
    for agreeing in (True, False):
        if by_axis and not agreeing:
            # What does not agree tilts the axis, which is unlikely beforehand.
            lost += LOG_PRIOR_AT_BEST[PRIOR_DIRECTION] - log_prior(
                AGREEING_TILT_RAD, PRIOR_DIRECTION
            )
        fewest = _fewest(seen, stars, others, lost, max(best, hoped), most)
        while True:
            count, rest, best, work = _through(
                seen,
                stars,
                pairs,
                i,
                j,
                first,
                last,
                by_axis,
                agreeing,
                others,
                lost,
                fewest,
                scratch,
                ledger,
                log_weight,
                count,
                rest,
                best,
                work,
            )
            needed = _fewest(seen, stars, others, lost, best, most)
            if needed >= fewest or work >= MAX_WORK:
                break
            fewest = needed
        # Fewer than three are no hypothesis of this search.
        for m in range(3, others + 3):
            if light[m]:
                rest = log_sum(rest, most_of(m, seen, stars, most) - lost + math.log(light[m]))
        settled = best > enough and not leaves_a_group(scratch.leader)
        if not by_axis or settled or work >= MAX_WORK:
            break
    return count, rest, best, work


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _through(  # type: ignore[no-untyped-def]
    seen,
    stars,
    pairs,
    i,
    j,
    first,
    last,
    by_axis,
    agreeing,
    others,
    lost,
    fewest,
    scratch,
    ledger,
    log_weight,
    count,
    rest,
    best,
    work,
):
    """Go once through the candidates, or those that agree with the axis, or those that do not.

    What matches less than `fewest` stars is counted in `scratch.light` by the
    most that it may match; the number rises with the best that is found.
    """
    light, direction, voxels = scratch.light, stars.direction, stars.voxels
    brighter, dimmer, difference = pairs.brighter, pairs.dimmer, pairs.polar_difference
    light[:] = 0
    scratch.match[:] = -1
    # These nearly always decide, the first of them where none may be missing.
    one, two, three = (
        _test(scratch, others, 0),
        _test(scratch, others, 1),
        _test(scratch, others, 2),
    )
    polar = tolerance = 0.0
    if by_axis:
        polar, tolerance = polar_difference(seen, i, j, AGREEING_TILT_RAD + pairs.off_axis)
    for c in range(first, last):
        straight = swapped = True
        if by_axis:
            straight = (abs(difference[c] - polar) <= tolerance) == agreeing
            swapped = (abs(difference[c] + polar) <= tolerance) == agreeing
            if not (straight or swapped):
                continue
        work += 1
        a, b = brighter[c], dimmer[c]
        u0, u1, u2 = direction[a, 0], direction[a, 1], direction[a, 2]
        v0, v1, v2 = direction[b, 0], direction[b, 1], direction[b, 2]
        w0, w1, w2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        for swap in range(2):
            if swap:
                # The other way round, and their product changes sign.
                a, b = b, a
                u0, u1, u2, v0, v1, v2 = v0, v1, v2, u0, u1, u2
                w0, w1, w2 = -w0, -w1, -w2
            if not (swapped if swap else straight):
                continue
            missing = _missing(voxels, one, u0, u1, u2, v0, v1, v2, w0, w1, w2)
            if others + 2 - missing < fewest:
                light[fewest - 1] += 1
                continue
            missing += _missing(voxels, two, u0, u1, u2, v0, v1, v2, w0, w1, w2)
            missing += _missing(voxels, three, u0, u1, u2, v0, v1, v2, w0, w1, w2)
            if others + 2 - missing < fewest:
                light[fewest - 1] += 1
                continue
            before = best
            matched, count, rest, best, cost = _try(
                seen,
                stars,
                i,
                j,
                a,
                b,
                others,
                fewest,
                scratch,
                ledger,
                log_weight,
                count,
                rest,
                best,
            )
            work += cost
            light[fewest - 1] += matched < fewest
            if best > before:
                needed = _fewest(seen, stars, others, lost, best, scratch.most)
                fewest = max(fewest, needed)
        if work >= MAX_WORK:
            break
    return count, rest, best, work


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _try(  # type: ignore[no-untyped-def]
    seen,
    stars,
    i,
    j,
    a,
    b,
    others,
    fewest,
    scratch,
    ledger,
    log_weight,
    count,
    rest,
    best,
):
    """Put zone stars a and b in the place of observed stars i and j, and consider what they match.

    Returns how many stars at most are matched where they are fewer than `fewest`;
    then as `consider` the number of hypotheses, the rest, the heaviest and the work.
    """
    match, used, order = scratch.match, scratch.used, scratch.order
    used[0], used[1] = a, b
    matched, work = 2, 0
    for at in range(others):
        if matched + others - at < fewest:
            return matched, count, rest, best, work
        work += 1
        k = order[at]
        match[k] = _nearest_to_predicted(stars, scratch, a, b, k, matched)
        if match[k] >= 0:
            used[matched] = match[k]
            matched += 1
    if matched < fewest or not (within(a, stars) and within(b, stars)):
        return matched, count, rest, best, work
    match[i], match[j] = a, b
    if known(match, ledger, count, scratch.table) or part_of(match, scratch.leader):
        return matched, count, rest, best, work
    count, rest, best, cost, fits = consider(
        seen, stars, match, scratch, ledger, log_weight, count, rest, best
    )
    work += cost
    if fits:
        return matched, count, rest, best, work
    # Where gates are wide, clutter meets a star of the zone by chance: one such
    # spoils the fit of all, or has taken the star of another.  So each by itself.
    third = -1
    for at in range(0 if matched > 3 else others):
        if match[order[at]] >= 0:
            third = order[at]
    for at in range(min(others, MAX_THIRDS)):
        k = order[at]
        if k == third:
            continue
        one = _nearest_to_predicted(stars, scratch, a, b, k, 2)
        if one < 0:
            continue
        match[:] = -1
        match[i], match[j], match[k] = a, b, one
        if known(match, ledger, count, scratch.table) or part_of(match, scratch.leader):
            continue
        count, rest, best, cost, _ = consider(
            seen, stars, match, scratch, ledger, log_weight, count, rest, best
        )
        work += cost
    return matched, count, rest, best, work


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _nearest_to_predicted(stars, scratch, a, b, k, taken):  # type: ignore[no-untyped-def]
    """The zone star where the pair (a, b) puts observed star k, -1 for none."""
    u, v, part = stars.direction[a], stars.direction[b], scratch.parts[k]
    one, _ = nearest(
        part[0] * u[0] + part[1] * v[0] + part[2] * (u[1] * v[2] - u[2] * v[1]),
        part[0] * u[1] + part[1] * v[1] + part[2] * (u[2] * v[0] - u[0] * v[2]),
        part[0] * u[2] + part[1] * v[2] + part[2] * (u[0] * v[1] - u[1] * v[0]),
        scratch.gate[k],
        stars.grid_start,
        stars.grid_rows,
        stars.grid_direction,
        scratch.used,
        taken,
    )
    return one if one >= 0 and within(one, stars) else -1


@borrowing
def _half_log_det(seen, i, j, order, others):  # type: ignore[no-untyped-def]
    """The least of 1/2 ln det N of stars i and j and one of the others; more stars only add."""
    least = math.inf
    wi, wj, vi, vj = seen.weight[i], seen.weight[j], seen.observed[i], seen.observed[j]
    for at in range(others):
        k = order[at]
        wk, vk = seen.weight[k], seen.observed[k]
        n00 = n11 = n22 = wi + wj + wk
        n00 -= wi * vi[0] * vi[0] + wj * vj[0] * vj[0] + wk * vk[0] * vk[0]
        n11 -= wi * vi[1] * vi[1] + wj * vj[1] * vj[1] + wk * vk[1] * vk[1]
        n22 -= wi * vi[2] * vi[2] + wj * vj[2] * vj[2] + wk * vk[2] * vk[2]
        n01 = -(wi * vi[0] * vi[1] + wj * vj[0] * vj[1] + wk * vk[0] * vk[1])
        n02 = -(wi * vi[0] * vi[2] + wj * vj[0] * vj[2] + wk * vk[0] * vk[2])
        n12 = -(wi * vi[1] * vi[2] + wj * vj[1] * vj[2] + wk * vk[1] * vk[2])
        det = (
            n00 * (n11 * n22 - n12 * n12)
            - n01 * (n01 * n22 - n12 * n02)
            + n02 * (n01 * n12 - n11 * n02)
        )
        least = min(least, det)
    return 0.5 * math.log(max(least, 1e-30))


@borrowing
def _test(scratch, others, at):  # type: ignore[no-untyped-def]
    """How one of the others in order is predicted, and its level of voxels, -1 where none tells."""
    if at >= others:
        return 0.0, 0.0, 0.0, -1
    k = scratch.order[at]
    alpha, beta, gamma = scratch.parts[k, 0], scratch.parts[k, 1], scratch.parts[k, 2]
    return alpha, beta, gamma, level_for(scratch.gate[k])


@njit(cache=True, nogil=True, inline="always")
def _missing(voxels, test, u0, u1, u2, v0, v1, v2, w0, w1, w2):  # type: ignore[no-untyped-def]
    """Whether, 0 or 1, no star can stand where a pair u, v with the product w predicts one."""
    alpha, beta, gamma, level = test
    if level < 0:
        return 0
    return 1 - star_within_reach(
        voxels,
        level,
        alpha * u0 + beta * v0 + gamma * w0,
        alpha * u1 + beta * v1 + gamma * w1,
        alpha * u2 + beta * v2 + gamma * w2,
    )


@borrowing
def _fewest(seen, stars, others, lost, best, most):  # type: ignore[no-untyped-def]
    """The fewest stars with which a candidate matters beside the best.

    `lost` is how much lighter it is than `most_of` in any case.
    """
    fewest = 3
    while fewest <= others + 2 and (most_of(fewest, seen, stars, most) - lost < best - NEGLIGIBLE):
        fewest += 1
    return fewest


@borrowing
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
        parts[k, 0], parts[k, 1], parts[k, 2] = alpha, beta, gamma
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
