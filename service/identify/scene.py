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
from service.sky.star_grid import cells_about


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
    """

    direction: Any
    magnitude: Any
    box: Any
    offset: Any
    start: Any
    rows: Any
    axis: Any
    least: Any
    most: Any
    polar: Any


class Pairs(NamedTuple):
    """The zone's pair index, as in `sky.pairs`."""

    separation: Any
    brighter: Any
    dimmer: Any
    bin_start: Any
    bins_per_rad: Any


@njit(cache=True, nogil=True)
def within(row, stars):  # type: ignore[no-untyped-def]
    """Whether a zone star lies within the exact bounds."""
    if stars.polar[row] < 0.0:
        stars.polar[row] = separation_rad(stars.direction[row], stars.axis)
    return stars.least <= stars.polar[row] <= stars.most


@njit(cache=True, nogil=True)
def log_density(stars):  # type: ignore[no-untyped-def]
    """Logarithm of the zone's stars per steradian."""
    inside = 0
    inner, outer = math.cos(stars.least), math.cos(stars.most)
    for row in range(len(stars.direction)):
        r = stars.direction[row]
        cosine = r[0] * stars.axis[0] + r[1] * stars.axis[1] + r[2] * stars.axis[2]
        if outer <= cosine <= inner:
            inside += 1
    area = 2.0 * math.pi * (inner - outer)
    return math.log(max(inside, 1) / area)


@njit(cache=True, nogil=True)
def nearest(p, gate, stars, used, found):  # type: ignore[no-untyped-def]
    """The two unused stars nearest to a direction within `gate`; -1 where there is none."""
    cells = np.empty(5, np.int64)
    cells_about(p, gate, stars.box, cells)
    face = cells[0]
    found[0] = found[1] = -1
    best = second = 4.0 * math.sin(0.5 * gate) ** 2
    if cells[4] < cells[3]:
        return  # beside everything that the face holds
    for u in range(cells[1], cells[2] + 1):
        base = (
            stars.offset[face] + (u - stars.box[face, 0]) * stars.box[face, 3] - stars.box[face, 1]
        )
        for at in range(stars.start[base + cells[3]], stars.start[base + cells[4] + 1]):
            row = stars.rows[at]
            x = stars.direction[row, 0] - p[0]
            y = stars.direction[row, 1] - p[1]
            z = stars.direction[row, 2] - p[2]
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
