"""Compiled kernel that follows the motion of two points from batch to batch.

The two points give a great circle.  Along it a motion is an angle that grows with time, across it a
small angle; both are straight lines in the elapsed time, fitted again with every point taken.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit_inlined, njit_no_refcount

GATE = 16.0
"""Gate on chi-square with two degrees of freedom: a true point exceeds it once in 3,000."""
MOST_MISSED = 5
"""Greatest number of consecutive batches without a point, after which a track ends."""
MOST_CHANCE = 0.2
"""Greatest expected number of random points in the gate; with more, a match is a guess."""


class Sightings(NamedTuple):
    """Arrays of points (n) in batches (b), the input of the compiled search for tracks.

    The points of each batch begin at `first` (b + 1,).  `variance` (n,) is rad^2 along the worse
    axis, `density` (n,) points per steradian.  `used` (n,) marks points of other tracks.  `chosen`
    (b,) is output: the point taken in each batch, -1 for none.
    """

    first: npt.NDArray[np.int64]
    batch: npt.NDArray[np.int64]
    time_s: npt.NDArray[np.float64]
    direction: npt.NDArray[np.float64]
    variance: npt.NDArray[np.float64]
    density: npt.NDArray[np.float64]
    used: npt.NDArray[np.bool_]
    chosen: npt.NDArray[np.int64]


@njit_no_refcount
def _circle(direction, i, j):  # type: ignore[no-untyped-def]
    """Axes (6,) of the great circle through two points: tangent at the first point, and pole."""
    ax, ay, az = direction[i, 0], direction[i, 1], direction[i, 2]
    bx, by, bz = direction[j, 0], direction[j, 1], direction[j, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    if norm < 1e-12:
        # At one place: any circle through it.
        nx, ny, nz = (ay, -ax, 0.0) if abs(az) < 0.9 else (0.0, az, -ay)
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
    nx, ny, nz = nx / norm, ny / norm, nz / norm
    return ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax, nx, ny, nz


@njit_inlined
def _angles(direction, point, i, circle):  # type: ignore[no-untyped-def]
    """Angles of a point along the great circle from point `i`, and across it."""
    x, y, z = direction[point, 0], direction[point, 1], direction[point, 2]
    cosine = x * direction[i, 0] + y * direction[i, 1] + z * direction[i, 2]
    along = math.atan2(x * circle[0] + y * circle[1] + z * circle[2], cosine)
    return along, x * circle[3] + y * circle[4] + z * circle[5]


@njit_inlined
def _nearest(seen, at, i, circle, sums):  # type: ignore[no-untyped-def]
    """Nearest point of batch `at` to the fitted motion, within the gate; -1 if there is none."""
    s0, s1, s2, along0, along1, across0, across1 = sums
    determinant = s0 * s2 - s1 * s1
    if determinant <= 0.0:
        return -1
    along, rate_along = (s2 * along0 - s1 * along1), (s0 * along1 - s1 * along0)
    across, rate_across = (s2 * across0 - s1 * across1), (s0 * across1 - s1 * across0)
    nearest, point = GATE, -1
    for k in range(seen.first[at], seen.first[at + 1]):
        if seen.used[k]:
            continue
        elapsed = seen.time_s[k] - seen.time_s[i]
        spread = (s2 + elapsed * (elapsed * s0 - 2.0 * s1)) / determinant
        allowed = spread + seen.variance[k]
        if math.pi * GATE * allowed * seen.density[k] > MOST_CHANCE:
            continue
        angle, aside = _angles(seen.direction, k, i, circle)
        off = angle - (along + rate_along * elapsed) / determinant
        aside -= (across + rate_across * elapsed) / determinant
        distance = (off * off + aside * aside) / allowed
        if distance < nearest:
            nearest, point = distance, k
    return point


@njit_no_refcount
def extend(i, j, seen):  # type: ignore[no-untyped-def]
    """Number of points on the motion of points `i` and `j`, these two included.

    In every later batch the nearest point is taken, listed in `chosen` from the batch of `i` on.
    """
    circle = _circle(seen.direction, i, j)
    s0 = s1 = s2 = along0 = along1 = across0 = across1 = 0.0
    count, missed = 0, 0
    second, point = seen.batch[j], i
    for at in range(seen.batch[i], len(seen.first) - 1):
        if at == second:
            point = j
        elif at > second:
            sums = s0, s1, s2, along0, along1, across0, across1
            point = _nearest(seen, at, i, circle, sums)
        elif count == 1:
            point = -1
        seen.chosen[at] = point
        if point < 0:
            missed += at > second
            # Two points alone do not tell where the third is to be looked for much later.
            if missed > (MOST_MISSED if count > 2 else 2):
                break
            continue
        angle, aside = _angles(seen.direction, point, i, circle)
        elapsed, weight = seen.time_s[point] - seen.time_s[i], 1.0 / seen.variance[point]
        s0 += weight
        s1 += weight * elapsed
        s2 += weight * elapsed * elapsed
        along0 += weight * angle
        along1 += weight * elapsed * angle
        across0 += weight * aside
        across1 += weight * elapsed * aside
        count += 1
        missed = 0
    return count


@njit_no_refcount
def count_seeds(first, reach):  # type: ignore[no-untyped-def]
    """Number of pairs of points whose batches are at most `reach` apart."""
    total = 0
    for a in range(len(first) - 1):
        for b in range(a + 1, min(a + reach, len(first) - 2) + 1):
            total += (first[a + 1] - first[a]) * (first[b + 1] - first[b])
    return total


@njit_no_refcount
def try_seeds(  # type: ignore[no-untyped-def]
    reach,  # batches from the first point of a seed to its second
    most_rate,  # rad/s
    room,  # rad; points farther apart are no seed
    least,  # points of a motion
    seen,
    seeds,  # (m, 3): points i and j, and the count, written
):
    """Number of seeds with at least `least` points on their motion; written to `seeds`."""
    found = 0
    for i in range(len(seen.batch)):
        a = seen.batch[i]
        last = min(a + reach, len(seen.first) - 2)
        for j in range(seen.first[a + 1], seen.first[last + 1] if last > a else 0):
            x = seen.direction[j, 0] - seen.direction[i, 0]
            y = seen.direction[j, 1] - seen.direction[i, 1]
            z = seen.direction[j, 2] - seen.direction[i, 2]
            apart = math.sqrt(x * x + y * y + z * z)
            elapsed = seen.time_s[j] - seen.time_s[i]
            slack = 4.0 * math.sqrt(seen.variance[i] + seen.variance[j])
            if elapsed <= 0.0 or apart > min(most_rate * elapsed, room) + slack:
                continue
            count = extend(i, j, seen)
            if count >= least and found < len(seeds):
                seeds[found, 0], seeds[found, 1], seeds[found, 2] = i, j, count
                found += 1
    return found


def compile_kernels() -> None:
    """Compile the kernels of the track search by following one point through four batches."""
    number = np.arange(4)
    time_s = number.astype(np.float64)
    places = np.stack([np.cos(time_s * 1e-4), np.sin(time_s * 1e-4), np.zeros(4)], axis=1)
    variance, density = np.full(4, 1e-10), np.ones(4)
    used, chosen = np.zeros(4, np.bool_), np.full(4, -1)
    seen = Sightings(np.arange(5), number, time_s, places, variance, density, used, chosen)
    seeds = np.empty((count_seeds(seen.first, 1), 3), np.int64)
    assert try_seeds(1, 1.0, math.pi, 4, seen, seeds)
    assert extend(0, 1, seen) == 4
