"""One scan of the search: the candidates of one observed pair, each predicting the other stars."""

import math
from typing import Any, NamedTuple

import numpy as np

from service.compiled.jit import njit_inlined, njit_no_refcount
from service.identify.hypotheses.evidence import LOG_PRIOR_AT_BEST, log_prior
from service.identify.hypotheses.fitting import log_weight_bound
from service.identify.hypotheses.ledger import (
    at_bound,
    is_part,
    known,
    leaves_a_group,
    left_unexplored,
    spent,
)
from service.identify.hypotheses.local_search import LARGEST_GATE_RAD, NEGLIGIBLE, consider
from service.identify.hypotheses.scene import (
    PREDICTION_GATE,
    polar_difference,
    with_magnitude,
    within_bounds,
)
from service.identify.sighting import PRIOR_DIRECTION
from service.sky.geometry.star_hashes import level_for, nearest, star_within_reach

MAX_THIRDS = 8
"""Number of third stars tried one by one with a pair if all stars together do not fit."""
AGREEING_TILT_RAD = math.radians(3.0)
"""Largest tilt of a presumed axis that still explains a pair's difference of angles to the axis."""
INITIAL_SLACK = 12.0
"""Log weight subtracted from the bound for all stars as a first guess of the best hypothesis."""


class Scan(NamedTuple):
    """Parameters of one pass over the catalog pairs that may be observed stars i and j.

    `others` stars of other groups are predicted. A candidate weighs at least `log_penalty` less
    than the `weight_bound` of its stars. With a presumed axis (`by_axis`) a pass covers either the
    candidates that agree with the axis or the others, according to `agreeing`.
    """

    i: Any
    j: Any
    first: Any
    last: Any
    others: Any
    log_penalty: Any
    by_axis: Any
    agreeing: Any


@njit_inlined
def weight_bound(count, observed, stars, bounds):  # type: ignore[no-untyped-def]
    """Cached upper bound on the log weight of a hypothesis of `count` stars, apart from det N."""
    if np.isnan(bounds[count]):
        compared = min(count, with_magnitude(observed))
        bounds[count] = log_weight_bound(observed, stars, count, compared)
    return bounds[count]


@njit_inlined
def scan_pair(  # type: ignore[no-untyped-def]
    observed, stars, pairs, pair, accept_threshold, scratch, ledger, progress
):
    """Try every catalog pair for an observed pair, in both orders; returns the progress.

    With a presumed axis, candidates that agree with the axis go first; the others are skipped once
    the best is heavier than `accept_threshold` and leaves no group of stars. A candidate is dropped
    as soon as its possible matches cannot make it matter; the upper bound of all dropped candidates
    goes to the unexplored weight. The number of stars that matter depends on the best weight, which
    is guessed at first; where the guess was too high, the candidates are scanned again.
    """
    others, sine2 = _predictors(observed, pair.i, pair.j, scratch)
    if sine2 <= 0.0 or others == 0:
        return progress
    log_penalty = _half_log_det(observed, pair.i, pair.j, scratch.order, others)
    deferred, bounds = scratch.deferred_counts, scratch.weight_bounds
    guess = weight_bound(others + 2, observed, stars, bounds) - log_penalty - INITIAL_SLACK
    by_axis = observed.prior_kind == PRIOR_DIRECTION and len(pairs.polar_difference) > 0
    for agreeing in (True, False):
        if by_axis and not agreeing:
            # Candidates that disagree need a tilted axis, which is unlikely a priori.
            log_penalty += LOG_PRIOR_AT_BEST[PRIOR_DIRECTION] - log_prior(
                AGREEING_TILT_RAD, PRIOR_DIRECTION
            )
        scan = Scan(pair.i, pair.j, pair.first, pair.last, others, log_penalty, by_axis, agreeing)
        fewest = _fewest(observed, stars, scan, max(progress.best, guess), bounds)
        while True:
            progress = _score_candidates(
                observed, stars, pairs, scan, fewest, scratch, ledger, progress
            )
            needed = _fewest(observed, stars, scan, progress.best, bounds)
            if needed >= fewest or at_bound(progress):
                break
            fewest = needed
        # The search has no hypotheses of fewer than three stars.
        for m in range(3, others + 3):
            if deferred[m]:
                bound = weight_bound(m, observed, stars, bounds)
                progress = left_unexplored(progress, bound - log_penalty + math.log(deferred[m]))
        settled = progress.best > accept_threshold and not leaves_a_group(ledger.heaviest_match)
        if not by_axis or settled or at_bound(progress):
            break
    return progress


