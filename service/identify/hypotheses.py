"""The search for hypotheses: which stars could these be, all together?

Every candidate pair of an observed pair predicts every other star; what it
predicts well becomes a hypothesis and is weighed (see `evidence`).  Pairs are
not gated by steps 1 to 10: the prior and the magnitudes weigh, they do not
reject.

Vectors are in the presumed frame: inertial axes as the a priori attitude has
them.  The attitude T of a hypothesis takes catalog directions to that frame,
so that T is the identity where the a priori attitude is right.
"""

import math

import numpy as np
from numba import njit

from service.attitude.kernels import inverse_symmetric, triad
from service.identify import evidence
from service.identify.evidence import PRIOR_ROTATION
from service.sky.pairs import separation_rad
from service.sky.star_grid import cells_about

MAX_SEEDS = 12
"""Pairs of at most so many stars, the brightest, are scanned; all are matched."""
MAX_HYPOTHESES = 2048
MAX_WORK = 4_000_000
"""Candidate pairs looked at, at most, for one batch."""
PREDICTION_GATE = 20.0
"""In sigmas: how far a star may lie from where a pair of others puts it."""
MATCH_GATE = 34.0
"""In sigmas: how far a star may lie from where a hypothesis's attitude puts it."""
LARGEST_GATE_RAD = 0.009
SHORT_PAIR_RAD = math.radians(0.35)
CHANCE_PER_STAR, CHANCE_MARGIN = math.log(3.0), 12.0
"""Stop early once a hypothesis of three stars or more outweighs the null by 3^n e^12."""
NEGLIGIBLE = 18.0
"""A hypothesis lighter than the best by this, in logarithms, is only counted, not kept."""
RIVAL_PROBABILITY = 1e-3
"""A star at least this likely is named among the rivals of an ambiguous one."""


@njit(cache=True, nogil=True)
def within(row, direction, axis, least, most, polar):  # type: ignore[no-untyped-def]
    """Whether a zone star lies within the exact bounds; its angle to the axis is kept in `polar`."""
    if polar[row] < 0.0:
        polar[row] = separation_rad(direction[row], axis)
    return least <= polar[row] <= most


@njit(cache=True, nogil=True)
def nearest(p, gate, direction, box, offset, start, rows, used, found, cells):  # type: ignore[no-untyped-def]
    """The two stars nearest to a direction within `gate` that are not `used`; -1 where there is none."""
    cells_about(p, gate, box, cells)
    face = cells[0]
    found[0] = found[1] = -1
    best = second = 4.0 * math.sin(0.5 * gate) ** 2
    for u in range(cells[1], cells[2] + 1):
        base = offset[face] + (u - box[face, 0]) * box[face, 3] - box[face, 1]
        for at in range(start[base + cells[3]], start[base + cells[4] + 1]):
            row = rows[at]
            x = direction[row, 0] - p[0]
            y = direction[row, 1] - p[1]
            z = direction[row, 2] - p[2]
            chord2 = x * x + y * y + z * z
            if chord2 >= second:
                continue
            taken = False
            for other in used:
                if other == row:
                    taken = True
            if taken:
                continue
            if chord2 < best:
                second, found[1] = best, found[0]
                best, found[0] = chord2, row
            else:
                second, found[1] = chord2, row


