"""A batch of observed stars as the core sees it: arrays, units in the names."""

from typing import Literal

from msgspec import Struct

from service.missions.mission import Identifier, SolverName
from service.times import Utc
from service.vectors import Matrix, Vector

MAX_STARS_PER_TRACKER = 250
MAX_TRACKERS = 16

Aberration = Literal["to_correct", "applied_upstream", "ignore"]


class QuaternionPrior(Struct, frozen=True, eq=False):
    """An a priori attitude: inertial to body, scalar last, of norm one."""

    quaternion: Vector


class PredictedPrior(QuaternionPrior, frozen=True, eq=False):
    """An attitude that was predicted, with its covariance (3, 3) about the body axes.

    `margin_deg` is how far its zones reach beyond the fields of view.
    """

    covariance_arcsec2: Matrix
    margin_deg: float


class Tracking(Struct, frozen=True, eq=False):
    """Source of the prediction for a batch that asks for the last attitude, or why there is none.

    Without `result` and `reason` nothing was looked up yet.  The prediction itself is
    the batch's `a_priori`.
    """

    by_default: bool
    result: str | None = None
    age_s: float | None = None
    rate: str | None = None
    reason: str | None = None
    resolved: bool = False


class BoresightPrior(Struct, frozen=True):
    """An a priori direction of the spacecraft's boresight, roll unknown (cap missions)."""

    ra_deg: float
    dec_deg: float


class SunPointedPrior(Struct, frozen=True):
    """The pole is on the Sun, roll unknown (band missions).

    `sun_vector` is inertial, spacecraft to Sun; without it the Sun is taken
    from an ephemeris, seen from `position_km` (geocentric, EME2000) if given.
    `sun_counts` (4,) of the mission's sun tracker tell where in the body the Sun is; without
    them it is taken to be along the zone's axis.
    """

    sun_vector: Vector | None
    position_km: Vector | None
    sun_counts: Vector | None = None


APriori = QuaternionPrior | BoresightPrior | SunPointedPrior


class Options(Struct, frozen=True):
    """What a batch or a what-if asks to be done otherwise than its mission says."""

    identifier: Identifier | None = None
    solver: SolverName | None = None
    tests: dict[str, bool] = {}
    tolerances: dict[str, float] = {}
    zone_grid_deg: float | None = None


class Readings(Struct, frozen=True, eq=False):
    """What a scanning tracker gave along h and along v, in the words of its mission.

    Of a star `counts` of two lines or `times` of crossings; of a whole raster its `lines`.
    """

    kind: Literal["counts", "times", "lines"]
    h: Vector
    v: Vector


class TrackerStars(Struct, frozen=True, eq=False):
    """The stars of one tracker, in the order observed.

    Angles as measured: `vector` rows are unit vectors in tracker axes, NaN
    where the star came as `angles_deg` (h, v), which are NaN otherwise.
    Magnitude is NaN where none was given; sigma is NaN where the mission's holds.
    """

    tracker: str
    vector: Vector
    angles_deg: Vector
    magnitude_mag: Vector
    time_offset_s: Vector
    sigma_arcsec: Vector
    readings: tuple[Readings | None, ...] = ()
    """Readings of a scanning tracker by star; or one raster, whose stars are not yet found.

    `service.observations.scans.reduce` makes angles of them.
    """

    @property
    def count(self) -> int:
        """The number of stars."""
        return len(self.magnitude_mag)


class MeasuredAttitude(Struct, frozen=True, eq=False):
    """An attitude that a tracker measured itself: inertial to its axes, or to the body.

    `tracker` names the tracker; None: the axes are those of the body.  `covariance_arcsec2`
    (3, 3) is of the small rotation about the same axes.
    """

    quaternion: Vector
    covariance_arcsec2: Matrix
    tracker: str | None = None


class ObservationBatch(Struct, frozen=True, eq=False):
    """One batch: who, when, the a priori attitude, and the stars of each tracker.

    With a `measurement` there are neither stars nor a priori knowledge.
    Without `a_priori` a batch of stars is lost in space.  `tracking` is there where it
    asks for the last attitude.
    Body rates are of the body relative to inertial, in body axes.  Velocity and
    position are geocentric, EME2000, None where they were not given.
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
    """What was taken otherwise than it was sent: a code, a colon, and a sentence each."""
