"""The attitude that matched vectors give, with all that tells how far to trust it."""

from dataclasses import dataclass
from enum import StrEnum

from msgspec import Struct

from service.vectors import Matrix, Vector


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