@njit(cache=True, nogil=True, error_model="numpy")
def fit(observed, weight, direction, velocity, match, t, references):  # type: ignore[no-untyped-def]
    """Fit T to a hypothesis: TRIAD on the widest pair, then two Gauss-Newton steps.

    Returns the number of stars, the weighted sum of squared residuals and
    ln det N; the number is 0 where the geometry gives no attitude.
    `references` gets the apparent directions of the matched stars.
    """
    n = len(match)
    stars = 0
    for k in range(n):
        if match[k] >= 0:
            stars += 1
            norm = 0.0
            for i in range(3):
                references[k, i] = direction[match[k], i] + velocity[i]
                norm += references[k, i] ** 2
            norm = math.sqrt(norm)
            for i in range(3):
                references[k, i] /= norm
    first = second = -1
    widest = 0.0
    for k in range(n - 1):
        if match[k] < 0:
            continue
        for other in range(k + 1, n):
            if match[other] >= 0:
                apart = separation_rad(references[k], references[other])
                apart = min(apart, math.pi - apart)
                if apart > widest:
                    widest, first, second = apart, k, other
    if widest < 1e-5 or separation_rad(observed[first], observed[second]) < 1e-5:
        return 0, 0.0, 0.0
    triad(observed[first], observed[second], references[first], references[second], t)
    matrix = np.empty((3, 3))
    inverse = np.empty((3, 3))
    square = 0.0
    for step in range(3):
        matrix[:] = 0.0
        g0 = g1 = g2 = square = 0.0
        for k in range(n):
            if match[k] < 0:
                continue
            w = weight[k]
            r = references[k]
            p0 = t[0, 0] * r[0] + t[0, 1] * r[1] + t[0, 2] * r[2]
            p1 = t[1, 0] * r[0] + t[1, 1] * r[1] + t[1, 2] * r[2]
            p2 = t[2, 0] * r[0] + t[2, 1] * r[1] + t[2, 2] * r[2]
            d0, d1, d2 = observed[k, 0] - p0, observed[k, 1] - p1, observed[k, 2] - p2
            square += w * (d0 * d0 + d1 * d1 + d2 * d2)
            g0 += w * (d1 * p2 - d2 * p1)
            g1 += w * (d2 * p0 - d0 * p2)
            g2 += w * (d0 * p1 - d1 * p0)
            matrix[0, 0] += w * (1.0 - p0 * p0)
            matrix[1, 1] += w * (1.0 - p1 * p1)
            matrix[2, 2] += w * (1.0 - p2 * p2)
            matrix[0, 1] -= w * p0 * p1
            matrix[0, 2] -= w * p0 * p2
            matrix[1, 2] -= w * p1 * p2
        if step == 2:
            break
        matrix[1, 0], matrix[2, 0], matrix[2, 1] = matrix[0, 1], matrix[0, 2], matrix[1, 2]
        if not inverse_symmetric(matrix, inverse):
            return 0, 0.0, 0.0
        e0 = inverse[0, 0] * g0 + inverse[0, 1] * g1 + inverse[0, 2] * g2
        e1 = inverse[1, 0] * g0 + inverse[1, 1] * g1 + inverse[1, 2] * g2
        e2 = inverse[2, 0] * g0 + inverse[2, 1] * g1 + inverse[2, 2] * g2
        _turn(t, e0, e1, e2)
    det = (
        matrix[0, 0] * (matrix[1, 1] * matrix[2, 2] - matrix[1, 2] ** 2)
        - matrix[0, 1] * (matrix[0, 1] * matrix[2, 2] - matrix[1, 2] * matrix[0, 2])
        + matrix[0, 2] * (matrix[0, 1] * matrix[1, 2] - matrix[1, 1] * matrix[0, 2])
    )
    if not det > 0.0:
        return 0, 0.0, 0.0
    return stars, square, math.log(det)


@njit(cache=True, nogil=True)
def _turn(t, e0, e1, e2):  # type: ignore[no-untyped-def]
    """T becomes exp(-[e x]) T, by the quaternion (e/2, 1) so that it stays orthonormal."""
    norm = 1.0 / math.sqrt(1.0 + 0.25 * (e0 * e0 + e1 * e1 + e2 * e2))
    x, y, z, c = 0.5 * e0 * norm, 0.5 * e1 * norm, 0.5 * e2 * norm, norm
    for j in range(3):
        a, b, d = t[0, j], t[1, j], t[2, j]
        t[0, j] = (
            (x * x - y * y - z * z + c * c) * a + 2 * (x * y + z * c) * b + 2 * (x * z - y * c) * d
        )
        t[1, j] = (
            2 * (x * y - z * c) * a + (-x * x + y * y - z * z + c * c) * b + 2 * (y * z + x * c) * d
        )
        t[2, j] = (
            2 * (x * z + y * c) * a + 2 * (y * z - x * c) * b + (-x * x - y * y + z * z + c * c) * d
        )


