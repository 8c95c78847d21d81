"""Bare kernels: the work of the service's kernels without settings.

Arrays are ready and of one type, all output arrays are given, no test can be switched off, there
are no options and no reference counts.  The service's kernels take longer for settings, exact zones
on a grid, and warnings.
"""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit_no_refcount
from service.vectors import Matrix, Vector

Integers = npt.NDArray[np.int32]
Arrays = tuple[Any, ...]
"""Arrays of several types, in the order in which the first line of a kernel unpacks them."""


@njit_no_refcount
def _angle(a: Vector, b: Vector) -> float:
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    return 2.0 * math.asin(min(1.0, half))


@njit_no_refcount
def bare_votes(
    observed: Vector,
    observed_mag: Vector,
    direction: Vector,
    magnitude: Vector,
    separation: Vector,
    brighter: Integers,
    dimmer: Integers,
    bin_start: Integers,
    bins_per_rad: float,
    pole: Vector,
    settings: tuple[
        float, ...
    ],  # SEPTOL, XMTOL, TMAGMX, CAPMAX or BANMAX, BANTOL1, BANTOL2; radians, magnitudes
    is_band: bool,
    polar: Vector,  # (m,) of the zone's stars, in a band
    votes: Integers,  # (n, m)
    touched: Integers,  # room for the zone stars that got votes
    star: npt.NDArray[np.int64],  # (n,) the winner's zone row, -1 without one
) -> None:
    """Count the votes of steps 1 to 10 for about five stars, and their unique winners."""
    tolerance, mag_tolerance, order_tolerance, cross, pole_1, pole_2 = settings
    n = len(observed)
    count = 0
    for i in range(n - 1):
        for j in range(i + 1, n):
            seen = _angle(observed[i], observed[j])
            ox = observed[i, 1] * observed[j, 2] - observed[i, 2] * observed[j, 1]
            oy = observed[i, 2] * observed[j, 0] - observed[i, 0] * observed[j, 2]
            oz = observed[i, 0] * observed[j, 1] - observed[i, 1] * observed[j, 0]
            on = math.sqrt(ox * ox + oy * oy + oz * oz)
            bright, dim = (j, i) if observed_mag[j] < observed_mag[i] else (i, j)
            ordered = observed_mag[dim] - observed_mag[bright] >= order_tolerance
            polar_i = polar_j = 0.0
            if is_band:
                polar_i, polar_j = _angle(observed[i], pole), _angle(observed[j], pole)
            first = int((seen - tolerance) * bins_per_rad)
            if first > len(bin_start) - 2:
                continue
            for k in range(bin_start[max(first, 0)], len(separation)):
                if separation[k] > seen + tolerance:
                    break
                if separation[k] < seen - tolerance:
                    continue
                a, b = brighter[k], dimmer[k]
                order = 0
                if ordered:
                    if abs(observed_mag[bright] - magnitude[a]) > mag_tolerance:
                        continue
                    if abs(observed_mag[dim] - magnitude[b]) > mag_tolerance:
                        continue
                    order = 1 if bright == i else -1
                by_pole = False
                if is_band:
                    mine, theirs = abs(polar_i - polar_j), abs(polar[a] - polar[b])
                    if abs(mine - theirs) > pole_1:
                        continue
                    by_pole = mine > pole_1 and theirs > pole_1
                if by_pole:
                    high = max(polar_i, polar_j) - max(polar[a], polar[b])
                    low = min(polar_i, polar_j) - min(polar[a], polar[b])
                    if abs(high) > pole_2 or abs(low) > pole_2:
                        continue
                    told = 1 if (polar_i > polar_j) == (polar[a] > polar[b]) else -1
                    if order == -told:
                        continue
                    order = told
                else:
                    x = direction[a, 1] * direction[b, 2] - direction[a, 2] * direction[b, 1]
                    y = direction[a, 2] * direction[b, 0] - direction[a, 0] * direction[b, 2]
                    z = direction[a, 0] * direction[b, 1] - direction[a, 1] * direction[b, 0]
                    norm = math.sqrt(x * x + y * y + z * z)
                    cosine = (x * ox + y * oy + z * oz) / (norm * on)
                    turned = math.acos(max(-1.0, min(1.0, cosine)))
                    if order == 0:
                        if turned <= cross:
                            order = 1
                        elif math.pi - turned <= cross:
                            order = -1
                        else:
                            continue
                    elif order * (0.5 * math.pi - turned) < 0.5 * math.pi - cross:
                        continue
                first_row, second_row = (i, j) if order == 1 else (j, i)
                votes[first_row, a] += 1
                votes[second_row, b] += 1
                touched[count], touched[count + 1] = a, b
                count += 2
    for i in range(n):
        best = second = 0
        row = -1
        for k in range(count):
            got = votes[i, touched[k]]
            if got > best:
                best, second, row = got, 0, touched[k]
            elif got == best and touched[k] != row:
                second = got
        star[i] = row if best > second else -1
    for i in range(n):
        for k in range(count):
            votes[i, touched[k]] = 0


