"""Contradictions among the stars of a batch: trackers that disagree, and motion that is not known.

Stars are carried to the time of their batch with its body rates.  Rates that are missing or wrong,
a tracker's clock and a tracker's alignment turn some stars against the others: by an angle, or by
one that grows with the time of a star.  Such a turn is fitted to the residuals of the attitude.
"""

import math
from dataclasses import dataclass

import numpy as np

from service.acquire.zone_search import Search
from service.attitude.solution import DIFFERENT_CHI_SQUARE, AttitudeSolution, taste_bound
from service.identify.attitude_from_matches import matched_vectors
from service.identify.identification import Identification
from service.missions.motion import MotionSettings
from service.observations.calibrate import CorrectedObservations
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector, matrix_from_quaternion

LEAST_EIGENVALUE = 1e-9
"""Least information about an axis of a turn that is used, as a share of that of the stars."""


@dataclass(frozen=True, eq=False)
class Turn:
    """A turn of some stars against the others, about the body axes, for one unit of their shares.

    `rad` (3,) is fitted with the attitude, and `chi_square` is what it takes from the weighted sum
    of squared residuals (3 degrees of freedom).  `information` (3, 3) is the inverse covariance of
    the turn in rad^-2, and `of_attitude` (3, 3) the error of the attitude for one rad of turn.
    """

    rad: Vector
    chi_square: float
    information: Matrix
    of_attitude: Matrix

    def contradicts(self, solution: AttitudeSolution) -> bool:
        """True if the turn is no chance, and the stars agree with it."""
        left = solution.taste - self.chi_square
        # The number of degrees of freedom is even then; the bound is that of the next odd one.
        freedom = max(solution.degrees_of_freedom - 2, 1)
        return self.chi_square > DIFFERENT_CHI_SQUARE and left <= taste_bound(freedom)


def turn_of(
    observed: Vector, reference: Vector, sigma_rad: Vector, quaternion: Vector, share: Vector
) -> Turn:
    """Fit a turn of N matched vectors (N, 3) in proportion to their `share` (N,).

    `observed` is in body axes, `reference` inertial, and `quaternion` the attitude that fits them
    best.
    """
    predicted = reference @ matrix_from_quaternion(quaternion).T
    residual, weight = observed - predicted, 1.0 / sigma_rad**2
    shared = weight * share
    alone, both = _information(predicted, weight), _information(predicted, shared)
    # Of a batch with a rival attitude one star or none may be matched, which leaves axes unknown.
    of_attitude = np.linalg.pinv(alone, LEAST_EIGENVALUE, hermitian=True) @ both
    information = _information(predicted, shared * share) - both @ of_attitude
    pull = _pull(residual, predicted, shared) - of_attitude.T @ _pull(residual, predicted, weight)
    values, axes = np.linalg.eigh(information)
    known = values > LEAST_EIGENVALUE * float(np.trace(alone)) * max(float(share @ share), 1e-30)
    along = (axes.T @ pull)[known] / values[known]
    rad = axes[:, known] @ along
    return Turn(rad, float(pull @ rad), information, of_attitude)


def _information(directions: Vector, weight: Vector) -> Matrix:
    """Information (3, 3) about a common rotation of directions (N, 3) of given weights (N,)."""
    return np.asarray(weight.sum() * np.eye(3) - (directions.T * weight) @ directions)


def _pull(residual: Vector, directions: Vector, weight: Vector) -> Vector:
    """Weighted sum (3,) of the cross products of residuals and directions, (N, 3) each."""
    products = (residual.T * weight) @ directions
    return (products - products.T)[[1, 2, 0], [2, 0, 1]]


