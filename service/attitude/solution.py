"""Matched vectors to an attitude: TRIAD beside QUEST, and all that tells how far to trust it.

Quaternions are scalar last, inertial to body; the covariance is of the small
rotation about the body axes.  TASTE (Shuster) is the weighted sum of squared
residuals of QUEST's attitude.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from service.attitude.kernels import QUEST, TASTE, TRIAD, FitWorkspace, fit_attitude
from service.vectors import Matrix, Vector, matrix_from_quaternion

WORST_AXIS_DEG = 1.0
WORST_AXIS_RAD = math.radians(WORST_AXIS_DEG)
SUSPECT_TAIL = 0.001
"""A true solution's TASTE passes the bound that makes it suspect with this probability."""
ODDS_OF_TWO = 100.0
"""Least likelihood ratio for which one of two trackers is named as the faulty one."""
METHODS = ("triad", "quest")
"""By their rows in the quaternions of a fit."""


class NoAttitude(StrEnum):
    """Why there is no attitude."""

    FEWER_THAN_TWO_UNIQUE_STARS = "fewer_than_two_unique_stars"
    DEGENERATE_GEOMETRY = "degenerate_geometry"
    FEWER_THAN_THREE_STARS = "fewer_than_three_stars"
    """Without a prior two stars say nothing."""
    NO_MATCH = "no_match"
    """No attitude of the whole sky explains three of the stars."""
    DOUBTFUL_MATCH = "doubtful_match"
    """An attitude explains some, but chance or another attitude may as well."""


@dataclass(frozen=True)
class TrackerFit:
    """How one tracker's stars agree with the joint attitude."""

    tracker: str
    stars: int
    taste: float
    outlier: bool


class AttitudeSolution(Struct, frozen=True, eq=False, gc=False):
    """An attitude, inertial to body, from N >= 2 matched vectors.

    `quaternion` is the chosen method's and `matrix` (3, 3) that of it: body
    components = matrix @ inertial components.  `triad` and `quest` stand side by
    side with the angle between them.  `covariance_arcsec2` (3, 3) is the chosen
    method's, of the small rotation about the body axes.  `residual_arcsec` has
    one row a vector, the angle between the observed direction and the one that
    the chosen attitude predicts, NaN where there is no reference to predict it
    from.  `taste` is the weighted sum of squares at QUEST's attitude whichever
    method is chosen, about chi-square with 2N - 3 degrees of freedom; beyond its
    99.9 % point the solution is suspect.

    Of an attitude that a tracker measured itself (`acquire.measured`) all that needs stars is NaN.
    """

    quaternion: Vector
    matrix: Matrix
    method: str
    covariance_arcsec2: Matrix
    residual_arcsec: Vector
    residual_rms_arcsec: float
    predicted_rms_arcsec: float
    taste: float
    degrees_of_freedom: int
    suspect: bool
    triad: Vector
    quest: Vector
    triad_quest_angle_arcsec: float
    trackers: tuple[TrackerFit, ...]


def solve_attitude(
    observed: Vector,
    reference: Vector,
    sigma_rad: Vector,
    tracker_of: npt.NDArray[np.int64],
    trackers: tuple[str, ...],
    method: str = "quest",
) -> AttitudeSolution | NoAttitude:
    """The attitude of N matched unit vectors, or the reason for none.

    `observed` (N, 3) is in body axes, `reference` (N, 3) inertial, sigma one
    standard deviation per tangent axis in radians; `tracker_of` (N,) says which of
    `trackers` saw each.  `method` (`quest` or `triad`) chooses whose quaternion,
    covariance and residuals are the solution's.
    """
    n = len(observed)
    if n < 2:
        return NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS
    workspace = fit_workspace(n)
    chosen = METHODS.index(method)
    if not fit_attitude(observed, reference, sigma_rad, WORST_AXIS_RAD, chosen, workspace):
        return NoAttitude.DEGENERATE_GEOMETRY
    solution = solution_of(workspace, n, method)
    if len(trackers) > 1:
        fits = tracker_fits(observed, reference, sigma_rad, solution, tracker_of, trackers)
        solution = replace(solution, trackers=fits)
    return solution


def fit_workspace(n: int) -> FitWorkspace:
    """Room for what `fit_attitude` writes of n vectors."""
    return FitWorkspace(
        quaternions=np.empty((3, 4)),
        attitude=np.empty((3, 3)),
        covariance_arcsec2=np.empty((3, 3)),
        residual_arcsec=np.empty(n),
        figures=np.empty(4),
    )


