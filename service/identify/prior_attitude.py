"""The conversion of a priori knowledge to a presumed attitude and to search regions of trackers.

The presumed attitude carries observed vectors to inertial axes for the tests of geometry. An
unknown roll is chosen arbitrarily, and tests that depend on the roll are switched off or, in a
band, only vote.
"""

import math

import numpy as np
from msgspec import Struct

from service.attitude.quaternions import to_matrix
from service.errors import BadBatch, Fault, shown_value
from service.missions.mission import Band, Cap, Mission, Tracker
from service.observations.batch import (
    APriori,
    BoresightPrior,
    PredictedPrior,
    QuaternionPrior,
    SunPointedPrior,
)
from service.observations.scans.reduce import sun_body
from service.sky.ephemeris import ecliptic_north, sun_direction
from service.sky.zones import SearchRegion
from service.times import Utc
from service.vectors import (
    Matrix,
    Vector,
    from_ra_dec,
    locked,
    separation_deg,
    to_ra_dec,
    unit,
)

POLE_FROM_SUN_WARNING_DEG = 1.0
SUN_FROM_EARTH_GROWTH_DEG = 0.3
"""Growth of a zone in degrees for a Sun direction seen from Earth's centre instead of L1."""
SAME_BORESIGHT_DEG = 0.01
PARALLEL_COS = 0.999999
"""Cosine from which two directions are too parallel to define a plane."""


class PriorAttitude(Struct, frozen=True, eq=False, gc=False):
    """The presumed attitude (3, 3), inertial to body, with its uncertainty.

    `axis` (inertial) is the direction of the zone's body axis at that attitude. `known_axis`
    (inertial) is the only known direction if the roll is unknown: the boresight, or in a band the
    pole, about which any rotation is possible.
    """

    attitude: Matrix
    axis: Vector
    roll_known: bool
    known_axis: Vector | None
    growth_deg: float = 0.0
    warnings: tuple[str, ...] = ()
    predicted: PredictedPrior | None = None
    """Prediction behind the attitude, or None; its search zones are caps about each boresight."""
    pole_body: Vector | None = None
    """The measured direction of the pole in body axes; None for the zone's body axis."""

    def axis_body(self, mission: Mission) -> Vector:
        """The body axis (3,) that is presumed to lie along `axis`."""
        return mission.axis_body if self.pole_body is None else self.pole_body


def prior_attitude(
    prior: APriori, time: Utc, mission: Mission, position_km: Vector | None = None
) -> PriorAttitude:
    """The presumed attitude for a batch's prior, time and optional geocentric position.

    Raises `BadBatch` if the kind of prior does not fit the mission's zone.
    """
    if isinstance(prior, QuaternionPrior):
        attitude = np.empty((3, 3))
        # An array from another process is writable, for which a kernel would compile anew.
        to_matrix(locked(prior.quaternion), attitude)
        axis = np.dot(mission.axis_body, attitude)
        if isinstance(prior, PredictedPrior):
            return PriorAttitude(attitude, axis, True, None, predicted=prior)
        if not isinstance(mission.zone, Band):
            return PriorAttitude(attitude, axis, True, None)
        warnings = _pole_warnings(axis, time, position_km)
        return PriorAttitude(attitude, axis, True, axis, warnings=warnings)
    if isinstance(prior, BoresightPrior):
        if not isinstance(mission.zone, Cap):
            raise BadBatch(
                Fault(
                    "a_priori.boresight",
                    f"{mission.name} has a band; give quaternion or sun_pointed",
                    shown_value({"ra_deg": prior.ra_deg, "dec_deg": prior.dec_deg}),
                )
            )
        boresight = from_ra_dec(prior.ra_deg, prior.dec_deg)
        attitude = _any_roll(mission.axis_body, boresight)
        return PriorAttitude(attitude, np.dot(mission.axis_body, attitude), False, boresight)
    if not isinstance(mission.zone, Band):
        raise BadBatch(
            Fault(
                "a_priori.sun_pointed",
                f"{mission.name} has a cap; give quaternion or boresight",
                "True",
            )
        )
    return _sun_pointed(prior, time, mission)


