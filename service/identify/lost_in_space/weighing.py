"""How much an attitude explains, against all points being clutter.

In logarithms, for n matched of k points in a field of solid angle A:

    sum ln(A / 2 pi sigma^2) + ln mean over s of [s^(3 - 2n) exp(-chi^2 / 2 s^2)]   (positions)
    + 3/2 ln 2 pi - 1/2 ln det N - ln 8 pi^2                       (the volume of the attitude)
    + ln (k - n)! / k! + ln P(k - n clutter)                        (which points are stars)
    + ln P(these stars seen, the others missing)                    (the field)
    + ln of observed magnitudes given the stars' over any star's    (magnitudes)

Clutter and missing stars have two regimes of equal prior weight: a clean field,
complete to its faintest star, and one where any share of the stars may be
missing and any number of points spurious.
"""

import math

import numpy as np
from numba import njit

from service.identify.hypotheses import log_sum

POSITION_SCALES = ((0.15, 0.5), (0.6, 1.0), (0.25, 2.0))
"""Weights, and the factors by which the sigmas may be off."""
CLEAN_CLUTTER = 0.3
"""In a clean field each further point that is no star of the index is this likely."""
DETECTED = 0.97
"""A star well within the limit is seen in a clean field."""
OFFSET_SIGMA_MAG = 0.5
"""The observed magnitudes may be off together by this."""
COUNT_SLOPE = 0.5 * math.log(10.0)
"""Stars become more numerous by 10^0.5 a magnitude."""

MISSING_REACH, MISSING_STEPS = 2.0, 16
"""The table of missing stars: to so many sigmas on either side of the limit, steps a sigma."""

LOG_FACTORIAL = np.cumsum(np.log(np.maximum(np.arange(512), 1)))
LOG_MISSING = np.array(
    [
        math.log(1.0 - DETECTED * 0.5 * math.erfc(-(at / MISSING_STEPS - MISSING_REACH) / 2**0.5))
        for at in range(int(2 * MISSING_REACH * MISSING_STEPS) + 1)
    ]
)
_LOG_2PI = math.log(2.0 * math.pi)
_LOG_ROTATIONS = math.log(8.0 * math.pi**2)


@njit(cache=True, nogil=True)
def log_positions(matched, log_area_per_spot, chi2, log_det):  # type: ignore[no-untyped-def]
    """Positions and the volume of the attitude; `log_area_per_spot`: sum of ln(A/2 pi sigma^2)."""
    total = -math.inf
    for weight, scale in POSITION_SCALES:
        total = log_sum(
            total,
            math.log(weight)
            + (3.0 - 2.0 * matched) * math.log(scale)
            - 0.5 * chi2 / (scale * scale),
        )
    return log_area_per_spot + total + 1.5 * _LOG_2PI - 0.5 * log_det - _LOG_ROTATIONS


@njit(cache=True, nogil=True)
def log_labels(points, matched):  # type: ignore[no-untyped-def]
    """Which of the points are stars, and that the others are clutter."""
    clutter = points - matched
    clean = math.log(1.0 - CLEAN_CLUTTER) + clutter * math.log(CLEAN_CLUTTER)
    any_number = -math.log(points + 1.0)
    return (
        LOG_FACTORIAL[clutter] - LOG_FACTORIAL[points] + log_sum(clean, any_number) - math.log(2.0)
    )


@njit(cache=True, nogil=True)
def log_any_share(matched, expected):  # type: ignore[no-untyped-def]
    """That just these of the stars are seen, where any share is as likely as any other."""
    expected = min(expected, len(LOG_FACTORIAL) - 2)
    return LOG_FACTORIAL[matched] + LOG_FACTORIAL[expected - matched] - LOG_FACTORIAL[expected + 1]


@njit(cache=True, nogil=True)
def log_missing(brighter_by_sigma):  # type: ignore[no-untyped-def]
    """That a star brighter than the limit by so many sigmas is not seen in a complete field."""
    at = int((brighter_by_sigma + MISSING_REACH) * MISSING_STEPS + 0.5)
    return LOG_MISSING[min(max(at, 0), len(LOG_MISSING) - 1)]


@njit(cache=True, nogil=True)
def log_magnitudes(compared, total, square, sigma_mag):  # type: ignore[no-untyped-def]
    """The density of observed minus catalog magnitudes: their number, sum and sum of squares."""
    if compared == 0:
        return 0.0
    common = OFFSET_SIGMA_MAG * OFFSET_SIGMA_MAG
    joint = sigma_mag * sigma_mag + compared * common
    return (
        -0.5 * (square - common * total * total / joint) / (sigma_mag * sigma_mag)
        - 0.5 * compared * _LOG_2PI
        - (compared - 1.0) * math.log(sigma_mag)
        - 0.5 * math.log(joint)
    )


@njit(cache=True, nogil=True)
def log_any_magnitude(magnitude, faintest):  # type: ignore[no-untyped-def]
    """The density of the magnitude of any star or point that is no fainter than a bound."""
    return math.log(COUNT_SLOPE) + COUNT_SLOPE * min(magnitude - faintest, 0.0)