@njit_no_refcount
def bare_attitude(
    b: Vector, r: Vector, weight: Vector, turned: Vector, matrix: Matrix, q: Vector
) -> None:
    """TRIAD of the widest pair into `matrix`, then QUEST in its frame with the result `q`."""
    n = len(b)
    one, two, widest = 0, 1, -1.0
    for i in range(n - 1):
        for j in range(i + 1, n):
            apart = 0.0
            for k in range(3):
                apart += (b[i, k] - b[j, k]) ** 2
            if apart > widest:
                one, two, widest = i, j, apart
    _frame(b[one], b[two], turned[0])
    _frame(r[one], r[two], turned[1])
    for i in range(3):
        for j in range(3):
            matrix[i, j] = 0.0
            for k in range(3):
                matrix[i, j] += turned[0, k, i] * turned[1, k, j]
    # The largest component of its quaternion tells which half turn keeps the scalar part large.
    trace = matrix[0, 0] + matrix[1, 1] + matrix[2, 2]
    flip, largest = 3, trace
    for i in range(3):
        if matrix[i, i] > largest:
            flip, largest = i, matrix[i, i]
    total = 0.0
    profile = turned[2]
    profile[:] = 0.0
    for k in range(n):
        total += weight[k]
        for i in range(3):
            for j in range(3):
                sign = 1.0 if flip in (3, j) else -1.0
                profile[i, j] += weight[k] * b[k, i] * r[k, j] * sign
    s = turned[0]
    for i in range(3):
        for j in range(3):
            profile[i, j] /= total
    for i in range(3):
        for j in range(3):
            s[i, j] = profile[i, j] + profile[j, i]
    sigma = profile[0, 0] + profile[1, 1] + profile[2, 2]
    z0 = profile[1, 2] - profile[2, 1]
    z1 = profile[2, 0] - profile[0, 2]
    z2 = profile[0, 1] - profile[1, 0]
    c0 = s[1, 1] * s[2, 2] - s[1, 2] * s[1, 2]
    c1 = s[0, 0] * s[2, 2] - s[0, 2] * s[0, 2]
    c2 = s[0, 0] * s[1, 1] - s[0, 1] * s[0, 1]
    kappa = c0 + c1 + c2
    det = (
        s[0, 0] * c0
        - s[0, 1] * (s[0, 1] * s[2, 2] - s[1, 2] * s[0, 2])
        + s[0, 2] * (s[0, 1] * s[1, 2] - s[1, 1] * s[0, 2])
    )
    u0 = s[0, 0] * z0 + s[0, 1] * z1 + s[0, 2] * z2
    u1 = s[0, 1] * z0 + s[1, 1] * z1 + s[1, 2] * z2
    u2 = s[0, 2] * z0 + s[1, 2] * z1 + s[2, 2] * z2
    pa = sigma * sigma - kappa
    pb = sigma * sigma + z0 * z0 + z1 * z1 + z2 * z2
    pc = det + z0 * u0 + z1 * u1 + z2 * u2
    pd = u0 * u0 + u1 * u1 + u2 * u2
    root = 1.0
    for _ in range(4):
        square = root * root
        slope = 2.0 * root * (2.0 * square - pa - pb) - pc
        if slope == 0.0:
            break
        root -= ((square - pa) * (square - pb) - pc * root + (pc * sigma - pd)) / slope
    alpha, beta = root * root - sigma * sigma + kappa, root - sigma
    gamma = (root + sigma) * alpha - det
    x0 = alpha * z0 + beta * u0 + s[0, 0] * u0 + s[0, 1] * u1 + s[0, 2] * u2
    x1 = alpha * z1 + beta * u1 + s[0, 1] * u0 + s[1, 1] * u1 + s[1, 2] * u2
    x2 = alpha * z2 + beta * u2 + s[0, 2] * u0 + s[1, 2] * u1 + s[2, 2] * u2
    if flip == 0:
        q[0], q[1], q[2], q[3] = gamma, -x2, x1, -x0
    elif flip == 1:
        q[0], q[1], q[2], q[3] = x2, gamma, -x0, -x1
    elif flip == 2:
        q[0], q[1], q[2], q[3] = -x1, x0, gamma, -x2
    else:
        q[0], q[1], q[2], q[3] = x0, x1, x2, gamma
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        norm = -norm
    for i in range(4):
        q[i] /= norm


