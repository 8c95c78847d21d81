"""Refinement of an attitude: points are matched to stars and fitted until the match is stable."""

import math

import numpy as np

from service.attitude.covariance import inverse_symmetric
from service.compiled.jit import njit
from service.identify.hypotheses.evidence import log_sum
from service.identify.hypotheses.fitting import turn
from service.identify.lost_in_space import posterior
from service.sky.geometry.star_grid import CELL
from service.sky.whole_sky.index import patch_of

MATCH_GATE = 4.5
"""Largest distance of a star from a point, in sigmas of the point and the attitude."""
LARGEST_GATE_RAD = 0.006
ROUNDS = 5
REJECT_LOG = -4.0
"""Log evidence of the points, before the last fit, below which a candidate is dropped."""
EDGE = 0.985
"""Share of a field's half widths within which a star is expected to be seen."""


@njit(nogil=True, error_model="numpy", forceinline=True)
def nearest_stars(  # type: ignore[no-untyped-def]
    cell_place, faces, cell_start, cell_rows, x, y, z, gate, brightest, faintest
):
    """The two stars nearest to a unit direction, within a gate and between two magnitudes.

    The index arrays are passed one by one, since passing their tuple costs more than the look-up.

    Returns the stars' rows, -1 for none, and the nearer one's squared chord.
    """
    ax, ay, az = abs(x), abs(y), abs(z)
    if ax >= ay and ax >= az:
        face, u, v, depth = (0 if x > 0.0 else 1), y, z, ax
    elif ay >= az:
        face, u, v, depth = (2 if y > 0.0 else 3), z, x, ay
    else:
        face, u, v, depth = (4 if z > 0.0 else 5), x, y, az
    u /= depth
    v /= depth
    # As in `star_grid.cells_about`: the projection stretches an angle by at most 1 + u^2 + v^2.
    reach = gate * (1.0 + u * u + v * v)
    low_u, low_v = faces[face, 0], faces[face, 1]
    size_u, size_v = faces[face, 2], faces[face, 3]
    first_u = max(math.floor((u - reach) / CELL) - low_u, 0)
    last_u = min(math.floor((u + reach) / CELL) - low_u, size_u - 1)
    first_v = max(math.floor((v - reach) / CELL) - low_v, 0)
    last_v = min(math.floor((v + reach) / CELL) - low_v, size_v - 1)
    nearest = other = np.int64(-1)
    best = second = gate * gate
    if last_v < first_v:
        return nearest, other, best
    for cu in range(first_u, last_u + 1):
        base = faces[face, 4] + cu * size_v
        for at in range(cell_start[base + first_v], cell_start[base + last_v + 1]):
            dx, dy, dz = cell_place[at, 0] - x, cell_place[at, 1] - y, cell_place[at, 2] - z
            chord2 = dx * dx + dy * dy + dz * dz
            if chord2 >= second:
                continue
            # The comparison lets unknown magnitudes (NaN) pass.
            if cell_place[at, 3] < brightest or cell_place[at, 3] > faintest:
                continue
            row = np.int64(cell_rows[at])
            if chord2 < best:
                second, other = best, nearest
                best, nearest = chord2, row
            else:
                second, other = chord2, row
    return nearest, other, best


@njit(nogil=True)
def faintest_star(limit_mag, magnitude, gate):  # type: ignore[no-untyped-def]
    """Faintest star that can match a point; the pairs' limit where its magnitude is unknown."""
    return limit_mag if np.isnan(magnitude) else magnitude + gate