def solution_of(workspace: FitWorkspace, matched: int, method: str) -> AttitudeSolution:
    """The solution that `fit_attitude` wrote, of so many matched vectors; its arrays are locked."""
    rms_arcsec, predicted_arcsec, taste, apart_arcsec = workspace.figures.tolist()
    freedom = 2 * matched - 3
    for array in workspace:
        array.setflags(write=False)
    quaternions = workspace.quaternions
    return AttitudeSolution(
        quaternion=quaternions[METHODS.index(method)],
        matrix=workspace.attitude,
        method=method,
        covariance_arcsec2=workspace.covariance_arcsec2,
        residual_arcsec=workspace.residual_arcsec,
        residual_rms_arcsec=rms_arcsec,
        predicted_rms_arcsec=predicted_arcsec,
        taste=taste,
        degrees_of_freedom=freedom,
        suspect=taste > taste_bound(freedom),
        triad=quaternions[TRIAD],
        quest=quaternions[QUEST],
        triad_quest_angle_arcsec=apart_arcsec,
        trackers=(),
    )


@lru_cache(maxsize=1024)
def taste_bound(degrees_of_freedom: int) -> float:
    """The 99.9 % point of chi-square: beyond it a solution is suspect.

    `degrees_of_freedom` is odd, as 2 N - 3 is.  By Newton's steps on the
    logarithm of the tail; scipy, which knows it too, takes longer to load than
    the first hundred batches to solve.
    """
    bound = float(degrees_of_freedom) + 10.0
    for _ in range(100):
        tail, density = _chi_square(bound, degrees_of_freedom)
        step = math.log(tail / SUSPECT_TAIL) * tail / density
        bound += step
        if abs(step) < 1e-13 * bound:
            break
    return bound


def _chi_square(x: float, odd: int) -> tuple[float, float]:
    """The probability of more than x, and the density there, of chi-square with `odd` degrees."""
    half = odd / 2.0
    density = math.exp((half - 1.0) * math.log(x / 2.0) - x / 2.0 - math.lgamma(half)) / 2.0
    # Abramowitz & Stegun 26.4.4: each two degrees add twice the density of the sum.
    tail, term = math.erfc(math.sqrt(x / 2.0)), density
    for degrees in range(odd, 1, -2):
        tail += 2.0 * term
        term *= (degrees - 2) / x
    return tail, density


def tracker_fits(
    observed: Vector,
    reference: Vector,
    sigma_rad: Vector,
    solution: AttitudeSolution,
    tracker_of: npt.NDArray[np.int64],
    trackers: tuple[str, ...],
) -> tuple[TrackerFit, ...]:
    """Each tracker's share of TASTE, and whether it is the one that does not agree."""
    quest = matrix_from_quaternion(solution.quest)
    weighted = np.sum((observed - reference @ quest.T) ** 2, axis=1) / sigma_rad**2
    stars = np.bincount(tracker_of, minlength=len(trackers))
    taste = np.bincount(tracker_of, weights=weighted, minlength=len(trackers))
    outlier = _outlier(observed, reference, sigma_rad, tracker_of) if solution.suspect else -1
    return tuple(
        TrackerFit(name, int(stars[i]), float(taste[i]), i == outlier)
        for i, name in enumerate(trackers)
    )


def _outlier(
    observed: Vector, reference: Vector, sigma_rad: Vector, tracker_of: npt.NDArray[np.int64]
) -> int:
    """The tracker without which the rest agrees best; -1 where it never agrees, or two are alike.

    The shares of TASTE do not tell: a misaligned tracker with most of the stars
    pulls the joint attitude to itself, and the others look worse.  Of two
    trackers that disagree, each in itself sound, neither can be named.
    """
    from scipy.special import chdtrc

    tails = []
    for tracker in np.unique(tracker_of):
        rest = tracker_of != tracker
        n = int(rest.sum())
        tail = 0.0
        if n > 1:
            parts = observed[rest], reference[rest], sigma_rad[rest]
            workspace = fit_workspace(n)
            solved = fit_attitude(*parts, WORST_AXIS_RAD, QUEST, workspace)
            tail = float(chdtrc(2 * n - 3, workspace.figures[TASTE])) if solved else 0.0
        tails.append((tail, int(tracker)))
    (second, _), (best, outlier) = sorted(tails)[-2:] if len(tails) > 1 else [(0.0, -1)] * 2
    plain = len(tails) > 2 or best > ODDS_OF_TWO * second
    return outlier if plain and best > SUSPECT_TAIL else -1
