"""The posterior weight of an identification hypothesis, up to a common constant.

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
import numpy.typing as npt

from service.compiled.jit import njit_no_refcount
from service.identify.sighting import PRIOR_DIRECTION, PRIOR_ROTATION

CLUTTER_SPAN_MAG = 6.0
POSITION_SCALES = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
"""Factors on a tracker's sigma over which hypotheses' evidence is averaged."""
MAGNITUDE_SCALES_MAG = np.array([0.1, 0.2, 0.4, 0.8, 1.6, 3.2])
OFFSET_SIGMA_MAG = 0.5
"""Prior sigma of a common offset of the observed magnitudes, if there is one."""
BETA_CLUTTER, BETA_STAR = 0.5, 4.5
TWO_STARS_BONUS, TWO_STARS_PER_SQUARE, TWO_STARS_SIGMA_MAG = 0.5, 0.25, 0.35
"""Bonus and penalties for hypotheses of only two stars, which chance often matches.

With wide noise scales alone, 20 of 50,000 pairs of random points pass for stars; with these
penalties seven do, while as many real pairs pass.
"""
TWO_OF_MANY = -2.0
"""Penalty of two-star hypotheses beside unexplained stars, where chance pairs are frequent."""
ROTATION_SCALES_DEG = np.array([0.05, 0.3, 2.0, 10.0, 45.0])
"""Scales in degrees of a heavy-tailed prior of the a priori attitude's error, equally likely."""
TILT_SCALES_DEG = np.array([0.05, 0.2, 1.0, 4.0, 15.0])

_LOG_2PI = math.log(2.0 * math.pi)
LOG_CLUTTER_SPAN = math.log(CLUTTER_SPAN_MAG)
_LOG_POSITION_SCALES = np.log(POSITION_SCALES)
_LOG_MAGNITUDE_SCALES = np.log(MAGNITUDE_SCALES_MAG)
_FEW = 32
_LOG_JOINT = np.log(MAGNITUDE_SCALES_MAG**2 + np.arange(_FEW + 1)[:, None] * OFFSET_SIGMA_MAG**2)
"""Table of log(t^2 + count sigma^2) by count of stars and scale t, for magnitude evidence."""
_LOG_BETA_OF_NONE = (
    math.lgamma(BETA_CLUTTER) + math.lgamma(BETA_STAR) - math.lgamma(BETA_CLUTTER + BETA_STAR)
)


def _table_of_clutter() -> npt.NDArray[np.float64]:
    """A table of log probabilities by number of clutter points and of stars, for small numbers."""
    table = np.empty((_FEW + 1, _FEW + 1))
    for clutter in range(_FEW + 1):
        for stars in range(_FEW + 1):
            a, b = clutter + BETA_CLUTTER, stars + BETA_STAR
            log_beta = math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
            table[clutter, stars] = log_beta - _LOG_BETA_OF_NONE
    return table


_LOG_CLUTTER = _table_of_clutter()


@njit_no_refcount
def log_sum(a, b):  # type: ignore[no-untyped-def]
    """The logarithm of a sum, ln(e^a + e^b)."""
    top = max(a, b)
    return top if top == -math.inf else top + math.log(math.exp(a - top) + math.exp(b - top))


@njit_no_refcount
def log_beta(a, b):  # type: ignore[no-untyped-def]
    """The logarithm of Euler's beta function."""
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)


@njit_no_refcount
def log_clutter(clutter, stars):  # type: ignore[no-untyped-def]
    """Log probability of a particular choice of clutter points among the observed stars."""
    if clutter <= _FEW and stars <= _FEW:
        return _LOG_CLUTTER[clutter, stars]
    return log_beta(clutter + BETA_CLUTTER, stars + BETA_STAR) - _LOG_BETA_OF_NONE


