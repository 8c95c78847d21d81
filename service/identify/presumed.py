"""What the a priori knowledge says: a presumed attitude, and where each tracker's zone lies.

The presumed attitude carries observed vectors to inertial axes for the tests
of geometry.  Where the roll is unknown it is made up, and the tests that would
depend on it are switched off or, in a band, only vote.
"""

from dataclasses import dataclass, field

import numpy as np

from service.errors import BadBatch, Fault, shown_value
from service.missions.mission import Band, Cap, Mission, Tracker
from service.observe.batch import APriori, BoresightPrior, QuaternionPrior, SunPointedPrior
from service.sky.ephemeris import ecliptic_north, sun_direction
from service.sky.zones import Aim
from service.times import Utc
from service.vectors import (
    Matrix,
    Vector,
    from_ra_dec,
    matrix_from_quaternion,
    separation_deg,
    to_ra_dec,
    unit,
)

POLE_FROM_SUN_WARNING_DEG = 1.0
SUN_FROM_EARTH_GROWTH_DEG = 0.3
"""From Earth's centre the Sun is up to 0.26 deg from where a halo orbit about L1 sees it."""
SAME_BORESIGHT_DEG = 0.01
ALONG = 0.999999
"""The cosine beyond which one direction does not fix a plane with another."""


@dataclass(frozen=True)
class Presumed:
    """The presumed attitude (3, 3), inertial to body, and what is not known of it.

    `known_axis` (inertial) is what alone is known where the roll is not: the
    boresight, or in a band the pole, about which any rotation may come.
    """

    attitude: Matrix
    roll_known: bool
    known_axis: Vector | None
    growth_deg: float = 0.0
    warnings: list[str] = field(default_factory=list)


def presumed_attitude(
    prior: APriori, time: Utc, mission: Mission, position_km: Vector | None = None
) -> Presumed:
    """The presumed attitude of a batch of that time, seen from a geocentric position where known.

    Raises `BadBatch` where the kind of prior does not fit the mission's zone.
    """
    if isinstance(prior, QuaternionPrior):
        attitude = matrix_from_quaternion(prior.quaternion)
        pole = attitude.T @ mission.axis_body if isinstance(mission.zone, Band) else None
        return Presumed(attitude, True, pole, warnings=_pole_warnings(pole, time, position_km))
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
        return Presumed(_any_roll(mission.axis_body, boresight), False, boresight)
    if not isinstance(mission.zone, Band):
        raise BadBatch(
            Fault(
                "a_priori.sun_pointed",
                f"{mission.name} has a cap; give quaternion or boresight",
                "True",
            )
        )
    return _sun_pointed(prior, time, mission)


def _sun_pointed(prior: SunPointedPrior, time: Utc, mission: Mission) -> Presumed:
    warnings: list[str] = []
    growth_deg = 0.0
    pole = prior.sun_vector
    if pole is not None:
        warnings += _pole_warnings(pole, time, prior.position_km)
    else:
        pole = sun_direction(time, prior.position_km)
        if not np.isfinite(pole).all():
            raise BadBatch(
                Fault("position_km", "is that of the Sun itself", shown_value(prior.position_km))
            )
        if prior.position_km is None:
            growth_deg = SUN_FROM_EARTH_GROWTH_DEG
            warnings.append(
                "sun_seen_from_earth: neither sun_vector nor position_km was given; "
                f"the band is {growth_deg} deg wider on either side"
            )
    # Body Z is presumed along the projection of ecliptic north.
    body = _frame(mission.axis_body, np.array([0.0, 0.0, 1.0]))
    inertial = _frame(pole, ecliptic_north(time))
    return Presumed(body.T @ inertial, False, pole, growth_deg, warnings)


def _frame(first: Vector, second: Vector) -> Matrix:
    """Rows: the first direction, the normal to both, and the third of the right-handed set.

    A second direction along the first gives way to a coordinate axis.
    """
    if abs(float(first @ second)) > ALONG:
        second = np.eye(3)[int(np.argmin(np.abs(first)))]
    normal = unit(np.cross(first, second))
    return np.stack([first, normal, np.cross(first, normal)])


def _any_roll(body_axis: Vector, inertial_axis: Vector) -> Matrix:
    """Some attitude that carries an inertial direction to a body axis."""
    return _frame(body_axis, body_axis).T @ _frame(inertial_axis, inertial_axis)


def _pole_warnings(pole: Vector | None, time: Utc, position_km: Vector | None) -> list[str]:
    if pole is None:
        return []
    off_deg = separation_deg(pole, sun_direction(time, position_km))
    if off_deg <= POLE_FROM_SUN_WARNING_DEG:
        return []
    return [f"pole_off_sun: the a priori pole is {off_deg:.2f} deg from the Sun"]


def aim_of(tracker: Tracker, presumed: Presumed, mission: Mission, field_name: str) -> Aim:
    """Where the stars of a tracker are to be looked for.

    In a cap, about the tracker's own presumed boresight; in a band, at the
    boresight's coelevation from the pole.  Raises `BadBatch` for a tracker
    whose boresight an a priori direction with unknown roll does not tell.
    """
    zone = mission.zone
    boresight_body = tracker.body_from_tracker[:, 2]
    if isinstance(zone, Band):
        coelevation_deg = tracker.coelevation_deg or zone.coelevation_deg
        axis = presumed.attitude.T @ mission.axis_body
        half_width_deg = zone.half_width_deg + presumed.growth_deg
        return Aim(
            "band",
            axis,
            max(0.0, coelevation_deg - half_width_deg),
            min(180.0, coelevation_deg + half_width_deg),
        )
    if not presumed.roll_known and (
        (off_deg := separation_deg(boresight_body, mission.axis_body)) > SAME_BORESIGHT_DEG
    ):
        ra_deg, dec_deg = to_ra_dec(presumed.attitude.T @ mission.axis_body)
        raise BadBatch(
            Fault(
                field_name,
                f"{tracker.name} looks {off_deg:.2f} deg away from the spacecraft's boresight: "
                "an a priori boresight does not tell where; give a quaternion",
                f"boresight {float(ra_deg):.3f}, {float(dec_deg):.3f} deg",
            )
        )
    return Aim("cap", presumed.attitude.T @ boresight_body, 0.0, zone.radius_deg)