@njit_inlined
def _score_candidates(observed, stars, pairs, scan, fewest, scratch, ledger, progress):  # type: ignore[no-untyped-def]
    """Score the candidates of a scan in one pass; returns the search's progress.

    A candidate with fewer than `fewest` matches is counted in `scratch.deferred_counts` by its
    largest possible number of matches; `fewest` rises with the best weight.
    """
    deferred, direction, voxels = scratch.deferred_counts, stars.direction, stars.voxels
    brighter, dimmer, difference = pairs.brighter, pairs.dimmer, pairs.polar_difference
    others, by_axis, agreeing = scan.others, scan.by_axis, scan.agreeing
    deferred[:] = 0
    scratch.match[:] = -1
    # The first two predicted stars reject most candidates; the first alone if none may be missing.
    one, two = _test(scratch, others, 0), _test(scratch, others, 1)
    three = _test(scratch, others, 2)
    polar = tolerance = 0.0
    if by_axis:
        tilt = AGREEING_TILT_RAD + pairs.off_axis
        polar, tolerance = polar_difference(observed, scan.i, scan.j, tilt)
    for c in range(scan.first, scan.last):
        straight = swapped = True
        if by_axis:
            straight = (abs(difference[c] - polar) <= tolerance) == agreeing
            swapped = (abs(difference[c] + polar) <= tolerance) == agreeing
            if not (straight or swapped):
                continue
        progress = spent(progress, 1)
        a, b = brighter[c], dimmer[c]
        u0, u1, u2 = direction[a, 0], direction[a, 1], direction[a, 2]
        v0, v1, v2 = direction[b, 0], direction[b, 1], direction[b, 2]
        w0, w1, w2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
        for swap in range(2):
            if swap:
                # In the other order the cross product changes sign.
                a, b = b, a
                u0, u1, u2, v0, v1, v2 = v0, v1, v2, u0, u1, u2
                w0, w1, w2 = -w0, -w1, -w2
            if not (swapped if swap else straight):
                continue
            missing = _missing(voxels, one, u0, u1, u2, v0, v1, v2, w0, w1, w2)
            if others + 2 - missing < fewest:
                deferred[fewest - 1] += 1
                continue
            missing += _missing(voxels, two, u0, u1, u2, v0, v1, v2, w0, w1, w2)
            missing += _missing(voxels, three, u0, u1, u2, v0, v1, v2, w0, w1, w2)
            if others + 2 - missing < fewest:
                deferred[fewest - 1] += 1
                continue
            before = progress.best
            matched, progress = _evaluate(
                observed, stars, scan, a, b, fewest, scratch, ledger, progress
            )
            deferred[fewest - 1] += matched < fewest
            if progress.best > before:
                needed = _fewest(observed, stars, scan, progress.best, scratch.weight_bounds)
                fewest = max(fewest, needed)
        if at_bound(progress):
            break
    return progress


@njit_inlined
def _evaluate(observed, stars, scan, a, b, fewest, scratch, ledger, progress):  # type: ignore[no-untyped-def]
    """Match zone stars a and b with the observed pair and other stars predicted; weigh the match.

    Returns the largest possible number of matches if it is below `fewest`, and the progress.
    """
    match, used, order = scratch.match, scratch.used, scratch.order
    others = scan.others
    used[0], used[1] = a, b
    matched = 2
    for at in range(others):
        if matched + others - at < fewest:
            return matched, progress
        progress = spent(progress, 1)
        k = order[at]
        match[k] = _nearest_to_predicted(stars, scratch, a, b, k, matched)
        if match[k] >= 0:
            used[matched] = match[k]
            matched += 1
    if matched < fewest or not (within_bounds(a, stars) and within_bounds(b, stars)):
        return matched, progress
    match[scan.i], match[scan.j] = a, b
    if known(match, ledger, progress.count) or is_part(match, ledger.heaviest_match):
        return matched, progress
    progress, fits = consider(observed, stars, match, scratch, ledger, progress)
    if fits:
        return matched, progress
    # With wide gates clutter matches by chance and spoils the common fit; so each match is tried
    # alone.
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
        match[scan.i], match[scan.j], match[k] = a, b, one
        if known(match, ledger, progress.count) or is_part(match, ledger.heaviest_match):
            continue
        progress, _ = consider(observed, stars, match, scratch, ledger, progress)
    return matched, progress


@njit_inlined
def _nearest_to_predicted(stars, scratch, a, b, k, taken):  # type: ignore[no-untyped-def]
    """The zone star nearest to a pair's (a, b) prediction for observed star k; -1 for none."""
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
    return one if one >= 0 and within_bounds(one, stars) else -1


@njit_no_refcount
def _half_log_det(observed, i, j, order, others):  # type: ignore[no-untyped-def]
    """The least 1/2 ln det N for stars i, j and one other; additional stars only increase it."""
    least = math.inf
    wi, wj = observed.weight[i], observed.weight[j]
    vi, vj = observed.direction[i], observed.direction[j]
    for at in range(others):
        k = order[at]
        wk, vk = observed.weight[k], observed.direction[k]
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


@njit_inlined
def _test(scratch, others, at):  # type: ignore[no-untyped-def]
    """Coefficients that predict an observed star from a pair, and its voxel level; -1 for none."""
    if at >= others:
        return 0.0, 0.0, 0.0, -1
    k = scratch.order[at]
    alpha, beta, gamma = scratch.parts[k, 0], scratch.parts[k, 1], scratch.parts[k, 2]
    return alpha, beta, gamma, level_for(scratch.gate[k])


@njit_inlined
def _missing(voxels, test, u0, u1, u2, v0, v1, v2, w0, w1, w2):  # type: ignore[no-untyped-def]
    """1 if no star can be where a pair u, v with the cross product w predicts one, else 0."""
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


@njit_inlined
def _fewest(observed, stars, scan, best, bounds):  # type: ignore[no-untyped-def]
    """The least number of matches for which a scan's candidate can matter beside the best."""
    fewest = 3
    while fewest <= scan.others + 2 and (
        weight_bound(fewest, observed, stars, bounds) - scan.log_penalty < best - NEGLIGIBLE
    ):
        fewest += 1
    return fewest


@njit_no_refcount
def _predictors(observed, i, j, scratch):  # type: ignore[no-untyped-def]
    """Find how a pair predicts other groups' stars; returns their number and the pair's sin^2.

    A catalog pair (a, b) for (i, j) then predicts it at alpha a + beta b + gamma a x b, without an
    attitude. Returns the number of predicted stars, which are ordered by accuracy, and the squared
    sine of the pair's angle.
    """
    direction, sigma_rad, group_of = observed.direction, observed.sigma_rad, scratch.group_of
    n = len(direction)
    order, parts, gate = scratch.order, scratch.parts, scratch.gate
    vi, vj = direction[i], direction[j]
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
        v = direction[k]
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
