"""An attitude and the points that it explains: matched, fitted and matched again until stable."""

import math

import numpy as np
from numba import njit

from service.attitude.kernels import inverse_symmetric
from service.identify.fitting import turn
from service.identify.hypotheses import log_sum
from service.identify.lost_in_space import weighing
from service.sky.sky_index import patch_of
from service.sky.star_grid import CELL

MATCH_GATE = 4.5
"""In sigmas of a point's own noise and of the attitude at its place."""
LARGEST_GATE_RAD = 0.006
ROUNDS = 5
HOPELESS = -4.0
"""Log evidence of the points alone, before the last fit, that no further fit makes good."""
EDGE = 0.985
"""A star is expected in the field only within this share of its half widths."""


@njit(cache=True, nogil=True, error_model="numpy")
def nearest_stars(  # type: ignore[no-untyped-def]
    stars, faces, cell_start, cell_rows, x, y, z, gate, brightest, faintest
):
    """The two stars nearest to a direction of length one, within a gate and two magnitudes.

    The arrays are those of the index, one by one: to hand over all of them
    costs more than the look-up.

    Returns the rows, -1 where there is none, and the nearer one's chord^2.
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
    # As `star_grid.cells_about`: the projection stretches an angle by at most 1 + u^2 + v^2.
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
            row = np.int64(cell_rows[at])
            dx = stars[row, 0] - x
            dy = stars[row, 1] - y
            dz = stars[row, 2] - z
            chord2 = dx * dx + dy * dy + dz * dz
            if chord2 >= second:
                continue
            # Written so that an unknown magnitude passes.
            if stars[row, 3] < brightest or stars[row, 3] > faintest:
                continue
            if chord2 < best:
                second, other = best, nearest
                best, nearest = chord2, row
            else:
                second, other = chord2, row
    return nearest, other, best


@njit(cache=True, nogil=True)
def faintest_star(index, magnitude, gate):  # type: ignore[no-untyped-def]
    """How faint a point's star may be; of unknown magnitude none beyond the limit of pairs."""
    return index.class_edge[-1, 0] if np.isnan(magnitude) else magnitude + gate


@njit(cache=True, nogil=True, error_model="numpy")
def fit(points, index, match, t, inverse):  # type: ignore[no-untyped-def]
    """One Gauss-Newton step of T towards the matched stars.

    Returns chi^2 before the step and ln det N, the latter -inf where the
    geometry gives no attitude.  `inverse` gets the covariance, radians^2.
    """
    matrix = np.zeros((3, 3))
    g0 = g1 = g2 = chi2 = 0.0
    moving = points.velocity[0] != 0.0 or points.velocity[1] != 0.0 or points.velocity[2] != 0.0
    for k in range(len(match)):
        row = match[k]
        if row < 0:
            continue
        r0, r1, r2 = index.stars[row, 0], index.stars[row, 1], index.stars[row, 2]
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
        matrix[0, 0] += w * (1.0 - p0 * p0)
        matrix[1, 1] += w * (1.0 - p1 * p1)
        matrix[2, 2] += w * (1.0 - p2 * p2)
        matrix[0, 1] -= w * p0 * p1
        matrix[0, 2] -= w * p0 * p2
        matrix[1, 2] -= w * p1 * p2
    matrix[1, 0], matrix[2, 0], matrix[2, 1] = matrix[0, 1], matrix[0, 2], matrix[1, 2]
    det = (
        matrix[0, 0] * (matrix[1, 1] * matrix[2, 2] - matrix[1, 2] ** 2)
        - matrix[0, 1] * (matrix[0, 1] * matrix[2, 2] - matrix[1, 2] * matrix[0, 2])
        + matrix[0, 2] * (matrix[0, 1] * matrix[1, 2] - matrix[1, 1] * matrix[0, 2])
    )
    if not det > 0.0 or not inverse_symmetric(matrix, inverse):
        return chi2, -math.inf
    e0 = inverse[0, 0] * g0 + inverse[0, 1] * g1 + inverse[0, 2] * g2
    e1 = inverse[1, 0] * g0 + inverse[1, 1] * g1 + inverse[1, 2] * g2
    e2 = inverse[2, 0] * g0 + inverse[2, 1] * g1 + inverse[2, 2] * g2
    # What the step takes away from chi^2.
    chi2 -= e0 * g0 + e1 * g1 + e2 * g2
    turn(t, e0, e1, e2)
    return max(chi2, 0.0), math.log(det)


@njit(cache=True, nogil=True, error_model="numpy")
def match_at(points, index, magnitude_gate, t, covariance, match):  # type: ignore[no-untyped-def]
    """Match every point at an attitude known to a covariance; how many, and whether any changed."""
    stars, faces = index.stars, index.face
    cell_start, cell_rows = index.cell_start, index.cell_rows
    velocity, sigma = points.velocity, points.sigma
    trace = covariance[0, 0] + covariance[1, 1] + covariance[2, 2]
    matched, changed = 0, False
    n = len(match)
    near = np.empty(n)
    for k in range(n):
        b = points.observed[k]
        x = t[0, 0] * b[0] + t[1, 0] * b[1] + t[2, 0] * b[2] - velocity[0]
        y = t[0, 1] * b[0] + t[1, 1] * b[1] + t[2, 1] * b[2] - velocity[1]
        z = t[0, 2] * b[0] + t[1, 2] * b[1] + t[2, 2] * b[2] - velocity[2]
        norm = 1.0 / math.sqrt(x * x + y * y + z * z)
        # What the attitude's error moves here: trace of [b x] P [b x]^T, over two axes, at worst.
        spread = trace
        for i in range(3):
            for j in range(3):
                spread -= b[i] * covariance[i, j] * b[j]
        gate = MATCH_GATE * math.sqrt(sigma[k] * sigma[k] + spread)
        row = -1
        if gate <= LARGEST_GATE_RAD:
            m = points.magnitude[k]
            row, _, chord2 = nearest_stars(
                *(stars, faces, cell_start, cell_rows),
                *(x * norm, y * norm, z * norm, gate),
                *(m - magnitude_gate, faintest_star(index, m, magnitude_gate)),
            )
            near[k] = chord2 / (gate * gate)
        for other in range(k):
            if row >= 0 and match[other] == row:
                # One star is one point: the nearer one.
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


