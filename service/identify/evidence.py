"""How much a hypothesis explains: its weight as a posterior, up to a common constant.

A hypothesis names a catalog star, or clutter, for every observed star.  Its
attitude is integrated out by Laplace's approximation, the noise of positions
and of magnitudes over a range of scales, the share of clutter over a Beta
distribution:

    log W = log prior(attitude)
          + 3/2 ln 2 pi - 1/2 ln det N                             (the attitude)
          + ln mean over s of [(2 pi s^2)^-m s^3 exp(-Q / 2 s^2)]  (positions)
          + ln mean over t and offset of the density               (magnitudes)
          + ln B(k + 1/2, m + 9/2) / B(1/2, 9/2)                   (k clutter, m stars)
          - k ln 6 - m ln rho

N is the sum of w (I - b b^T), Q of w d^2, with w = (sigma_reference / sigma)^2;
rho the zone's stars per steradian; clutter's magnitude is uniform over 6 mag.
"""

import math

import numpy as np
from numba import njit

CLUTTER_SPAN_MAG = 6.0
POSITION_SCALES = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
"""In units of the tracker's sigma: 2 to 34 arcsec for the shipped trackers."""
MAGNITUDE_SCALES_MAG = np.array([0.1, 0.2, 0.4, 0.8, 1.6, 3.2])
OFFSET_SIGMA_MAG = 0.5
"""A constant offset of the observed magnitudes is none at all or normal with this sigma."""
BETA_CLUTTER, BETA_STAR = 0.5, 4.5
ROTATION_SCALES_DEG = np.array([0.05, 0.3, 2.0, 10.0, 45.0])
"""Heavy tails: the a priori attitude is off by a normal deviate of one of these, all alike."""
TILT_SCALES_DEG = np.array([0.05, 0.2, 1.0, 4.0, 15.0])

PRIOR_ROTATION, PRIOR_DIRECTION = 0, 1

_LOG_2PI = math.log(2.0 * math.pi)


@njit(cache=True, nogil=True)
def log_beta(a, b):  # type: ignore[no-untyped-def]
    """Logarithm of Euler's beta function."""
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


@njit(cache=True, nogil=True)
def log_clutter(clutter, stars):  # type: ignore[no-untyped-def]
    """Log probability that just these are clutter."""
    return log_beta(clutter + BETA_CLUTTER, stars + BETA_STAR) - log_beta(BETA_CLUTTER, BETA_STAR)


@njit(cache=True, nogil=True)
def log_prior(angle, kind):  # type: ignore[no-untyped-def]
    """Log density of an attitude, per cubed radian of rotation, at an angle from the presumed one.

    The angle is the total rotation or, where only an axis is known
    (`PRIOR_DIRECTION`), the tilt of that axis, any roll alike.
    """
    if kind == PRIOR_ROTATION:
        density = 1.0 / (8.0 * math.pi * math.pi)
        for scale_deg in ROTATION_SCALES_DEG:
            scale = math.radians(scale_deg)
            density += math.exp(-0.5 * (angle / scale) ** 2) / ((2.0 * math.pi) ** 1.5 * scale**3)
        return math.log(density / (len(ROTATION_SCALES_DEG) + 1))
    density = 1.0 / (4.0 * math.pi)
    for scale_deg in TILT_SCALES_DEG:
        scale = math.radians(scale_deg)
        density += math.exp(-0.5 * (angle / scale) ** 2) / (2.0 * math.pi * scale**2)
    return math.log(density / (len(TILT_SCALES_DEG) + 1) / (2.0 * math.pi))


@njit(cache=True, nogil=True)
def log_positions(stars, square, log_det, reference_sigma_rad):  # type: ignore[no-untyped-def]
    """The attitude and the positions: Laplace's integral, averaged over the scales of noise."""
    largest = -math.inf
    total = 0.0
    for factor in POSITION_SCALES:
        s = factor * reference_sigma_rad
        term = -stars * (_LOG_2PI + 2.0 * math.log(s)) + 3.0 * math.log(s) - 0.5 * square / (s * s)
        if term > largest:
            total = total * math.exp(largest - term) + 1.0
            largest = term
        else:
            total += math.exp(term - largest)
    return 1.5 * _LOG_2PI - 0.5 * log_det + largest + math.log(total / len(POSITION_SCALES))


@njit(cache=True, nogil=True)
def log_magnitudes(count, total_mag, square_mag2):  # type: ignore[no-untyped-def]
    """The magnitudes of `count` stars: sum and sum of squares of observed minus catalog."""
    if count == 0:
        return 0.0
    largest = -math.inf
    total = 0.0
    for t in MAGNITUDE_SCALES_MAG:
        for variance in (0.0, OFFSET_SIGMA_MAG**2):
            joint = t * t + count * variance
            term = -0.5 * (square_mag2 - variance * total_mag**2 / joint) / (t * t)
            term += -0.5 * count * _LOG_2PI - (count - 1) * math.log(t) - 0.5 * math.log(joint)
            if term > largest:
                total = total * math.exp(largest - term) + 1.0
                largest = term
            else:
                total += math.exp(term - largest)
    return largest + math.log(total / (2 * len(MAGNITUDE_SCALES_MAG)))


@njit(cache=True, nogil=True)
def log_null(count, with_magnitude):  # type: ignore[no-untyped-def]
    """The rival that always stands in the denominator: no real star at all, or a single one.

    A single real star may be any of the zone's, whose number cancels its
    density; its magnitude is taken as spread like clutter's.
    """
    none = log_clutter(count, 0)
    one = log_clutter(count - 1, 1) + math.log(count)
    top = max(none, one)
    both = top + math.log(math.exp(none - top) + math.exp(one - top))
    return both - with_magnitude * math.log(CLUTTER_SPAN_MAG)