@njit_no_refcount
def _frame(a: Vector, b: Vector, rows: Matrix) -> None:
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    norm = math.sqrt(x * x + y * y + z * z)
    x, y, z = x / norm, y / norm, z / norm
    rows[0, 0], rows[0, 1], rows[0, 2] = a[0], a[1], a[2]
    rows[1, 0], rows[1, 1], rows[1, 2] = x, y, z
    rows[2, 0], rows[2, 1], rows[2, 2] = (
        a[1] * z - a[2] * y,
        a[2] * x - a[0] * z,
        a[0] * y - a[1] * x,
    )


@njit_no_refcount
def bare_one(
    observed: Vector,
    mag: Vector,
    body: Vector,
    weight: Vector,
    zone: Arrays,
    pole: Vector,
    settings: tuple[float, ...],
    is_band: bool,
    polar: Vector,
    room: Arrays,
    star: npt.NDArray[np.int64],
    q: Vector,
) -> bool:
    """Identify one batch and solve its attitude; true if there is an attitude."""
    direction, magnitude, separation, brighter, dimmer, bin_start, bins_per_rad = zone
    votes, touched, b, r, w, turned, matrix = room
    bare_votes(
        observed,
        mag,
        direction,
        magnitude,
        separation,
        brighter,
        dimmer,
        bin_start,
        bins_per_rad,
        pole,
        settings,
        is_band,
        polar,
        votes,
        touched,
        star,
    )
    count = 0
    for i in range(len(star)):
        if star[i] >= 0:
            w[count] = weight[i]
            for k in range(3):
                b[count, k], r[count, k] = body[i, k], direction[star[i], k]
            count += 1
    if count < 2:
        return False
    bare_attitude(b[:count], r[:count], w[:count], turned, matrix, q)
    return True


@njit_no_refcount
def bare_many(
    observed: Vector,
    mag: Vector,
    body: Vector,
    weight: Vector,
    zone: Arrays,
    pole: Vector,
    settings: tuple[float, ...],
    is_band: bool,
    polar: Vector,
    room: Arrays,
    star: npt.NDArray[np.int64],
    q: Vector,
) -> None:
    """Process many batches of one zone, one after another."""
    for k in range(len(observed)):
        bare_one(
            observed[k],
            mag[k],
            body[k],
            weight[k],
            zone,
            pole[k],
            settings,
            is_band,
            polar,
            room,
            star[k],
            q[k],
        )


def room_for(n: int, stars: int, pairs: int) -> Arrays:
    """Output arrays of the bare kernels."""
    return (
        np.zeros((n, stars), np.int32),
        np.empty(n * n * max(pairs, 1) + 2, np.int32),
        np.empty((n, 3)),
        np.empty((n, 3)),
        np.empty(n),
        np.empty((3, 3, 3)),
        np.empty((3, 3)),
    )
