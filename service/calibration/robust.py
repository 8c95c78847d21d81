"""Huber's weights for residuals along two tangents, and what they do to a covariance."""

import math

import numpy as np

from service.calibration.linearise import Weights
from service.vectors import Vector

HUBER = 2.0
"""Bound of a star's residual, both tangents together, in sigmas.

Estimates keep 96 % of the efficiency that least squares has with Gaussian errors.
"""
WRONG = 5.0
"""A residual beyond so many sigmas is no measurement of that star (Gaussian: 4 in a million)."""
MEDIAN_RADIUS = math.sqrt(2.0 * math.log(2.0))
"""Median of the length of two Gaussian residuals, in sigmas."""


def scale_of(residual: Vector, used: int, freedom: int) -> float:
    """Sigma of one residual of (2, n) by their median length.

    `used` residuals have `freedom` degrees of freedom: the fit has made them smaller.
    """
    length = np.hypot(residual[0], residual[1])
    return max(float(np.median(length)) / MEDIAN_RADIUS * math.sqrt(used / max(freedom, 1)), 1e-12)


def weights(residual: Vector, scale: float, leave_out: bool) -> Weights:
    """Weights (n,) of stars with these residuals (2, n).

    With `leave_out` those beyond `WRONG` have none.
    """
    length = np.hypot(residual[0], residual[1]) / scale
    weight = np.minimum(1.0, HUBER / np.maximum(length, 1e-300))
    return np.where(length > WRONG, 0.0, weight) if leave_out else weight


def covariance_factor(residual: Vector, scale: float, freedom: int) -> float:
    """What the inverse of the unweighted normal matrix is multiplied by (Huber 1981, 7.6).

    The mean square of the bounded residuals over the square of the mean slope of the
    bound; `residual` (2, n) are those of the stars that were not left out.
    """
    length = np.hypot(residual[0], residual[1]) / scale
    bounded = np.minimum(length, HUBER) * scale
    # Beyond the bound only the direction across the residual still moves it.
    slope = np.where(length <= HUBER, 1.0, 0.5 * HUBER / np.maximum(length, 1e-300))
    return float(np.sum(bounded**2)) / max(freedom, 1) / float(slope.mean()) ** 2
