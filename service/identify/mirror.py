"""The mirror test: whether a field fits the sky better when its image is reflected.

A tracker with an axis of the wrong sign, or two that are exchanged, sends a
mirrored field.  No rotation takes the sky to it, but three or four of its
stars that lie alike on both sides of a line may fit by themselves.  Reflected
once more the whole field fits, which tells the two apart.
"""

import math

import numpy as np
from numba import njit

from service.identify import evidence
from service.identify.fitting import prior_angle, weigh
from service.identify.scene import MAX_HYPOTHESES, Seen, scratch_for, with_magnitude
from service.identify.search import search_in
from service.uncounted import borrowing

LOG_MIRRORED = -7.0
"""Prior log odds of a tracker with mirrored axes: one in a thousand."""
SURELY_NO_MIRROR = 30.0
"""A hypothesis heavier than the null by more is not held against a mirror.

Of mirrored fields of 5 and of 10 stars 99 in 100 wrong hypotheses are heavier by less than 21.
"""
FEWEST_MIRRORED = 3
"""Two stars are the mirror image of themselves."""


@borrowing
def may_be_mirrored(seen, match, heaviest):  # type: ignore[no-untyped-def]
    """Whether the heaviest hypothesis leaves stars unexplained and is weak enough for a mirror."""
    n = len(match)
    matched = 0
    for row in match:
        matched += row >= 0
    weak = heaviest - evidence.log_null(n, with_magnitude(seen)) < SURELY_NO_MIRROR
    return n >= FEWEST_MIRRORED and 2 <= matched < n and weak


@borrowing
def reflect(observed, boresight, image):  # type: ignore[no-untyped-def]
    """Write the mirror image of directions (n, 3), across a plane through the boresight."""
    # The normal of the plane: across the boresight, and any such will do.
    least = 0
    for i in range(1, 3):
        if abs(boresight[i]) < abs(boresight[least]):
            least = i
    along = boresight[least]
    norm2 = 1.0 - along * along
    for k in range(len(observed)):
        v = observed[k]
        across = v[least] - along * (
            v[0] * boresight[0] + v[1] * boresight[1] + v[2] * boresight[2]
        )
        for i in range(3):
            normal = (1.0 if i == least else 0.0) - along * boresight[i]
            image[k, i] = v[i] - 2.0 * across / norm2 * normal


@njit(cache=True, nogil=True)
def in_a_mirror(seen, image):  # type: ignore[no-untyped-def]
    """The same stars with the directions of their mirror image."""
    return Seen(
        image,
        seen.magnitude,
        seen.sigma_rad,
        seen.weight,
        seen.reference_sigma,
        seen.velocity,
        seen.prior_kind,
        seen.prior_axis,
    )


@njit(cache=True, nogil=True)
def gained_by_mirror(seen, image, stars, pairs, scratch):  # type: ignore[no-untyped-def]
    """By how much the mirror image explains more than the field, in logarithms.

    Minus infinity where fewer than three of its stars fit.  The prior is left
    out of both: which way the axes are mirrored is not known, and a wrong guess
    turns the image about the boresight.
    """
    n = len(seen.observed)
    ledger, log_weight = np.empty((MAX_HYPOTHESES, n), np.int32), np.empty(MAX_HYPOTHESES)
    other = scratch_for(n)
    search_in(other, image, stars, pairs, False, ledger, log_weight)
    matched = 0
    for row in other.leader:
        matched += row >= 0
    if matched < FEWEST_MIRRORED:
        return -math.inf
    return _without_prior(image, stars, other) - _without_prior(seen, stars, scratch)


@borrowing
def _without_prior(seen, stars, scratch):  # type: ignore[no-untyped-def]
    """The log weight of the heaviest hypothesis of a search, less that of its attitude's prior."""
    match = scratch.match
    for k in range(len(match)):
        match[k] = scratch.leader[k]
    weight = weigh(seen, stars, match, scratch)
    angle = prior_angle(scratch.t, seen.prior_axis, seen.prior_kind)
    return weight - evidence.log_prior(angle, seen.prior_kind)
