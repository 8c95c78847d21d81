"""Matched vectors to an attitude: TRIAD beside QUEST, covariance, residuals, TASTE.

Quaternions are scalar last, inertial to body; the covariance is of the small
rotation about the body axes.  TASTE (Shuster) is the weighted sum of squared
residuals.
"""

import math
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from service.attitude import kernels
from service.attitude.solution import AttitudeSolution, NoAttitude, TrackerFit
from service.vectors import ARCSEC_PER_RADIAN, Vector, read_only

WORST_AXIS_DEG = 1.0
SUSPECT_TAIL = 0.001
"""A true solution's TASTE passes the bound that makes it suspect with this probability."""
METHODS = ("triad", "quest")


def solve_attitude(
    observed: Vector,
    reference: Vector,
    sigma_arcsec: Vector,
    tracker_of: npt.NDArray[np.int64],
    trackers: tuple[str, ...],
    method: str = "quest",
) -> AttitudeSolution | NoAttitude:
    """The attitude of N matched unit vectors, or the reason for none.

    `observed` (N, 3) is in body axes, `reference` (N, 3) inertial, sigma one
    standard deviation per tangent axis; `tracker_of` (N,) says which of
    `trackers` saw each.  `method` (`quest` or `triad`) chooses whose quaternion
    and residuals are the solution's.
    """
    n = len(observed)
    if n < 2:
        return NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS
    sigma_rad = sigma_arcsec / ARCSEC_PER_RADIAN
    quaternions, covariance, squares = np.empty((2, 4)), np.empty((3, 3)), np.empty((2, n))
    if not kernels.solve(
        observed,
        reference,
        sigma_rad,
        math.radians(WORST_AXIS_DEG),
        quaternions,
        covariance,
        squares,
    ):
        return NoAttitude.DEGENERATE_GEOMETRY
    chosen = METHODS.index(method)
    square = squares[chosen]
    weighted = square / sigma_rad**2
    taste = float(weighted.sum())
    freedom = 2 * n - 3
    suspect = taste > taste_bound(freedom)
    residual_arcsec = np.sqrt(square) * ARCSEC_PER_RADIAN
    between = float(np.linalg.norm(quaternions[0] - quaternions[1]))
    between = min(between, float(np.linalg.norm(quaternions[0] + quaternions[1])))
    return AttitudeSolution(
        quaternion=read_only(quaternions[chosen].copy()),
        method=method,
        covariance_arcsec2=read_only(covariance * ARCSEC_PER_RADIAN**2),
        residual_arcsec=read_only(residual_arcsec),
        residual_rms_arcsec=math.sqrt(float(residual_arcsec @ residual_arcsec) / n),
        predicted_rms_arcsec=_predicted_rms_arcsec(sigma_arcsec, freedom),
        taste=taste,
        degrees_of_freedom=freedom,
        suspect=suspect,
        triad=read_only(quaternions[0].copy()),
        quest=read_only(quaternions[1].copy()),
        triad_quest_angle_arcsec=4.0 * math.asin(min(1.0, between / 2.0)) * ARCSEC_PER_RADIAN,
        trackers=_tracker_fits(weighted, tracker_of, trackers, suspect),
    )


@lru_cache(maxsize=1024)
def taste_bound(degrees_of_freedom: int) -> float:
    """The 99.9 % point of chi-square: beyond it a solution is suspect."""
    from scipy.special import chdtri

    return float(chdtri(degrees_of_freedom, SUSPECT_TAIL))


def _predicted_rms_arcsec(sigma_arcsec: Vector, freedom: int) -> float:
    # Of the 2 N measured angles the attitude takes up three.
    n = len(sigma_arcsec)
    mean_square = float(sigma_arcsec @ sigma_arcsec) / n
    return math.sqrt(mean_square * freedom / n)


def _tracker_fits(
    weighted: Vector, tracker_of: npt.NDArray[np.int64], trackers: tuple[str, ...], suspect: bool
) -> tuple[TrackerFit, ...]:
    """Each tracker's share of TASTE; of a suspect joint solution the worst per star is the outlier."""
    if len(trackers) < 2:
        return ()
    stars = np.bincount(tracker_of, minlength=len(trackers))
    taste = np.bincount(tracker_of, weights=weighted, minlength=len(trackers))
    per_star = np.where(stars > 0, taste / np.maximum(stars, 1), -1.0)
    worst = int(np.argmax(per_star)) if suspect and np.count_nonzero(stars) > 1 else -1
    return tuple(
        TrackerFit(name, int(stars[i]), float(taste[i]), i == worst)
        for i, name in enumerate(trackers)
    )
