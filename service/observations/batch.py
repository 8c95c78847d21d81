"""The data structures of a batch of observed stars: arrays, with units in the names."""

from typing import Literal

from msgspec import Struct

from service.missions.mission import Identifier, SolverName
from service.times import Utc
from service.vectors import Matrix, Vector

MAX_STARS_PER_TRACKER = 250
MAX_TRACKERS = 16

Aberration = Literal["to_correct", "applied_upstream", "ignore"]


class QuaternionPrior(Struct, frozen=True, eq=False):
    """An a priori attitude as a quaternion of norm one: inertial to body, scalar last."""

    quaternion: Vector


class PredictedPrior(QuaternionPrior, frozen=True, eq=False):
    """A predicted attitude, with its covariance (3, 3) about the body axes.

    `margin_deg` is the distance by which its search zones extend beyond the fields of view.
    """

    covariance_arcsec2: Matrix
    margin_deg: float


class Tracking(Struct, frozen=True, eq=False):
    """Source of a prediction for a batch that asks for the last attitude, or the reason for none.

    If both `result` and `reason` are None, the prediction is still to be made. The predicted
    attitude itself is the batch's `a_priori`.
    """

    by_default: bool
    result: str | None = None
    age_s: float | None = None
    rate: str | None = None
    reason: str | None = None
    resolved: bool = False


class BoresightPrior(Struct, frozen=True):
    """An a priori direction of the spacecraft's boresight, with unknown roll (cap missions)."""

    ra_deg: float
    dec_deg: float


class SunPointedPrior(Struct, frozen=True):
    """An a priori attitude with the mission's pole on the Sun and unknown roll (band missions).

    `sun_vector` is inertial, spacecraft to Sun; without it an ephemeris gives the Sun, seen from
    `position_km` (geocentric, EME2000) if given. `sun_counts` (4,) of the mission's Sun tracker
    give the Sun's direction in body axes; without them the zone's axis is assumed.
    """

    sun_vector: Vector | None
    position_km: Vector | None
    sun_counts: Vector | None = None


APriori = QuaternionPrior | BoresightPrior | SunPointedPrior


class Options(Struct, frozen=True):
    """Options of a batch or what-if run that override the mission's settings."""

    identifier: Identifier | None = None
    solver: SolverName | None = None
    tests: dict[str, bool] = {}
    tolerances: dict[str, float] = {}
    zone_grid_deg: float | None = None


class Readings(Struct, frozen=True, eq=False):
    """The raw readings of a scanning tracker along h and along v, in the mission's units.

    For a star, the `counts` of two lines or the `times` of crossings; for a whole raster its
    `lines`.
    """

    kind: Literal["counts", "times", "lines"]
    h: Vector
    v: Vector


class TrackerStars(Struct, frozen=True, eq=False):
    """The stars observed by one tracker, in their order.

    `vector` rows are unit vectors in tracker axes, NaN for stars with measured `angles_deg` (h, v),
    which are NaN otherwise. Magnitude is NaN if missing; sigma is NaN if the mission's applies.
    """

    tracker: str
    vector: Vector
    angles_deg: Vector
    magnitude_mag: Vector
    time_offset_s: Vector
    sigma_arcsec: Vector
    readings: tuple[Readings | None, ...] = ()
    """The readings of a scanning tracker per star, or of one raster before its stars are extracted.

    `service.observations.scans.reduce` converts them to angles.
    """

    @property
    def count(self) -> int:
        """The number of stars that a tracker observed."""
        return len(self.magnitude_mag)


class MeasuredAttitude(Struct, frozen=True, eq=False):
    """An attitude measured by a tracker itself: from inertial to tracker axes, or to body axes.

    `tracker` names the tracker; None for body axes. `covariance_arcsec2` (3, 3) is of the small
    rotation about the same axes.
    """

    quaternion: Vector
    covariance_arcsec2: Matrix
    tracker: str | None = None


class ObservationBatch(Struct, frozen=True, eq=False):
    """A batch of observations: spacecraft, time, a priori attitude, stars of each tracker.

    With a `measurement` there are neither stars nor a priori knowledge. Without `a_priori` a batch
    of stars is lost in space. `tracking` is set for a batch that asks for the last attitude. Body
    rates are of the body relative to inertial, in body axes. Velocity and position are geocentric,
    EME2000, None if missing.
    """

    spacecraft: str
    batch: str
    run: str
    time: Utc
    a_priori: APriori | None
    body_rates_deg_per_s: Vector
    velocity_km_per_s: Vector | None
    aberration: Aberration
    observations: tuple[TrackerStars, ...]
    options: Options
    position_km: Vector | None = None
    tracking: Tracking | None = None
    measurement: MeasuredAttitude | None = None
    remarks: tuple[str, ...] = ()
    """Notes on values taken otherwise than sent: a code, a colon and a sentence each."""
