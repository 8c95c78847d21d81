"""The data of charts: the stars of a batch, and the batches of a period as arrays.

Batches (b) are in order of time.  Where something is not known an array has NaN.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.sky.zones import SearchRegion
from service.times import Utc
from service.vectors import Vector


@dataclass(frozen=True, eq=False)
class PeriodAttitudes:
    """The attitudes of the batches that were read.

    `quaternion` (b, 4) is inertial to body, `covariance_arcsec2` (b, 3, 3) of the error
    rotation about the body axes.  `status` is `good`, `suspect` or `no_attitude`.
    `follows` (b,) says whether no other batch lies between one and that before it.
    """

    time_ns: npt.NDArray[np.int64]
    time: tuple[str, ...]
    status: tuple[str, ...]
    quaternion: Vector
    covariance_arcsec2: Vector
    follows: npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class TrackerStarsOfPeriod:
    """The unique stars (n) of one tracker, and where it looked in each batch.

    `place_deg` (n, 2) is h and v on the focal plane.  `residual_arcsec` (n, 2) is
    observed minus predicted along h and along v, and `expected_arcsec` (n, 2) its
    standard deviation: the star's sigma less the part of the noise that the
    attitude takes up.  Both are NaN for a star that the attitude does not use.
    `boresight` (b, 3) is inertial; without an attitude that of the a priori one.
    """

    tracker: str
    field_of_view_radius_deg: float
    sigma_arcsec: float
    boresight: Vector
    place_deg: Vector
    residual_arcsec: Vector
    expected_arcsec: Vector
    observed_mag: Vector
    catalog_mag: Vector
    region: SearchRegion | None
    """Where the stars of the latest batch were searched for."""


@dataclass(frozen=True, eq=False)
class PeriodStars:
    """What was read of the `total` batches of a period: all, or some where there are many.

    `other_catalog` is how many of those read were identified with a star catalog that
    the service no longer has; they are without stars here.  `sun` (b, 3) are inertial
    directions to the Sun.
    """

    total: int
    attitudes: PeriodAttitudes
    trackers: tuple[TrackerStarsOfPeriod, ...]
    other_catalog: int
    sun: Vector
    first: Utc | None
    last: Utc | None

    @property
    def read(self) -> int:
        """The number of batches that were read."""
        return len(self.attitudes.time)


# The stars of a batch in each tracker's field of view: the data of the chart on its page.
#
# Directions are given as `h_deg`, `v_deg`: that of (tan h, tan v, 1) in the tracker's axes.


class Boresight(Struct, frozen=True, kw_only=True):
    """The boresight in the inertial frame."""

    ra_deg: float
    dec_deg: float


class CatalogStarPlace(Struct, frozen=True, kw_only=True):
    """A catalog star in the field of view."""

    id: str
    magnitude: float
    h_deg: float
    v_deg: float


class ObservedStarPlace(Struct, frozen=True, kw_only=True):
    """An observed star with its outcome; `residual_arcsec` is observed minus predicted.

    The residual is along h and along v, None if the attitude does not use the star.
    """

    outcome: str
    star: str | None
    rivals: list[str]
    magnitude: float | None
    h_deg: float
    v_deg: float
    residual_arcsec: tuple[float, float] | None


class TrackerField(Struct, frozen=True, kw_only=True):
    """The view of one tracker; `zone_edges` are lines of [h, v] in degrees."""

    tracker: str
    boresight: Boresight
    field_of_view_radius_deg: float
    radius_deg: float
    magnitude_limit_mag: float
    zone_edges: list[list[list[float]]]
    catalog: list[CatalogStarPlace]
    observed: list[ObservedStarPlace]


class StarField(Struct, frozen=True, kw_only=True):
    """The views of all trackers of a batch.

    `through` is "quest", "triad" or "a_priori": the attitude by which catalog stars are drawn.
    `same_catalog` says whether the run catalog is the one of the answer.
    """

    through: str
    same_catalog: bool
    trackers: list[TrackerField]