@njit(cache=True, nogil=True)
def prior_angle(t, axis, kind):  # type: ignore[no-untyped-def]
    """The angle that the prior weighs: the total rotation of T, or the tilt that it gives the axis."""
    if kind == PRIOR_ROTATION:
        x, y, z = t[2, 1] - t[1, 2], t[0, 2] - t[2, 0], t[1, 0] - t[0, 1]
        return math.atan2(math.sqrt(x * x + y * y + z * z), t[0, 0] + t[1, 1] + t[2, 2] - 1.0)
    chord2 = 0.0
    for j in range(3):
        carried = axis[0] * t[0, j] + axis[1] * t[1, j] + axis[2] * t[2, j]
        chord2 += (carried - axis[j]) ** 2
    return 2.0 * math.asin(min(1.0, 0.5 * math.sqrt(chord2)))


@njit(cache=True, nogil=True, error_model="numpy")
def search(  # type: ignore[no-untyped-def]
    observed,  # (n, 3) presumed frame
    magnitude,  # (n,) NaN: none
    sigma_rad,  # (n,)
    direction,  # (m, 3) zone stars
    zone_magnitude,
    pair_separation,
    pair_brighter,
    pair_dimmer,
    bin_start,
    bins_per_rad,
    box,  # the star grid
    offset,
    start,
    rows,
    axis,  # (3,) the zone's exact axis, with the bounds on the angle to it
    least,
    most,
    velocity,  # (3,) of the observer in units of c; zero where aberration is not to be corrected
    prior_kind,
    prior_axis,
    exhaustive,
    hypotheses,  # (MAX_HYPOTHESES, n) out: zone row of every star, -1 clutter
    log_weight,  # (MAX_HYPOTHESES,) out
):
    """Search and weigh; returns how many hypotheses, the log weight of the rest, the work, if bounded.

    The rest is the null and what was too light or too much to keep.
    """
    n, m = len(observed), len(direction)
    polar = np.full(m, -1.0)
    reference_sigma = sigma_rad.min()
    weight = (reference_sigma / sigma_rad) ** 2
    with_magnitude = 0
    for k in range(n):
        if magnitude[k] == magnitude[k]:
            with_magnitude += 1
    log_density = math.log(m / (2.0 * math.pi * (math.cos(least) - math.cos(most))))
    rest = evidence.log_null(n, with_magnitude)
    enough = rest + n * CHANCE_PER_STAR + CHANCE_MARGIN

    match = np.full(n, -1, np.int32)
    t = np.empty((3, 3))
    references = np.empty((n, 3))
    used = np.full(n, -1, np.int32)
    found = np.empty(2, np.int32)
    cells = np.empty(5, np.int64)
    p = np.empty(3)
    count = 0
    work = 0
    best = -math.inf
    bounded = False
    seeds = _seeds(magnitude, n)
    s = len(seeds)
    first_pair, last_pair, separation = _candidates(
        observed, sigma_rad, seeds, pair_separation, bin_start, bins_per_rad
    )
    group = np.arange(s)
    groups = s
    alpha, beta, gamma = np.empty(n), np.empty(n), np.empty(n)
    gate2 = np.empty(n)
    order = np.empty(n, np.int64)

    done = False
    while groups > 2 and not done:
        left, right = _cheapest(group, first_pair, last_pair, separation)
        for x in range(s):
            for y in range(x + 1, s):
                joins = (group[x] == left and group[y] == right) or (
                    group[x] == right and group[y] == left
                )
                if done or not joins or first_pair[x, y] >= last_pair[x, y]:
                    continue
                i, j = seeds[x], seeds[y]
                others = _predictors(observed, sigma_rad, i, j, alpha, beta, gamma, gate2, order)
                for c in range(first_pair[x, y], last_pair[x, y]):
                    work += 1
                    for swap in range(2):
                        a, b = pair_brighter[c], pair_dimmer[c]
                        if swap == 1:
                            a, b = b, a
                        u, v = direction[a], direction[b]
                        w0 = u[1] * v[2] - u[2] * v[1]
                        w1 = u[2] * v[0] - u[0] * v[2]
                        w2 = u[0] * v[1] - u[1] * v[0]
                        match[:] = -1
                        match[i], match[j] = a, b
                        used[:] = -1
                        used[0], used[1] = a, b
                        stars = 2
                        for at in range(others):
                            k = order[at]
                            p[0] = alpha[k] * u[0] + beta[k] * v[0] + gamma[k] * w0
                            p[1] = alpha[k] * u[1] + beta[k] * v[1] + gamma[k] * w1
                            p[2] = alpha[k] * u[2] + beta[k] * v[2] + gamma[k] * w2
                            nearest(
                                p,
                                gate2[k],
                                direction,
                                box,
                                offset,
                                start,
                                rows,
                                used[:stars],
                                found,
                                cells,
                            )
                            if found[0] >= 0:
                                match[k] = found[0]
                                used[stars] = found[0]
                                stars += 1
                        if stars < 3:
                            continue
                        inside = True
                        for k in range(n):
                            if match[k] >= 0 and not within(
                                match[k], direction, axis, least, most, polar
                            ):
                                if k == i or k == j:
                                    inside = False
                                match[k] = -1
                                stars -= 1
                        if not inside or stars < 3:
                            continue
                        if _known(match, hypotheses, count):
                            continue
                        before = count
                        count, rest = _consider(
                            observed,
                            magnitude,
                            sigma_rad,
                            weight,
                            reference_sigma,
                            log_density,
                            direction,
                            zone_magnitude,
                            box,
                            offset,
                            start,
                            rows,
                            axis,
                            least,
                            most,
                            polar,
                            velocity,
                            prior_kind,
                            prior_axis,
                            match,
                            t,
                            references,
                            found,
                            cells,
                            hypotheses,
                            log_weight,
                            count,
                            rest,
                        )
                        for h in range(before, count):
                            best = max(best, log_weight[h])
                        if best > enough and not exhaustive:
                            done = True
                            break
                    if work >= MAX_WORK:
                        bounded = done = True
                    if done:
                        break
        for x in range(s):
            if group[x] == right:
                group[x] = left
        groups -= 1

    if not bounded and best <= enough:
        count, rest, work, bounded = _two_stars(
            observed,
            magnitude,
            weight,
            reference_sigma,
            log_density,
            direction,
            zone_magnitude,
            pair_brighter,
            pair_dimmer,
            axis,
            least,
            most,
            polar,
            velocity,
            prior_kind,
            prior_axis,
            seeds,
            first_pair,
            last_pair,
            match,
            t,
            references,
            hypotheses,
            log_weight,
            count,
            rest,
            work,
        )
    return count, rest, work, bounded


