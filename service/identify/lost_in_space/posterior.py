"""The log evidence of an attitude, against the hypothesis that all points are clutter.

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

from service.compiled.jit import njit
from service.identify.hypotheses.evidence import log_sum

DOUBT = 1e-4
"""Largest posterior share of all other explanations beside a reported attitude."""
LOG_NULL = -math.log(20.0)
"""Prior log odds of a field without stars, which is rare."""
LEAST_EVIDENCE = math.log(1.0 / DOUBT - 1.0) + LOG_NULL
"""Least log evidence of any reported attitude."""

POSITION_SCALES = ((0.15, 0.5), (0.6, 1.0), (0.25, 2.0))
"""Noise models of positions: the weight of each, and its factor on the sigmas."""
_LOG_SCALES = tuple((math.log(w), math.log(s), 0.5 / (s * s)) for w, s in POSITION_SCALES)
CLEAN_CLUTTER = 0.3
"""Probability in a clean field that a further point is no star of the index."""
DETECTED = 0.97
"""Probability in a clean field that a star well within the limit is detected."""
OFFSET_SIGMA_MAG = 0.5
"""Sigma of a common offset of all observed magnitudes."""
COUNT_SLOPE = 0.5 * math.log(10.0)
"""Growth of the number of stars per magnitude: the logarithm of 10^0.5."""

MISSING_REACH, MISSING_STEPS = 2.0, 16
"""Reach of the missing-star table to either side of the limit in sigmas, and steps per sigma."""
FAINT_REACH = 1.0
"""Sigmas by which a star is fainter than the limit from which the search leaves it out."""

LOG_FACTORIAL = np.cumsum(np.log(np.maximum(np.arange(512), 1)))
LOG_MISSING = np.array(
    [
        math.log(1.0 - DETECTED * 0.5 * math.erfc(-(at / MISSING_STEPS - MISSING_REACH) / 2**0.5))
        for at in range(int(2 * MISSING_REACH * MISSING_STEPS) + 1)
    ]
)
CROWDED = 2.3
"""Allowance in ln det N for matched points that lie closer together than all points."""
ALWAYS_ENOUGH = 4
"""Number of matched points from which a candidate attitude is never ruled out beforehand."""
_LOG_2PI = math.log(2.0 * math.pi)
_LOG_ROTATIONS = math.log(8.0 * math.pi**2)


@njit(nogil=True)
def log_positions(matched, log_area_per_spot, chi2, log_det):  # type: ignore[no-untyped-def]
    """Log evidence of positions and attitude; `log_area_per_spot`: sum of ln(A/2 pi sigma^2)."""
    most = -math.inf
    for log_weight, log_scale, half in _LOG_SCALES:
        most = max(most, log_weight + (3.0 - 2.0 * matched) * log_scale - half * chi2)
    if most == -math.inf:
        return most
    shares = 0.0
    for log_weight, log_scale, half in _LOG_SCALES:
        shares += math.exp(log_weight + (3.0 - 2.0 * matched) * log_scale - half * chi2 - most)
    total = most + math.log(shares)
    return log_area_per_spot + total + 1.5 * _LOG_2PI - 0.5 * log_det - _LOG_ROTATIONS


@njit(nogil=True, error_model="numpy")
def fewest_stars(points, area, sigma_mag):  # type: ignore[no-untyped-def]
    """Least number of matched points that can be sufficient evidence; more than all if none can.

    The evidence is that of a perfect match of the brightest points, without a missing star.
    """
    n = len(points.observed)
    matrix = np.zeros((3, 3))
    any_magnitude = np.zeros(n + 1)
    known = 0
    log_spot = -math.inf
    for k in range(n):
        w = 1.0 / (points.sigma[k] * points.sigma[k])
        log_spot = max(log_spot, math.log(w * area) - _LOG_2PI)
        for i in range(3):
            matrix[i, i] += w
            for j in range(3):
                matrix[i, j] -= w * points.observed[k, i] * points.observed[k, j]
        if not np.isnan(points.magnitude[k]):
            known = k + 1
    for k in range(known):
        any_magnitude[k + 1] = any_magnitude[k] + log_any_magnitude(
            points.magnitude[k], points.magnitude[known - 1]
        )
    det = (
        matrix[0, 0] * (matrix[1, 1] * matrix[2, 2] - matrix[1, 2] ** 2)
        - matrix[0, 1] * (matrix[0, 1] * matrix[2, 2] - matrix[1, 2] * matrix[0, 2])
        + matrix[0, 2] * (matrix[0, 1] * matrix[1, 2] - matrix[1, 1] * matrix[0, 2])
    )
    if n < 3 or not det > 0.0:
        return n + 1
    for m in range(3, min(n, ALWAYS_ENOUGH) + 1):
        log_det = math.log(det) + 3.0 * math.log(m / n)
        if m < n:
            log_det -= CROWDED
        compared = min(m, known)
        weight = (
            log_positions(m, m * log_spot, 0.0, log_det)
            + log_labels(n, m)
            + log_magnitudes(compared, 0.0, 0.0, sigma_mag)
            - any_magnitude[compared]
            + log_sum(log_any_share(m, m), m * math.log(DETECTED))
            - math.log(2.0)
        )
        if weight > LEAST_EVIDENCE:
            return m
    return ALWAYS_ENOUGH if n >= ALWAYS_ENOUGH else n + 1


@njit(nogil=True)
def log_labels(points, matched):  # type: ignore[no-untyped-def]
    """Log probability of which points are stars and which are clutter."""
    clutter = points - matched
    clean = math.log(1.0 - CLEAN_CLUTTER) + clutter * math.log(CLEAN_CLUTTER)
    # The prior of the share of stars is Beta(3, 1), which favours large shares.
    any_number = math.log(
        3.0 * (matched + 1.0) * (matched + 2.0) / ((points + 1.0) * (points + 2.0) * (points + 3.0))
    )
    return (
        LOG_FACTORIAL[clutter] - LOG_FACTORIAL[points] + log_sum(clean, any_number) - math.log(2.0)
    )


@njit(nogil=True)
def log_any_share(matched, expected):  # type: ignore[no-untyped-def]
    """Log probability of the set of detected stars if all detection rates are equally likely."""
    expected = min(expected, len(LOG_FACTORIAL) - 2)
    return LOG_FACTORIAL[matched] + LOG_FACTORIAL[expected - matched] - LOG_FACTORIAL[expected + 1]


@njit(nogil=True)
def log_missing(brighter_by_sigma):  # type: ignore[no-untyped-def]
    """Log probability that a star this much brighter than the limit is missing."""
    at = int((brighter_by_sigma + MISSING_REACH) * MISSING_STEPS + 0.5)
    return LOG_MISSING[min(max(at, 0), len(LOG_MISSING) - 1)]


@njit(nogil=True)
def log_magnitudes(compared, total, square, sigma_mag):  # type: ignore[no-untyped-def]
    """Log density of observed minus catalog magnitudes, from number, sum and sum of squares."""
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


@njit(nogil=True)
def log_any_magnitude(magnitude, faintest):  # type: ignore[no-untyped-def]
    """Log density of the magnitude of a random star or point that is no fainter than a bound."""
    return math.log(COUNT_SLOPE) + COUNT_SLOPE * min(magnitude - faintest, 0.0)
