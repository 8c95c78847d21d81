"""Attitude solutions from matched vectors by TRIAD and QUEST, with measures of their quality.

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
"""Probability that the TASTE of a correct solution exceeds the bound for suspicion."""
DIFFERENT_CHI_SQUARE = 30.0
"""Chi-square (3 degrees of freedom) of the difference of equal attitudes at probability 1e-6."""
ODDS_OF_TWO = 100.0
"""Least likelihood ratio for which one of two trackers is named as the faulty one."""
METHODS = ("triad", "quest")
"""The methods in the order of their rows in a fit's quaternions."""


class NoAttitude(StrEnum):
    """The reasons for having no attitude."""

    FEWER_THAN_TWO_UNIQUE_STARS = "fewer_than_two_unique_stars"
    DEGENERATE_GEOMETRY = "degenerate_geometry"
    FEWER_THAN_THREE_STARS = "fewer_than_three_stars"
    """Reason for no attitude: without a prior, two stars are ambiguous."""
    NO_MATCH = "no_match"
    """Reason for no attitude: none in the whole sky explains three of the stars."""
    DOUBTFUL_MATCH = "doubtful_match"
    """Reason for no attitude: one explains some stars, but so may chance or another."""


@dataclass(frozen=True)
class TrackerFit:
    """The agreement of one tracker's stars with the joint attitude."""

    tracker: str
    stars: int
    taste: float
    outlier: bool


class AttitudeSolution(Struct, frozen=True, eq=False, gc=False):
    """An attitude solution, inertial to body, from N >= 2 matched vectors.

    `quaternion` is that of the chosen method, and `matrix` (3, 3) the same attitude: body
    components = matrix @ inertial components. `triad` and `quest` are given with the angle between
    them. `covariance_arcsec2` (3, 3) is the chosen method's, of the small rotation about the body
    axes. `residual_arcsec` has one row per vector, the angle between the observed direction and the
    one that the chosen attitude predicts, NaN for a star without an identity. `taste` is the
    weighted sum of squares at QUEST's attitude whichever method is chosen, about chi-square with 2N
    - 3 degrees of freedom; beyond its 99.9 % point the solution is suspect.

    For an attitude measured by a tracker itself (`acquire.measured`) all values that need stars are
    NaN.
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

    `observed` (N, 3) is in body axes, `reference` (N, 3) inertial, sigma one standard deviation per
    tangent axis in radians; `tracker_of` (N,) is the index in `trackers` for each star. `method`
    (`quest` or `triad`) selects the quaternion, covariance and residuals of the solution.
    """
    n = len(observed)
    if n < 2:
        return NoAttitude.FEWER_THAN_TWO_UNIQUE_STARS
    workspace = fit_workspace(n)
    # Of the kind of array that the kernel is compiled for, whatever the caller's are.
    vectors = (np.array(each, order="C") for each in (observed, reference, sigma_rad))
    if not fit_attitude(*vectors, WORST_AXIS_RAD, METHODS.index(method), workspace):
        return NoAttitude.DEGENERATE_GEOMETRY
    solution = solution_of(workspace, n, method)
    if len(trackers) > 1:
        fits = tracker_fits(observed, reference, sigma_rad, solution, tracker_of, trackers)
        solution = replace(solution, trackers=fits)
    return solution


def fit_workspace(n: int) -> FitWorkspace:
    """Empty output arrays of `fit_attitude` for n vectors."""
    return FitWorkspace(
        quaternions=np.empty((3, 4)),
        attitude=np.empty((3, 3)),
        covariance_arcsec2=np.empty((3, 3)),
        residual_arcsec=np.empty(n),
        figures=np.empty(4),
    )


def solution_of(workspace: FitWorkspace, matched: int, method: str) -> AttitudeSolution:
    """The solution from the arrays filled by `fit_attitude`, which become read-only."""
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
    """The 99.9 % point of chi-square, above which a solution's TASTE is suspect.

    `degrees_of_freedom` is odd, as 2 N - 3 is. Computed by Newton steps on the logarithm of the
    tail, because importing scipy takes longer than solving a hundred batches.
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
    """The tail probability beyond x, and the density at x, of chi-square with `odd` degrees."""
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
    """Each tracker's contribution to TASTE, and true for one that disagrees with the others."""
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
    """The tracker without which the rest agrees best; -1 if the rest never agrees or two tie.

    The contributions to TASTE are misleading: a misaligned tracker with most of the stars dominates
    the joint attitude, and the others look worse. If two trackers disagree and each is consistent
    in itself, neither can be named.
    """
    from scipy.special import chdtrc

    tails = []
    for tracker in np.unique(tracker_of):
        rest = tracker_of != tracker
        n = int(rest.sum())
        tail = 0.0
        if n > 1:
            parts = (np.array(each[rest], order="C") for each in (observed, reference, sigma_rad))
            workspace = fit_workspace(n)
            solved = fit_attitude(*parts, WORST_AXIS_RAD, QUEST, workspace)
            tail = float(chdtrc(2 * n - 3, workspace.figures[TASTE])) if solved else 0.0
        tails.append((tail, int(tracker)))
    (second, _), (best, outlier) = sorted(tails)[-2:] if len(tails) > 1 else [(0.0, -1)] * 2
    plain = len(tails) > 2 or best > ODDS_OF_TWO * second
    return outlier if plain and best > SUSPECT_TAIL else -1