@njit(cache=True, nogil=True)
def _seeds(magnitude, n):  # type: ignore[no-untyped-def]
    """The stars whose pairs are scanned: all, or the brightest; those without a magnitude last."""
    ranked = np.argsort(np.where(np.isnan(magnitude), 99.0, magnitude), kind="mergesort")
    return np.sort(ranked[: min(n, MAX_SEEDS)])


@njit(cache=True, nogil=True)
def _candidates(observed, sigma_rad, seeds, pair_separation, bin_start, bins_per_rad):  # type: ignore[no-untyped-def]
    """Per pair of seeds the range of candidate pairs by separation, and the separation."""
    s = len(seeds)
    first = np.zeros((s, s), np.int64)
    last = np.zeros((s, s), np.int64)
    separation = np.zeros((s, s))
    for x in range(s):
        for y in range(x + 1, s):
            i, j = seeds[x], seeds[y]
            angle = separation_rad(observed[i], observed[j])
            gate = PREDICTION_GATE * math.sqrt(sigma_rad[i] ** 2 + sigma_rad[j] ** 2)
            first[x, y] = _first_at(angle - gate, pair_separation, bin_start, bins_per_rad)
            last[x, y] = _first_at(angle + gate, pair_separation, bin_start, bins_per_rad)
            separation[x, y] = angle
    return first, last, separation


@njit(cache=True, nogil=True)
def _first_at(angle, pair_separation, bin_start, bins_per_rad):  # type: ignore[no-untyped-def]
    """The first pair not closer than an angle."""
    k = min(max(int(angle * bins_per_rad), 0), len(bin_start) - 1)
    at = bin_start[k]
    while at > 0 and pair_separation[at - 1] >= angle:
        at -= 1
    while at < len(pair_separation) and pair_separation[at] < angle:
        at += 1
    return at