@njit(nogil=True, error_model="numpy", forceinline=True)
def gauss_newton_step(points, stars, candidate):  # type: ignore[no-untyped-def]
    """One Gauss-Newton step of an attitude T towards its matched stars.

    Returns chi^2 before the step and ln det N, the latter -inf where the geometry gives no
    attitude. The candidate's covariance becomes that of the fit, radians^2.
    """
    match, t, matrix, inverse = candidate.match, candidate.t, candidate.matrix, candidate.covariance
    m00 = m11 = m22 = m01 = m02 = m12 = 0.0
    g0 = g1 = g2 = chi2 = 0.0
    moving = points.velocity[0] != 0.0 or points.velocity[1] != 0.0 or points.velocity[2] != 0.0
    for k in range(len(match)):
        row = match[k]
        if row < 0:
            continue
        r0, r1, r2 = stars[row, 0], stars[row, 1], stars[row, 2]
        if moving:
            r0 += points.velocity[0]
            r1 += points.velocity[1]
            r2 += points.velocity[2]
            norm = 1.0 / math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
            r0, r1, r2 = r0 * norm, r1 * norm, r2 * norm
        p0 = t[0, 0] * r0 + t[0, 1] * r1 + t[0, 2] * r2
        p1 = t[1, 0] * r0 + t[1, 1] * r1 + t[1, 2] * r2
        p2 = t[2, 0] * r0 + t[2, 1] * r1 + t[2, 2] * r2
        w = 1.0 / (points.sigma[k] * points.sigma[k])
        d0 = points.observed[k, 0] - p0
        d1 = points.observed[k, 1] - p1
        d2 = points.observed[k, 2] - p2
        chi2 += w * (d0 * d0 + d1 * d1 + d2 * d2)
        g0 += w * (d1 * p2 - d2 * p1)
        g1 += w * (d2 * p0 - d0 * p2)
        g2 += w * (d0 * p1 - d1 * p0)
        m00 += w * (1.0 - p0 * p0)
        m11 += w * (1.0 - p1 * p1)
        m22 += w * (1.0 - p2 * p2)
        m01 -= w * p0 * p1
        m02 -= w * p0 * p2
        m12 -= w * p1 * p2
    matrix[0, 0], matrix[1, 1], matrix[2, 2] = m00, m11, m22
    matrix[0, 1] = matrix[1, 0] = m01
    matrix[0, 2] = matrix[2, 0] = m02
    matrix[1, 2] = matrix[2, 1] = m12
    det = (
        m00 * (m11 * m22 - m12 * m12)
        - m01 * (m01 * m22 - m12 * m02)
        + m02 * (m01 * m12 - m11 * m02)
    )
    if not det > 0.0 or not inverse_symmetric(matrix, inverse):
        return chi2, -math.inf
    e0 = inverse[0, 0] * g0 + inverse[0, 1] * g1 + inverse[0, 2] * g2
    e1 = inverse[1, 0] * g0 + inverse[1, 1] * g1 + inverse[1, 2] * g2
    e2 = inverse[2, 0] * g0 + inverse[2, 1] * g1 + inverse[2, 2] * g2
    # The decrease of chi^2 by the step.
    chi2 -= e0 * g0 + e1 * g1 + e2 * g2
    turn(t, e0, e1, e2)
    return max(chi2, 0.0), math.log(det)


@njit(nogil=True, error_model="numpy", forceinline=True)
def match_at(points, index, magnitude_gate, candidate):  # type: ignore[no-untyped-def]
    """Match every point at an attitude; returns the number matched, and true if a match changed."""
    faces, cell_place = index.face, index.cell_place
    cell_start, cell_rows = index.cell_start, index.cell_rows
    limit_mag = index.class_edge[-1, 0]
    velocity, sigma, observed = points.velocity, points.sigma, points.observed
    match, near, t, p = candidate.match, candidate.near, candidate.t, candidate.covariance
    trace = p[0, 0] + p[1, 1] + p[2, 2]
    matched, changed = 0, False
    for k in range(len(match)):
        b0, b1, b2 = observed[k, 0], observed[k, 1], observed[k, 2]
        x = t[0, 0] * b0 + t[1, 0] * b1 + t[2, 0] * b2 - velocity[0]
        y = t[0, 1] * b0 + t[1, 1] * b1 + t[2, 1] * b2 - velocity[1]
        z = t[0, 2] * b0 + t[1, 2] * b1 + t[2, 2] * b2 - velocity[2]
        norm = 1.0 / math.sqrt(x * x + y * y + z * z)
        # The attitude's error at this place: trace of [b x] P [b x]^T over two axes, at worst.
        spread = trace - (p[0, 0] * b0 * b0 + p[1, 1] * b1 * b1 + p[2, 2] * b2 * b2)
        spread -= 2.0 * (p[0, 1] * b0 * b1 + p[0, 2] * b0 * b2 + p[1, 2] * b1 * b2)
        gate = MATCH_GATE * math.sqrt(sigma[k] * sigma[k] + spread)
        row = -1
        if gate <= LARGEST_GATE_RAD:
            m = points.magnitude[k]
            row, _, chord2 = nearest_stars(
                *(cell_place, faces, cell_start, cell_rows),
                *(x * norm, y * norm, z * norm, gate),
                *(m - magnitude_gate, faintest_star(limit_mag, m, magnitude_gate)),
            )
            near[k] = chord2 / (gate * gate)
        for other in range(k):
            if row >= 0 and match[other] == row:
                # A star matches one point only: the nearer one.
                if near[other] <= near[k]:
                    row = -1
                else:
                    match[other] = -1
                    matched -= 1
                    changed = True
        if match[k] != row:
            match[k] = row
            changed = True
        if row >= 0:
            matched += 1
    return matched, changed


@njit(nogil=True, error_model="numpy")
def refine(points, index, field, magnitude_gate, candidate):  # type: ignore[no-untyped-def]
    """Fit an attitude to its match, then match and fit again until nothing changes.

    Returns the number of matched stars and the log evidence, -inf if there is no attitude;
    `candidate` gets the result.
    """
    chi2, log_det = gauss_newton_step(points, index.stars, candidate)
    if log_det == -math.inf:
        return 0, -math.inf
    matched = 0
    for attempt in range(ROUNDS):
        matched, changed = match_at(points, index, magnitude_gate, candidate)
        if matched < 3:
            return matched, -math.inf
        if attempt == 0:
            at_most, _, _ = points_alone(
                points, index.stars, field, candidate.match, matched, chi2, log_det
            )
            if at_most < REJECT_LOG:
                return matched, -math.inf
        if not changed:
            break
        chi2, log_det = gauss_newton_step(points, index.stars, candidate)
        if log_det == -math.inf:
            return 0, -math.inf
    return matched, evidence(points, index, field, candidate, matched, chi2, log_det)