def doubts_of(
    search: Search,
    solution: AttitudeSolution,
    corrected: tuple[CorrectedObservations, ...],
    identifications: list[Identification],
) -> tuple[list[str], bool]:
    """Warnings that the motion or the trackers contradict the stars, and true if any does."""
    offset_s = np.concatenate([each.time_offset_s for each in search.batch.observations])
    is_timed = bool(offset_s.any())
    is_still = not search.batch.body_rates_deg_per_s.any()
    may_contradict = solution.taste > DIFFERENT_CHI_SQUARE
    if not may_contradict and not (is_timed and is_still):
        return [], False
    star = np.concatenate([each.star for each in identifications])
    used = star >= 0
    matched = matched_vectors(
        np.concatenate([each.direction_body for each in corrected]),
        np.concatenate([each.sigma_rad for each in corrected]),
        *(star, search.catalog_direction, search.velocity_c, search.sun_au),
    )
    warnings, is_contradicted = [], False
    if is_timed:
        turn = turn_of(*matched, solution.quest, offset_s[used])
        if turn.contradicts(solution):
            warnings.append(_rates_contradicted(search, turn, offset_s[used]))
            return warnings, True
        if is_still:
            warnings += _motion_unknown(search, solution, turn, offset_s[used])
    if may_contradict:
        tracker_of = np.repeat(
            np.arange(len(corrected)), [len(each.sigma_rad) for each in corrected]
        )
        turned = np.unique(tracker_of[used]).tolist()
        if len(turned) < 3:
            # The second of two trackers is turned against the first by the opposite.
            turned = turned[:-1]
        for index in turned:
            share = (tracker_of[used] == index).astype(float)
            turn = turn_of(*matched, solution.quest, share)
            if turn.contradicts(solution):
                is_contradicted = True
                angle = float(np.linalg.norm(turn.rad)) * ARCSEC_PER_RADIAN
                warnings.append(
                    f"trackers_disagree: {corrected[index].tracker.name} is turned by {angle:.3g} "
                    f"arcsec against the other stars (chi-square {turn.chi_square:.0f}): by its "
                    "alignment, its clock, or a motion that body_rates_deg_per_s do not hold"
                )
    return warnings, is_contradicted


def _rates_contradicted(search: Search, turn: Turn, offset_s: Vector) -> str:
    rates = search.batch.body_rates_deg_per_s + np.degrees(turn.rad)
    x, y, z = rates.tolist()
    assumed = (
        "body_rates_deg_per_s" if search.batch.body_rates_deg_per_s.any() else "a body at rest"
    )
    return (
        f"rates_contradicted: stars seen {offset_s.min():+.3g} to {offset_s.max():+.3g} s after "
        f"the batch's time fit rates of ({x:.3g}, {y:.3g}, {z:.3g}) deg/s, not {assumed} "
        f"(chi-square {turn.chi_square:.0f})"
    )


def _motion_unknown(
    search: Search, solution: AttitudeSolution, turn: Turn, offset_s: Vector
) -> list[str]:
    """The warning that a motion within the mission's rates would move the attitude noticeably."""
    settings = search.mission.motion or MotionSettings()
    least = np.eye(3) / settings.rate_sigma_rad_s**2
    rate_rad2 = np.linalg.inv(turn.information + least)
    added = turn.of_attitude @ rate_rad2 @ turn.of_attitude.T * ARCSEC_PER_RADIAN**2
    worst = int(np.argmax(np.diag(added) / np.diag(solution.covariance_arcsec2)))
    if added[worst, worst] <= solution.covariance_arcsec2[worst, worst]:
        return []
    off_s = float(np.trace(turn.of_attitude)) / 3.0
    rate_deg_per_s = math.degrees(settings.rate_sigma_rad_s)
    warning = (
        f"motion_unknown: body_rates_deg_per_s are zero or not given, and the stars were seen "
        f"{off_s:+.3g} s after the batch's time; rates of {rate_deg_per_s:.2g} deg/s would turn "
        f"the attitude by {math.sqrt(added[worst, worst]):.2g} arcsec about {'XYZ'[worst]}"
    )
    return [warning]
