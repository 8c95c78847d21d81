"""What a search for hypotheses looks at: the observed stars, and the zone by place.

Vectors are in the presumed frame: inertial axes as the a priori attitude has
them.  The attitude T of a hypothesis takes catalog directions to that frame,
so that T is the identity where the a priori attitude is right.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from service.sky.pairs import separation_rad
from service.uncounted import borrowing

MAX_HYPOTHESES = 2048
"""Kept of a search, a power of two; lighter ones are only added up."""
PREDICTION_GATE = 20.0
"""In sigmas: how far a star may lie from where a pair of others puts it."""
MAX_SEEDS = 12
"""Pairs of at most so many stars, the brightest, are scanned; all are matched."""


class Seen(NamedTuple):
    """The observed stars (n): directions, magnitudes (NaN: none), sigmas, and what is presumed.

    `weight` is (reference_sigma / sigma)^2.  `velocity` of the observer is in
    units of c, zero where aberration is not to be corrected.
    """

    observed: Any
    magnitude: Any
    sigma_rad: Any
    weight: Any
    reference_sigma: Any
    velocity: Any
    prior_kind: Any
    prior_axis: Any


class Stars(NamedTuple):
    """The zone's stars (m) with their grid, and the exact bounds on the angle to its axis.

    `polar` (m,) keeps that angle once it was worked out; -1: not yet.
    `log_density` is the logarithm of the stars within the bounds per steradian.
    """

    direction: Any
    magnitude: Any
    grid_start: Any
    grid_rows: Any
    grid_direction: Any
    voxels: Any
    axis: Any
    least: Any
    most: Any
    polar: Any
    log_density: Any


class Pairs(NamedTuple):
    """The zone's pair index, as in `sky.pairs`, and its polar differences, as in `sky.zones`.

    Those are about the zone's own axis, which lies `off_axis` radians from the exact one.
    """

    separation: Any
    brighter: Any
    dimmer: Any
    bin_start: Any
    bins_per_rad: Any
    polar_difference: Any
    off_axis: Any


class Scratch(NamedTuple):
    """Arrays that a search of n stars writes to again and again, so as to allocate them once.

    Those of a search may serve the next one of as many stars.
    """

    match: Any
    used: Any
    fresh: Any
    second: Any
    order: Any
    parts: Any
    gate: Any
    references: Any
    t: Any
    turned: Any
    matrix: Any
    smaller: Any
    inverse: Any
    most: Any
    light: Any
    table: Any
    range_kept: Any
    leader: Any
    seeds: Any
    group: Any
    group_of: Any
    first_pair: Any
    last_pair: Any
    separation: Any
    cost: Any


@njit(cache=True, nogil=True)
def scratch_for(n):  # type: ignore[no-untyped-def]
    """The arrays for n stars; `most` is not worked out yet (NaN)."""
    rows = np.full((5, n), -1, np.int32)
    squares = np.empty((5, 3, 3))
    numbers = np.empty((5, n + 1), np.int64)
    s = min(n, MAX_SEEDS)
    ranges = np.empty((2, s, s), np.int64)
    angles = np.empty((2, s, s))
    return Scratch(
        rows[0],
        rows[1],
        rows[2],
        rows[3],
        numbers[0],
        np.empty((n, 3)),
        np.empty(n),
        np.empty((n, 3)),
        squares[0],
        squares[1],
        squares[2],
        squares[3],
        squares[4],
        np.full(n + 1, np.nan),
        numbers[1],
        np.empty(2 * MAX_HYPOTHESES, np.int32),
        np.full(2, -math.inf),
        rows[4],
        numbers[2, :s],
        numbers[3, :s],
        numbers[4],
        ranges[0],
        ranges[1],
        angles[0],
        angles[1],
    )


@borrowing
def with_magnitude(seen):  # type: ignore[no-untyped-def]
    """How many of the observed stars have a magnitude."""
    count = 0
    for magnitude in seen.magnitude:
        if not math.isnan(magnitude):
            count += 1
    return count


@borrowing
def within(row, stars):  # type: ignore[no-untyped-def]
    """Whether a zone star lies within the exact bounds."""
    if stars.polar[row] < 0.0:
        stars.polar[row] = separation_rad(stars.direction[row], stars.axis)
    return stars.least <= stars.polar[row] <= stars.most


@njit(cache=True, nogil=True)
def log_density(direction, axis, least, most):  # type: ignore[no-untyped-def]
    """Logarithm of the stars per steradian between two angles from an axis."""
    inside = 0
    inner, outer = math.cos(least), math.cos(most)
    for row in range(len(direction)):
        r = direction[row]
        cosine = r[0] * axis[0] + r[1] * axis[1] + r[2] * axis[2]
        if outer <= cosine <= inner:
            inside += 1
    area = 2.0 * math.pi * (inner - outer)
    return math.log(max(inside, 1) / area)


@borrowing
def polar_difference(seen, i, j, tilt):  # type: ignore[no-untyped-def]
    """The angle of star i to the axis less that of star j, and how far noise and a tilt move it.

    A tilt of the axis moves the two angles apart by at most itself times the
    chord between the stars' directions about the axis.
    """
    vi, vj = seen.observed[i], seen.observed[j]
    polar_i, polar_j = separation_rad(vi, seen.prior_axis), separation_rad(vj, seen.prior_axis)
    apart = separation_rad(vi, vj)
    sines = math.sin(polar_i) * math.sin(polar_j)
    chord2 = 4.0
    if sines > 0.0:
        # By half angles, which stay accurate where the angles are small.
        half = math.sin(0.5 * apart) ** 2 - math.sin(0.5 * (polar_i - polar_j)) ** 2
        chord2 = min(4.0, max(0.0, 4.0 * half / sines))
    noise = PREDICTION_GATE * math.sqrt(seen.sigma_rad[i] ** 2 + seen.sigma_rad[j] ** 2)
    return polar_i - polar_j, noise + tilt * math.sqrt(chord2)