@njit(cache=True, nogil=True)
def _cheapest(group, first, last, separation):  # type: ignore[no-untyped-def]
    """The two groups whose cross pairs cost least to scan.

    Short pairs predict badly and cost more than their number.
    """
    s = len(group)
    cost = np.full((s, s), -1.0)
    for x in range(s):
        for y in range(x + 1, s):
            low, high = min(group[x], group[y]), max(group[x], group[y])
            if low == high:
                continue
            if cost[low, high] < 0.0:
                cost[low, high] = 0.0
            apart = max(separation[x, y], 1e-6)
            cost[low, high] += (last[x, y] - first[x, y]) * (1.0 + (SHORT_PAIR_RAD / apart) ** 2)
    left = right = -1
    least = math.inf
    for low in range(s):
        for high in range(low + 1, s):
            if 0.0 <= cost[low, high] < least:
                least, left, right = cost[low, high], low, high
    return left, right


@njit(cache=True, nogil=True)
def _predictors(observed, sigma_rad, i, j, alpha, beta, gamma, gate, order):  # type: ignore[no-untyped-def]
    """Write every other star as alpha V_i + beta V_j + gamma V_i x V_j; those first that this fixes best.

    A catalog pair (a, b) in the place of (i, j) then puts it at
    alpha a + beta b + gamma a x b, without an attitude.
    """
    vi, vj = observed[i], observed[j]
    cosine = vi[0] * vj[0] + vi[1] * vj[1] + vi[2] * vj[2]
    c0 = vi[1] * vj[2] - vi[2] * vj[1]
    c1 = vi[2] * vj[0] - vi[0] * vj[2]
    c2 = vi[0] * vj[1] - vi[1] * vj[0]
    sine2 = c0 * c0 + c1 * c1 + c2 * c2
    others = 0
    if sine2 <= 0.0:
        return others
    for k in range(len(observed)):
        if k in (i, j):
            continue
        v = observed[k]
        di = v[0] * vi[0] + v[1] * vi[1] + v[2] * vi[2]
        dj = v[0] * vj[0] + v[1] * vj[1] + v[2] * vj[2]
        alpha[k] = (di - cosine * dj) / sine2
        beta[k] = (dj - cosine * di) / sine2
        gamma[k] = (v[0] * c0 + v[1] * c1 + v[2] * c2) / sine2
        spread = (
            sigma_rad[k] ** 2
            + (alpha[k] ** 2 + gamma[k] ** 2) * sigma_rad[i] ** 2
            + (beta[k] ** 2 + gamma[k] ** 2) * sigma_rad[j] ** 2
        )
        gate[k] = min(PREDICTION_GATE * math.sqrt(spread), LARGEST_GATE_RAD)
        at = others
        while at > 0 and gate[order[at - 1]] > gate[k]:
            order[at] = order[at - 1]
            at -= 1
        order[at] = k
        others += 1
    return others


@njit(cache=True, nogil=True)
def _known(match, hypotheses, count):  # type: ignore[no-untyped-def]
    for h in range(count):
        same = True
        for k in range(len(match)):
            if hypotheses[h, k] != match[k]:
                same = False
                break
        if same:
            return True
    return False


@njit(cache=True, nogil=True)
def _log_sum(a, b):  # type: ignore[no-untyped-def]
    top = max(a, b)
    return top if top == -math.inf else top + math.log(math.exp(a - top) + math.exp(b - top))


@njit(cache=True, nogil=True)
def _keep(match, value, hypotheses, log_weight, count, rest):  # type: ignore[no-untyped-def]
    """Keep a weighed hypothesis; where there is no room, the lightest goes to the rest."""
    if value == -math.inf:
        return count, rest
    if count < len(log_weight):
        hypotheses[count] = match
        log_weight[count] = value
        return count + 1, rest
    lightest = np.argmin(log_weight)
    if value <= log_weight[lightest]:
        return count, _log_sum(rest, value)
    rest = _log_sum(rest, log_weight[lightest])
    hypotheses[lightest] = match
    log_weight[lightest] = value
    return count, rest