@njit(cache=True, nogil=True, error_model="numpy")
def settle(points, index, field, magnitude_gate, t, covariance, match):  # type: ignore[no-untyped-def]
    """Fit to the match given, then match and fit until nothing changes.

    Returns the number of stars and the log evidence, -inf where there is no
    attitude; `t`, `covariance` and `match` get what was settled on.
    """
    chi2, log_det = fit(points, index, match, t, covariance)
    if log_det == -math.inf:
        return 0, -math.inf
    matched = 0
    for attempt in range(ROUNDS):
        matched, changed = match_at(points, index, magnitude_gate, t, covariance, match)
        if matched < 3:
            return matched, -math.inf
        if attempt == 0:
            at_most, _, _ = points_alone(points, index, field, match, matched, chi2, log_det)
            if at_most < HOPELESS:
                return matched, -math.inf
        if not changed:
            break
        chi2, log_det = fit(points, index, match, t, covariance)
        if log_det == -math.inf:
            return 0, -math.inf
    return matched, evidence(points, index, field, t, match, matched, chi2, log_det)


@njit(cache=True, nogil=True, error_model="numpy")
def points_alone(points, index, field, match, matched, chi2, log_det):  # type: ignore[no-untyped-def]
    """The evidence without what stars are missing, which can only be less.

    Also the number of magnitudes compared and the faintest star matched.
    """
    n = len(match)
    stars = index.stars
    log_spots = total = square = any_magnitude = 0.0
    compared = 0
    faintest_point, faintest = -math.inf, -math.inf
    for k in range(n):
        if points.magnitude[k] > faintest_point:
            faintest_point = points.magnitude[k]
    for k in range(n):
        row = match[k]
        if row < 0:
            continue
        log_spots += math.log(field.area / (2.0 * math.pi * points.sigma[k] ** 2))
        faintest = max(faintest, stars[row, 3])
        if not np.isnan(points.magnitude[k]):
            difference = points.magnitude[k] - stars[row, 3]
            compared += 1
            total += difference
            square += difference * difference
            any_magnitude += weighing.log_any_magnitude(points.magnitude[k], faintest_point)
    weight = (
        weighing.log_positions(matched, log_spots, chi2, log_det)
        + weighing.log_labels(n, matched)
        + weighing.log_magnitudes(compared, total, square, field.magnitude_sigma)
        - any_magnitude
    )
    return weight, compared, faintest


@njit(cache=True, nogil=True, error_model="numpy")
def evidence(points, index, field, t, match, matched, chi2, log_det):  # type: ignore[no-untyped-def]
    """The log weight of a fitted match against all points being clutter; see `weighing`.

    Exact where it is above zero; below, the search for missing stars may end early.
    """
    weight, compared, faintest = points_alone(points, index, field, match, matched, chi2, log_det)
    if weight < 0.0:
        return weight
    n = len(match)
    stars, patch_rows = index.stars, index.patch_rows
    # The field: stars that should be seen, in order of brightness.
    limit = field.limit_mag
    if np.isnan(limit):
        limit = -math.inf
        for k in range(n):
            if points.magnitude[k] > limit:
                limit = points.magnitude[k]
    log_missing, expected = 0.0, 0
    sigma_mag = field.magnitude_sigma
    reach = limit + weighing.FAINT_REACH * sigma_mag
    if not reach > faintest:
        reach = faintest
    patch = patch_of(t[2])
    for at in range(index.patch_start[patch], index.patch_start[patch + 1]):
        row = patch_rows[at]
        if stars[row, 3] > reach:
            break
        r = stars[row]
        z = t[2, 0] * r[0] + t[2, 1] * r[1] + t[2, 2] * r[2]
        if z < field.cos_radius:
            continue
        x = t[0, 0] * r[0] + t[0, 1] * r[1] + t[0, 2] * r[2]
        y = t[1, 0] * r[0] + t[1, 1] * r[1] + t[1, 2] * r[2]
        if abs(x) > EDGE * field.tan_x * z or abs(y) > EDGE * field.tan_y * z:
            continue
        if stars[row, 3] <= faintest:
            expected += 1
        taken = False
        for k in range(n):
            if match[k] == row:
                taken = True
                break
        if taken:
            continue
        log_missing += weighing.log_missing((limit - stars[row, 3]) / sigma_mag)
        if compared < matched or log_missing < -weight:
            shares = weighing.log_any_share(matched, max(expected, matched))
            if shares < -weight:
                return -1.0
    shares = weighing.log_any_share(matched, max(expected, matched))
    complete = -math.inf
    if compared == matched:
        complete = matched * math.log(weighing.DETECTED) + log_missing
    return weight + log_sum(shares, complete) - math.log(2.0)
