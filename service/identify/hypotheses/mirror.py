"""The mirror test: whether the reflected image of a field fits the sky better.

A tracker with an axis of the wrong sign, or with two exchanged axes, sends a mirrored field. No
rotation matches the whole field to the sky, but three or four stars that are symmetric about a line
may match. The reflected field matches as a whole, which distinguishes the two cases.
"""

import math

from service.compiled.jit import njit, njit_no_refcount
from service.identify.hypotheses import evidence
from service.identify.hypotheses.fitting import prior_angle, weigh
from service.identify.hypotheses.scene import (
    ObservedStars,
    ledger_for,
    scratch_for,
    with_magnitude,
)
from service.identify.hypotheses.search import search
from service.identify.sighting import PRIOR_DIRECTION

LOG_MIRRORED = -7.0
"""Prior log odds of a tracker with mirrored axes: one in a thousand."""
NO_MIRROR_ABOVE = 30.0
"""Log weight over the null above which a hypothesis is not tested against a mirror.

Of the wrong hypotheses for mirrored fields of 5 and of 10 stars, 99 % are heavier by less than 21.
"""
FEWEST_MIRRORED = 3
"""Least number of stars for the mirror test: two are the mirror image of themselves."""


@njit_no_refcount
def may_be_mirrored(observed, ledger):  # type: ignore[no-untyped-def]
    """True if the heaviest hypothesis leaves stars unexplained and is weak enough for the test."""
    match = ledger.heaviest_match
    n = len(match)
    matched = 0
    for row in match:
        matched += row >= 0
    null = evidence.log_null(n, with_magnitude(observed))
    weak = ledger.heaviest[0] - null < NO_MIRROR_ABOVE
    return n >= FEWEST_MIRRORED and 2 <= matched < n and weak


@njit_no_refcount
def reflect(observed, boresight, image):  # type: ignore[no-untyped-def]
    """Reflect directions (n, 3) at a plane through the boresight, into `image`."""
    # The plane's normal may be any direction perpendicular to the boresight.
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


@njit(nogil=True)
def in_a_mirror(observed, image):  # type: ignore[no-untyped-def]
    """The observed stars with the directions of their mirror image."""
    return ObservedStars(
        direction=image,
        magnitude=observed.magnitude,
        sigma_rad=observed.sigma_rad,
        weight=observed.weight,
        reference_sigma=observed.reference_sigma,
        velocity=observed.velocity,
        prior_kind=observed.prior_kind,
        prior_axis=observed.prior_axis,
    )


@njit(nogil=True)
def weigh_in_a_mirror(image, boresight, stars, pairs, max_work):  # type: ignore[no-untyped-def]
    """The log weight of the heaviest hypothesis for a mirror image, and the work of its search.

    Minus infinity where fewer than three stars match.
    """
    n = len(image.direction)
    scratch, ledger = scratch_for(n), ledger_for(n)
    progress, _ = search(image, stars, pairs, n < 0, max_work, scratch, ledger)
    match = scratch.match
    matched = 0
    for k in range(n):
        match[k] = ledger.heaviest_match[k]
        matched += match[k] >= 0
    if matched < FEWEST_MIRRORED:
        return -math.inf, progress.work
    weight = weigh(image, stars, match, scratch)
    angle = prior_angle(scratch.t, image.prior_axis, image.prior_kind)
    without_prior = weight - evidence.log_prior(angle, image.prior_kind)
    return without_prior + _log_prior_of_image(image, boresight, scratch.t), progress.work


@njit_no_refcount
def _log_prior_of_image(image, boresight, t):  # type: ignore[no-untyped-def]
    """The log prior density of an attitude found for a mirror image, per cubed radian.

    The sense of the reflection is unknown, and a wrong guess rotates the image about the boresight.
    So the prior is used only for the angle between boresight and presumed axis or, for a whole
    attitude, for the direction of the boresight.
    """
    presumed, found = 1.0, 0.0
    if image.prior_kind == PRIOR_DIRECTION:
        presumed = 0.0
        for i in range(3):
            presumed += boresight[i] * image.prior_axis[i]
    for j in range(3):
        carried = boresight[0] * t[0, j] + boresight[1] * t[1, j] + boresight[2] * t[2, j]
        axis = image.prior_axis[j] if image.prior_kind == PRIOR_DIRECTION else boresight[j]
        found += carried * axis
    presumed_angle = math.acos(min(1.0, max(-1.0, presumed)))
    found_angle = math.acos(min(1.0, max(-1.0, found)))
    return evidence.log_prior_on_circle(found_angle - presumed_angle, presumed_angle)