@njit(cache=True, nogil=True)
def _weigh(  # type: ignore[no-untyped-def]
    observed,
    magnitude,
    weight,
    reference_sigma,
    log_density,
    direction,
    zone_magnitude,
    velocity,
    prior_kind,
    prior_axis,
    match,
    t,
    references,
):
    """The log weight of a hypothesis, fitted; T is left in `t`."""
    stars, square, log_det = fit(observed, weight, direction, velocity, match, t, references)
    if stars < 2:
        return -math.inf
    compared = clutter = 0
    total = total2 = log_relative = 0.0
    for k in range(len(match)):
        if match[k] >= 0:
            log_relative += math.log(weight[k])
        if magnitude[k] != magnitude[k]:
            continue
        if match[k] < 0:
            clutter += 1
            continue
        difference = magnitude[k] - zone_magnitude[match[k]]
        compared += 1
        total += difference
        total2 += difference * difference
    return (
        evidence.log_prior(prior_angle(t, prior_axis, prior_kind), prior_kind)
        + evidence.log_positions(stars, square, log_det, reference_sigma)
        + log_relative
        + evidence.log_magnitudes(compared, total, total2)
        + evidence.log_clutter(len(match) - stars, stars)
        - clutter * math.log(evidence.CLUTTER_SPAN_MAG)
        - stars * log_density
    )


@njit(cache=True, nogil=True)
def _consider(  # type: ignore[no-untyped-def]
    observed,
    magnitude,
    sigma_rad,
    weight,
    reference_sigma,
    log_density,
    direction,
    zone_magnitude,
    box,
    offset,
    start,
    rows,
    axis,
    least,
    most,
    polar,
    velocity,
    prior_kind,
    prior_axis,
    match,
    t,
    references,
    found,
    cells,
    hypotheses,
    log_weight,
    count,
    rest,
):
    """Fit a hypothesis, match all stars anew at its attitude, weigh it and what stands next to it.

    Next to it stand the hypotheses without one of its stars, and with a star's
    second-nearest neighbour in its place.
    """
    n = len(match)
    if fit(observed, weight, direction, velocity, match, t, references)[0] == 0:
        return count, rest
    p = np.empty(3)
    second = np.full(n, -1, np.int32)
    fresh = np.full(n, -1, np.int32)
    for k in range(n):
        for j in range(3):
            p[j] = t[0, j] * observed[k, 0] + t[1, j] * observed[k, 1] + t[2, j] * observed[k, 2]
        norm = 0.0
        for j in range(3):
            p[j] -= velocity[j]
            norm += p[j] * p[j]
        norm = math.sqrt(norm)
        for j in range(3):
            p[j] /= norm
        gate = min(MATCH_GATE * sigma_rad[k], LARGEST_GATE_RAD)
        nearest(p, gate, direction, box, offset, start, rows, fresh[:k], found, cells)
        if found[0] >= 0 and within(found[0], direction, axis, least, most, polar):
            fresh[k] = found[0]
        if found[1] >= 0 and within(found[1], direction, axis, least, most, polar):
            second[k] = found[1]
    if _known(fresh, hypotheses, count):
        return count, rest
    base = _weigh(
        observed,
        magnitude,
        weight,
        reference_sigma,
        log_density,
        direction,
        zone_magnitude,
        velocity,
        prior_kind,
        prior_axis,
        fresh,
        t,
        references,
    )
    count, rest = _keep(fresh, base, hypotheses, log_weight, count, rest)
    if base < rest - NEGLIGIBLE:
        return count, rest
    for k in range(n):
        if fresh[k] < 0:
            continue
        mine = fresh[k]
        for other in (np.int32(-1), second[k]):
            taken = False
            for x in range(n):
                if other >= 0 and fresh[x] == other:
                    taken = True
            if taken:
                continue
            fresh[k] = other
            if not _known(fresh, hypotheses, count):
                value = _weigh(
                    observed,
                    magnitude,
                    weight,
                    reference_sigma,
                    log_density,
                    direction,
                    zone_magnitude,
                    velocity,
                    prior_kind,
                    prior_axis,
                    fresh,
                    t,
                    references,
                )
                count, rest = _keep(fresh, value, hypotheses, log_weight, count, rest)
            if second[k] == -1:
                break
        fresh[k] = mine
    return count, rest


