"""Two points followed from batch to batch: the kernel behind the linking.

The two give a great circle.  Along it a motion is an angle that grows with time, across it a
small angle; each is a straight line in the elapsed time, fitted anew with every point that
is taken.
"""

import math

from service.compiled.jit import njit_no_refcount

GATE = 16.0
"""Chi-square with two degrees of freedom that a point of the motion exceeds once in 3,000."""
MOST_MISSED = 5
"""Batches in a row without a point, after which a motion is not followed on."""
MOST_CHANCE = 0.2
"""Where so many random points are expected within the gate, the next would be a guess."""


@njit_no_refcount
def _solved(s0, s1, s2, y0, y1):  # type: ignore[no-untyped-def]
    """Value and slope of a weighted line, and their variances and covariance."""
    determinant = s0 * s2 - s1 * s1
    if determinant <= 0.0:
        return y0 / s0, 0.0, 1.0 / s0, math.inf, 0.0
    value = (s2 * y0 - s1 * y1) / determinant
    slope = (s0 * y1 - s1 * y0) / determinant
    return value, slope, s2 / determinant, s0 / determinant, -s1 / determinant


@njit_no_refcount
def extend(  # type: ignore[no-untyped-def]
    i,
    j,
    first,  # (b + 1,) where the points of each batch begin
    batch,  # (n,)
    time_s,  # (n,)
    direction,  # (n, 3)
    variance,  # (n,) rad^2, along the worse axis
    density,  # (n,) points per steradian
    used,  # (n,) points of other tracks
    chosen,  # (b,) the points that are taken, written
):
    """The number of points that lie on the motion of points `i` and `j`, with these two.

    Of each later batch the nearest one is taken, as `chosen` from the batch of `i` on tells;
    -1 is no point.
    """
    ax, ay, az = direction[i, 0], direction[i, 1], direction[i, 2]
    bx, by, bz = direction[j, 0], direction[j, 1], direction[j, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    if norm < 1e-12:
        # At one place: any circle through it.
        if abs(az) < 0.9:
            nx, ny, nz = ay, -ax, 0.0
        else:
            nx, ny, nz = 0.0, az, -ay
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / norm, ny / norm, nz / norm
    ux, uy, uz = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    begin = time_s[i]
    s0 = s1 = s2 = along0 = along1 = across0 = across1 = 0.0
    count, missed, last = 0, 0, len(first) - 1
    at = batch[i]
    point = i
    while True:
        if point >= 0:
            x, y, z = direction[point, 0], direction[point, 1], direction[point, 2]
            elapsed = time_s[point] - begin
            weight = 1.0 / variance[point]
            angle = math.atan2(x * ux + y * uy + z * uz, x * ax + y * ay + z * az)
            aside = x * nx + y * ny + z * nz
            s0 += weight
            s1 += weight * elapsed
            s2 += weight * elapsed * elapsed
            along0 += weight * angle
            along1 += weight * elapsed * angle
            across0 += weight * aside
            across1 += weight * elapsed * aside
            count += 1
            missed = 0
        else:
            missed += at > batch[j]
            # Two points alone do not tell where the third is to be looked for much later.
            if missed > (MOST_MISSED if count > 2 else 2):
                return count
        chosen[at] = point
        at += 1
        if at == last:
            return count
        if at <= batch[j]:
            point = j if at == batch[j] else -1
            continue
        point = -1
        if first[at] == first[at + 1]:
            continue
        value, rate, v00, v11, v01 = _solved(s0, s1, s2, along0, along1)
        value_across, rate_across, _, _, _ = _solved(s0, s1, s2, across0, across1)
        nearest = GATE
        for k in range(first[at], first[at + 1]):
            if used[k]:
                continue
            elapsed = time_s[k] - begin
            allowed = v00 + elapsed * (2.0 * v01 + elapsed * v11) + variance[k]
            if math.pi * GATE * allowed * density[k] > MOST_CHANCE:
                continue
            x, y, z = direction[k, 0], direction[k, 1], direction[k, 2]
            angle = math.atan2(x * ux + y * uy + z * uz, x * ax + y * ay + z * az)
            off = angle - value - rate * elapsed
            aside = x * nx + y * ny + z * nz - value_across - rate_across * elapsed
            distance = (off * off + aside * aside) / allowed
            if distance < nearest:
                nearest, point = distance, k


@njit_no_refcount
def count_seeds(first, reach):  # type: ignore[no-untyped-def]
    """The number of pairs of points in batches that are at most `reach` apart."""
    total = 0
    for a in range(len(first) - 1):
        for b in range(a + 1, min(a + reach, len(first) - 2) + 1):
            total += (first[a + 1] - first[a]) * (first[b + 1] - first[b])
    return total


@njit_no_refcount
def try_seeds(  # type: ignore[no-untyped-def]
    reach,
    most_rate,  # rad/s
    least,  # points of a track
    room,  # further apart, in rad, is no seed; for points at rest
    first,
    batch,
    time_s,
    direction,
    variance,
    density,
    used,
    chosen,
    seeds,  # (m, 3): points i and j, and the count, written
):
    """The number of seeds that have at least `least` points; they are written to `seeds`."""
    found = 0
    for a in range(len(first) - 1):
        for i in range(first[a], first[a + 1]):
            if used[i]:
                continue
            for b in range(a + 1, min(a + reach, len(first) - 2) + 1):
                for j in range(first[b], first[b + 1]):
                    if used[j]:
                        continue
                    x = direction[j, 0] - direction[i, 0]
                    y = direction[j, 1] - direction[i, 1]
                    z = direction[j, 2] - direction[i, 2]
                    apart = math.sqrt(x * x + y * y + z * z)
                    elapsed = time_s[j] - time_s[i]
                    slack = 4.0 * math.sqrt(variance[i] + variance[j])
                    if elapsed <= 0.0 or apart > min(most_rate * elapsed, room) + slack:
                        continue
                    count = extend(
                        i, j, first, batch, time_s, direction, variance, density, used, chosen
                    )
                    if count >= least and found < len(seeds):
                        seeds[found, 0] = i
                        seeds[found, 1] = j
                        seeds[found, 2] = count
                        found += 1
    return found