def _sun_pointed(prior: SunPointedPrior, time: Utc, mission: Mission) -> PriorAttitude:
    warnings: tuple[str, ...] = ()
    growth_deg = 0.0
    pole = prior.sun_vector
    if pole is not None:
        warnings = _pole_warnings(pole, time, prior.position_km)
    else:
        pole = sun_direction(time, prior.position_km)
        if not np.isfinite(pole).all():
            raise BadBatch(
                Fault("position_km", "is that of the Sun itself", shown_value(prior.position_km))
            )
        if prior.position_km is None:
            growth_deg = SUN_FROM_EARTH_GROWTH_DEG
            warned = (
                "sun_seen_from_earth: neither sun_vector nor position_km was given; "
                f"the band is {growth_deg} deg wider on either side"
            )
            warnings = (warned,)
    # Body Z is presumed along the projection of ecliptic north.
    measured: Vector | None = None
    if prior.sun_counts is not None:
        measured = sun_body(prior.sun_counts, mission, "a_priori.sun_counts")
    sun_axis = mission.axis_body if measured is None else measured
    body = _frame(sun_axis, np.array([0.0, 0.0, 1.0]))
    inertial = _frame(pole, ecliptic_north(time))
    attitude = body.T @ inertial
    axis = np.dot(sun_axis, attitude)
    return PriorAttitude(attitude, axis, False, pole, growth_deg, warnings, pole_body=measured)


def _frame(first: Vector, second: Vector) -> Matrix:
    """A right-handed frame as rows: a direction, its normal with a second one, and the third axis.

    A second direction parallel to the first is replaced by a coordinate axis.
    """
    if abs(float(first @ second)) > PARALLEL_COS:
        second = np.eye(3)[int(np.argmin(np.abs(first)))]
    normal = unit(np.cross(first, second))
    return np.stack([first, normal, np.cross(first, normal)])


def _any_roll(body_axis: Vector, inertial_axis: Vector) -> Matrix:
    """An arbitrary attitude that maps an inertial direction to a body axis."""
    return _frame(body_axis, body_axis).T @ _frame(inertial_axis, inertial_axis)


def _pole_warnings(pole: Vector, time: Utc, position_km: Vector | None) -> tuple[str, ...]:
    off_deg = separation_deg(pole, sun_direction(time, position_km))
    if off_deg <= POLE_FROM_SUN_WARNING_DEG:
        return ()
    return (f"pole_off_sun: the a priori pole is {off_deg:.2f} deg from the Sun",)


def search_region(
    tracker: Tracker, presumed: PriorAttitude, mission: Mission, field_name: str
) -> SearchRegion:
    """The region of the sky in which one tracker's stars are searched.

    For a cap mission the region is centred on the tracker's presumed boresight; for a band mission
    it is at the boresight's coelevation from the pole, corrected for a measured pole. For a
    predicted attitude it is the field of view with a margin. Raises `BadBatch` for a tracker whose
    boresight cannot be derived from a direction with unknown roll.
    """
    zone = mission.zone
    if presumed.predicted is not None:
        axis = np.dot(tracker.boresight_body, presumed.attitude)
        most_deg = tracker.field_of_view_radius_deg + presumed.predicted.margin_deg
        return SearchRegion("cap", axis, 0.0, min(180.0, most_deg))
    if isinstance(zone, Band):
        coelevation_deg = tracker.coelevation_deg or zone.coelevation_deg
        half_width_deg = zone.half_width_deg + presumed.growth_deg
        nearer_deg, farther_deg = _pole_shift_deg(tracker, presumed, mission)
        return SearchRegion(
            "band",
            presumed.axis,
            max(0.0, coelevation_deg + nearer_deg - half_width_deg),
            min(180.0, coelevation_deg + farther_deg + half_width_deg),
        )
    if not presumed.roll_known and (
        (off_deg := separation_deg(tracker.boresight_body, mission.axis_body)) > SAME_BORESIGHT_DEG
    ):
        ra_deg, dec_deg = to_ra_dec(presumed.axis)
        raise BadBatch(
            Fault(
                field_name,
                f"{tracker.name} looks {off_deg:.2f} deg away from the spacecraft's boresight: "
                "an a priori boresight does not tell where; give a quaternion",
                f"boresight {float(ra_deg):.3f}, {float(dec_deg):.3f} deg",
            )
        )
    axis = np.dot(tracker.boresight_body, presumed.attitude)
    return SearchRegion("cap", axis, 0.0, zone.radius_deg)


def _pole_shift_deg(
    tracker: Tracker, presumed: PriorAttitude, mission: Mission
) -> tuple[float, float]:
    """Bounds in degrees on the shift of a boresight's coelevation by a measured pole.

    They are rounded to the zone's grid, so that zones are reused while the pole moves a little.
    """
    if presumed.pole_body is None:
        return 0.0, 0.0
    shift_deg = separation_deg(tracker.boresight_body, presumed.pole_body) - separation_deg(
        tracker.boresight_body, mission.axis_body
    )
    step_deg = mission.zone.grid_deg
    if step_deg == 0.0:
        return shift_deg, shift_deg
    return math.floor(shift_deg / step_deg) * step_deg, math.ceil(shift_deg / step_deg) * step_deg