@njit(cache=True, nogil=True)
def _two_stars(  # type: ignore[no-untyped-def]
    observed,
    magnitude,
    weight,
    reference_sigma,
    log_density,
    direction,
    zone_magnitude,
    pair_brighter,
    pair_dimmer,
    axis,
    least,
    most,
    polar,
    velocity,
    prior_kind,
    prior_axis,
    seeds,
    first_pair,
    last_pair,
    match,
    t,
    references,
    hypotheses,
    log_weight,
    count,
    rest,
    work,
):
    """The hypotheses of two stars alone, where no larger one outweighs what chance can do."""
    n = len(observed)
    s = len(seeds)
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
                if magnitude[k] == magnitude[k]:
                    compared += 1
            clutter = 0
            for k in range(n):
                if k != i and k != j and magnitude[k] == magnitude[k]:
                    clutter += 1
            most_log = (
                evidence.log_positions(2, 0.0, math.log(sine * sine), reference_sigma)
                + evidence.log_magnitudes(compared, 0.0, 0.0)
                + evidence.log_clutter(n - 2, 2)
                - clutter * math.log(evidence.CLUTTER_SPAN_MAG)
                - 2 * log_density
            )
            for c in range(first_pair[x, y], last_pair[x, y]):
                work += 1
                if work >= MAX_WORK:
                    return count, rest, work, True
                for swap in range(2):
                    a, b = pair_brighter[c], pair_dimmer[c]
                    if swap == 1:
                        a, b = b, a
                    if prior_kind == PRIOR_ROTATION:
                        # No rotation moves a star farther than its own angle.
                        shift = max(
                            separation_rad(observed[i], direction[a]),
                            separation_rad(observed[j], direction[b]),
                        )
                    else:
                        shift = max(
                            abs(
                                separation_rad(observed[i], prior_axis)
                                - separation_rad(direction[a], prior_axis)
                            ),
                            abs(
                                separation_rad(observed[j], prior_axis)
                                - separation_rad(direction[b], prior_axis)
                            ),
                        )
                    if most_log + evidence.log_prior(shift, prior_kind) < top - NEGLIGIBLE:
                        continue
                    if not within(a, direction, axis, least, most, polar) or not within(
                        b, direction, axis, least, most, polar
                    ):
                        continue
                    match[:] = -1
                    match[i], match[j] = a, b
                    if _known(match, hypotheses, count):
                        continue
                    value = _weigh(
                        observed,
                        magnitude,
                        weight,
                        reference_sigma,
                        log_density,
                        direction,
                        zone_magnitude,
                        velocity,
                        prior_kind,
                        prior_axis,
                        match,
                        t,
                        references,
                    )
                    if value < top - NEGLIGIBLE:
                        rest = _log_sum(rest, value)
                    else:
                        count, rest = _keep(match, value, hypotheses, log_weight, count, rest)
                        top = max(top, value)
    return count, rest, work, False


@njit(cache=True, nogil=True)
def marginals(hypotheses, log_weight, count, rest, star, probability, none, rivals):  # type: ignore[no-untyped-def]
    """Per star: the likeliest zone row and its probability, that of no star, and the rows in question.

    `rivals` (n, R) gets the rows by falling probability, -1 beyond the last.
    """
    n, room = rivals.shape
    top = rest
    for h in range(count):
        top = max(top, log_weight[h])
    total = math.exp(rest - top)
    for h in range(count):
        total += math.exp(log_weight[h] - top)
    rows = np.empty(count + 1, np.int64)
    share = np.empty(count + 1)
    for k in range(n):
        different = 0
        nothing = math.exp(rest - top)
        for h in range(count):
            w = math.exp(log_weight[h] - top)
            row = hypotheses[h, k]
            if row < 0:
                nothing += w
                continue
            at = 0
            while at < different and rows[at] != row:
                at += 1
            if at == different:
                rows[at], share[at] = row, 0.0
                different += 1
            share[at] += w
        none[k] = nothing / total
        star[k], probability[k] = -1, 0.0
        ranked = np.argsort(-share[:different])
        for at in range(room):
            rivals[k, at] = -1
            if at < different and share[ranked[at]] / total >= RIVAL_PROBABILITY:
                rivals[k, at] = rows[ranked[at]]
        if different:
            star[k] = rows[ranked[0]]
            probability[k] = share[ranked[0]] / total