@njit(nogil=True, error_model="numpy", forceinline=True)
def points_alone(points, stars, field, match, matched, chi2, log_det):  # type: ignore[no-untyped-def]
    """The log evidence of an attitude without the missing stars, which can only reduce it.

    Also returns the number of compared magnitudes and the faintest matched star.
    """
    n = len(match)
    log_spots = total = square = any_magnitude = 0.0
    compared = 0
    sigma, log_spot = -1.0, 0.0
    faintest_point, faintest = -math.inf, -math.inf
    for k in range(n):
        if points.magnitude[k] > faintest_point:
            faintest_point = points.magnitude[k]
    for k in range(n):
        row = match[k]
        if row < 0:
            continue
        # Usually all points have the same sigma.
        if points.sigma[k] != sigma:
            sigma = points.sigma[k]
            log_spot = math.log(field.area / (2.0 * math.pi * sigma * sigma))
        log_spots += log_spot
        faintest = max(faintest, stars[row, 3])
        if not np.isnan(points.magnitude[k]):
            difference = points.magnitude[k] - stars[row, 3]
            compared += 1
            total += difference
            square += difference * difference
            any_magnitude += posterior.log_any_magnitude(points.magnitude[k], faintest_point)
    weight = (
        posterior.log_positions(matched, log_spots, chi2, log_det)
        + posterior.log_labels(n, matched)
        + posterior.log_magnitudes(compared, total, square, field.magnitude_sigma)
        - any_magnitude
    )
    return weight, compared, faintest


@njit(nogil=True, error_model="numpy", forceinline=True)
def stars_inside(place, patch_rows, at, end, reach, t, field, inside):  # type: ignore[no-untyped-def]
    """Write the next stars of a patch inside a field to a buffer; returns their number and end.

    Written without branches on the data, so that memory accesses do not wait for each other.
    """
    x0, x1, x2 = np.float32(t[0, 0]), np.float32(t[0, 1]), np.float32(t[0, 2])
    y0, y1, y2 = np.float32(t[1, 0]), np.float32(t[1, 1]), np.float32(t[1, 2])
    z0, z1, z2 = np.float32(t[2, 0]), np.float32(t[2, 1]), np.float32(t[2, 2])
    wide, high = np.float32(EDGE * field.tan_x), np.float32(EDGE * field.tan_y)
    cosine = np.float32(field.cos_radius)
    count = 0
    last = min(end, at + len(inside))
    while at < last:
        row = patch_rows[at]
        r0, r1, r2 = place[row, 0], place[row, 1], place[row, 2]
        if place[row, 3] > reach:
            return count, end
        x, y, z = (
            x0 * r0 + x1 * r1 + x2 * r2,
            y0 * r0 + y1 * r1 + y2 * r2,
            z0 * r0 + z1 * r1 + z2 * r2,
        )
        inside[count] = row
        count += int((z >= cosine) & (abs(x) <= wide * z) & (abs(y) <= high * z))
        at += 1
    return count, at


@njit(nogil=True, error_model="numpy", forceinline=True)
def evidence(points, index, field, candidate, matched, chi2, log_det):  # type: ignore[no-untyped-def]
    """The log evidence of a fitted match against all points being clutter; see `posterior`.

    The value is exact if positive; otherwise the search for missing stars may end early.
    """
    match, t = candidate.match, candidate.t
    weight, compared, faintest = points_alone(
        points, index.stars, field, match, matched, chi2, log_det
    )
    if weight < 0.0:
        return weight
    n = len(match)
    place, patch_rows, inside = index.place, index.patch_rows, candidate.inside
    # Single precision, as the magnitudes that it is compared with.
    faintest = np.float32(faintest)
    # The stars that the field should show, in order of brightness.
    limit = field.limit_mag
    if np.isnan(limit):
        limit = -math.inf
        for k in range(n):
            if points.magnitude[k] > limit:
                limit = points.magnitude[k]
    log_missing, expected = 0.0, 0
    sigma_mag = field.magnitude_sigma
    reach = limit + posterior.FAINT_REACH * sigma_mag
    if not reach > faintest:
        reach = faintest
    patch = patch_of(t[2])
    at, end = np.int64(index.patch_start[patch]), np.int64(index.patch_start[patch + 1])
    while at < end:
        count, at = stars_inside(place, patch_rows, at, end, reach, t, field, inside)
        for which in range(count):
            row = inside[which]
            magnitude = place[row, 3]
            if magnitude <= faintest:
                expected += 1
            taken = False
            for k in range(n):
                if match[k] == row:
                    taken = True
                    break
            if taken:
                continue
            log_missing += posterior.log_missing((limit - magnitude) / sigma_mag)
            if compared < matched or log_missing < -weight:
                shares = posterior.log_any_share(matched, max(expected, matched))
                if shares < -weight:
                    return -1.0
    shares = posterior.log_any_share(matched, max(expected, matched))
    complete = -math.inf
    if compared == matched:
        complete = matched * math.log(posterior.DETECTED) + log_missing
    return weight + log_sum(shares, complete) - math.log(2.0)