@njit_no_refcount
def log_prior(angle, kind):  # type: ignore[no-untyped-def]
    """Log prior density of an attitude per cubed radian, at an angle from the presumed attitude.

    For `PRIOR_DIRECTION`, where only an axis is known, the angle is the tilt of that axis, and any
    roll is equally likely.
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


@njit_no_refcount
def log_prior_on_circle(off, radius):  # type: ignore[no-untyped-def]
    """Log prior density of an attitude per cubed radian if one axis lies near a circle on the sky.

    `off` is the axis' distance from the circle of the given `radius`; positions along the circle
    and rolls are equally likely. A circle narrower than a scale of the tilts counts as a point.
    """
    density = 1.0 / (4.0 * math.pi)
    for scale_deg in TILT_SCALES_DEG:
        scale = math.radians(scale_deg)
        length = max(scale, math.sqrt(2.0 * math.pi) * math.sin(radius))
        density += math.exp(-0.5 * (off / scale) ** 2) / (2.0 * math.pi * scale * length)
    return math.log(density / (len(TILT_SCALES_DEG) + 1) / (2.0 * math.pi))


# Tables are filled with the uncompiled functions, so that an import compiles nothing.
LOG_PRIOR_AT_BEST = np.array(
    [log_prior.py_func(0.0, kind) for kind in (PRIOR_ROTATION, PRIOR_DIRECTION)]
)
"""The largest log prior density of an attitude, by the kind of prior."""


@njit_no_refcount
def log_positions(stars, square, log_det, reference_sigma_rad):  # type: ignore[no-untyped-def]
    """Log evidence of the positions, with the attitude integrated out and noise scales averaged."""
    largest = -math.inf
    total = 0.0
    log_reference = math.log(reference_sigma_rad)
    for i in range(len(POSITION_SCALES)):
        s = POSITION_SCALES[i] * reference_sigma_rad
        log_s = log_reference + _LOG_POSITION_SCALES[i]
        term = (3 - 2 * stars) * log_s - stars * _LOG_2PI - 0.5 * square / (s * s)
        if term > largest:
            total = total * math.exp(largest - term) + 1.0
            largest = term
        else:
            total += math.exp(term - largest)
    return 1.5 * _LOG_2PI - 0.5 * log_det + largest + math.log(total / len(POSITION_SCALES))


_LOG_EXACT = np.array([log_positions.py_func(count, 0.0, 0.0, 1.0) for count in range(_FEW + 1)])
"""Table of position evidence without residuals, by number of stars, for a sigma of one radian."""


@njit_no_refcount
def log_exact_positions(stars, reference_sigma_rad):  # type: ignore[no-untyped-def]
    """An upper bound on the position evidence: no residuals, and det N left out."""
    if stars <= _FEW:
        return _LOG_EXACT[stars] + (3 - 2 * stars) * math.log(reference_sigma_rad)
    return log_positions(stars, 0.0, 0.0, reference_sigma_rad)


@njit_no_refcount
def log_magnitudes(count, total_mag, square_mag2):  # type: ignore[no-untyped-def]
    """Log evidence of `count` magnitudes, from sum and sum of squares of observed minus catalog."""
    if count == 0:
        return 0.0
    largest = -math.inf
    total = 0.0
    for i in range(len(MAGNITUDE_SCALES_MAG)):
        t, log_t = MAGNITUDE_SCALES_MAG[i], _LOG_MAGNITUDE_SCALES[i]
        joint = t * t + count * OFFSET_SIGMA_MAG**2
        log_joint = _LOG_JOINT[count, i] if count <= _FEW else math.log(joint)
        pull = OFFSET_SIGMA_MAG**2 * total_mag**2 / joint
        plain = -0.5 * square_mag2 / (t * t) - count * log_t
        for term in (plain, plain + 0.5 * pull / (t * t) + log_t - 0.5 * log_joint):
            if term > largest:
                total = total * math.exp(largest - term) + 1.0
                largest = term
            else:
                total += math.exp(term - largest)
    shared = -0.5 * count * _LOG_2PI
    return shared + largest + math.log(total / (2 * len(MAGNITUDE_SCALES_MAG)))


_LOG_EQUAL = np.array([log_magnitudes.py_func(count, 0.0, 0.0) for count in range(_FEW + 1)])


@njit_no_refcount
def log_equal_magnitudes(count):  # type: ignore[no-untyped-def]
    """Upper bound on the magnitude evidence: all `count` magnitudes equal those of the catalog."""
    return _LOG_EQUAL[count] if count <= _FEW else log_magnitudes(count, 0.0, 0.0)


@njit_no_refcount
def log_of_two(square, compared, square_mag2, reference_sigma_rad, clutter):  # type: ignore[no-untyped-def]
    """The additional log weight of a hypothesis of only two stars; see `TWO_STARS_BONUS`.

    `square` is the weighted sum of squared residuals, `square_mag2` that of the differences of
    `compared` magnitudes; `clutter` is the number of other stars.
    """
    bonus = TWO_STARS_BONUS if compared == 2 else 0.0
    if clutter > 0:
        bonus += TWO_OF_MANY
    sigmas2 = square / (reference_sigma_rad * reference_sigma_rad)
    magnitudes = 0.5 * square_mag2 / (TWO_STARS_SIGMA_MAG * TWO_STARS_SIGMA_MAG)
    return bonus - TWO_STARS_PER_SQUARE * sigmas2 - magnitudes


@njit_no_refcount
def log_null(count, with_magnitude):  # type: ignore[no-untyped-def]
    """The log weight of the null hypothesis: no real star at all, or a single one.

    A single real star may be any star of the zone, whose number cancels the density; the spread of
    its magnitude is assumed to be that of clutter.
    """
    none = log_clutter(count, 0)
    one = log_clutter(count - 1, 1) + math.log(count)
    top = max(none, one)
    both = top + math.log(math.exp(none - top) + math.exp(one - top))
    return both - with_magnitude * LOG_CLUTTER_SPAN
