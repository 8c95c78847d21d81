"""Simulated motion of spacecraft: fixed pointings, slews between them, and orbits.

Body rates are constant between batches and determine the attitudes, so that rates, attitudes and
star times agree.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from service.missions.mission import Band, Mission
from service.sky.ephemeris import ecliptic_north, sun_direction
from service.times import Utc, parse_utc, shifted
from service.vectors import Matrix, Vector, coordinate_rotation, rotate_about, unit

SLEW_DEG_PER_S = 0.1
CAP_JITTER_DEG_PER_S = 5e-4
BAND_JITTER_DEG_PER_S = 2e-5
CAP_HELD, BAND_HELD = (4, 13), (2, 5)
"""Range of the number of batches between slews (from, below), for cap and band missions."""


def body_rates_deg_per_s(mission: Mission, batches: int, rng: np.random.Generator) -> Vector:
    """Simulated body rates (batches, 3), relative to inertial, in body axes.

    A mission with a cap slews about any axis; one with a band rolls about the axis that it keeps on
    its pole, in steps that lead all along the band, as in a roll calibration.
    """
    rolls = isinstance(mission.zone, Band)
    jitter = BAND_JITTER_DEG_PER_S if rolls else CAP_JITTER_DEG_PER_S
    held = BAND_HELD if rolls else CAP_HELD
    rates = rng.normal(0.0, jitter, (batches, 3))
    at = int(rng.integers(*held))
    while at < batches:
        turning = int(rng.integers(2, 9))
        share = rng.uniform(0.3, 1.0) * rng.choice((-1.0, 1.0))
        axis = mission.axis_body if rolls else random_axis(rng)
        rates[at : at + turning] = share * axis * SLEW_DEG_PER_S
        at += turning + int(rng.integers(*held))
    # Round the rates of the motion, since the written rates are rounded.
    return np.round(rates, 7)


def slewing_attitudes(rates_deg_per_s: Vector, cadence_s: float, first: Matrix) -> Iterator[Matrix]:
    """Attitude matrices, inertial to body, one per batch, integrated from body rates."""
    attitude = first
    for rates in rates_deg_per_s:
        yield attitude
        attitude = turned_by(attitude, np.radians(rates) * cadence_s)
        # Restore orthogonality, which a product of many rotations loses.
        u, _, vt = np.linalg.svd(attitude)
        attitude = u @ vt


def turned_by(attitude: Matrix, rotation_vector_rad: Vector) -> Matrix:
    """Attitude after a rotation of the body by a rotation vector in body axes."""
    return rotate_about(-rotation_vector_rad, attitude.T).T


def pointed(axis_body: Vector, direction: Vector, roll_rad: float) -> Matrix:
    """Attitude with a body axis along an inertial direction, and a given roll about it."""
    body, inertial = (np.stack([each, *across(each)]) for each in (axis_body, direction))
    return turned_by(body.T @ inertial, axis_body * roll_rad)


def across(direction: Vector) -> tuple[Vector, Vector]:
    """Two directions perpendicular to each unit vector (..., 3) and to each other."""
    # The coordinate axis farthest from the direction is never parallel to it.
    aside = unit(np.cross(direction, np.eye(3)[np.argmin(np.abs(direction), axis=-1)]))
    return aside, np.cross(direction, aside)


def random_axis(rng: np.random.Generator) -> Vector:
    """Random unit vector (3,), uniform over the sphere."""
    return unit(rng.normal(size=3))


def tilted(direction: Vector, angle_rad: float, rng: np.random.Generator) -> Vector:
    """Direction tilted by an angle towards a random side."""
    aside, above = across(direction)
    bearing = rng.uniform(0.0, math.tau)
    about = math.cos(bearing) * aside + math.sin(bearing) * above
    return rotate_about(about * angle_rad, direction)


# Where the sample spacecraft are and how they move: geocentric, ICRS axes.
#
# Good enough for what a star tracker feels of an orbit: the aberration of its
# velocity and, about L1, where the Sun is seen.  Not an ephemeris.

EARTH_GM_KM3_PER_S2 = 398600.4418
EARTH_RADIUS_KM = 6378.137
DAY_S = 86400.0

_EPOCH = parse_utc("2000-01-01T12:00:00Z")


class Orbit(Protocol):
    """Interface of an orbit: position and velocity at any time."""

    def state(self, time: Utc) -> tuple[Vector, Vector]:
        """Geocentric position (3,) in km and velocity (3,) in km/s at a time, in ICRS axes."""
        ...


@dataclass(frozen=True)
class LowOrbit:
    """Circular orbit about Earth with a fixed node."""

    altitude_km: float
    inclination_deg: float
    node_deg: float = 0.0

    def state(self, time: Utc) -> tuple[Vector, Vector]:
        """Geocentric position (3,) in km and velocity (3,) in km/s at a time, in ICRS axes."""
        radius_km = EARTH_RADIUS_KM + self.altitude_km
        rate = math.sqrt(EARTH_GM_KM3_PER_S2 / radius_km**3)
        angle = math.fmod(rate * _seconds(time), math.tau)
        plane = coordinate_rotation(0, self.inclination_deg) @ coordinate_rotation(2, self.node_deg)
        along = np.array([math.cos(angle), math.sin(angle), 0.0])
        ahead = np.array([-math.sin(angle), math.cos(angle), 0.0])
        return radius_km * along @ plane, radius_km * rate * ahead @ plane


@dataclass(frozen=True)
class HaloOrbit:
    """Halo orbit about L1, between Earth and Sun, with SOHO's dimensions."""

    distance_km: float = 1.48e6
    toward_sun_km: float = 206_448.0
    along_ecliptic_km: float = 666_672.0
    out_of_ecliptic_km: float = 120_000.0
    period_days: float = 177.7

    def state(self, time: Utc) -> tuple[Vector, Vector]:
        """Geocentric position (3,) in km and velocity (3,) in km/s at a time, in ICRS axes."""
        # The halo turns with Earth's way about the Sun: differences see both motions.
        before, after = (self._position(shifted(time, step)) for step in (-600.0, 600.0))
        return self._position(time), (after - before) / 1200.0

    def _position(self, time: Utc) -> Vector:
        angle = math.tau * math.fmod(_seconds(time) / DAY_S / self.period_days, 1.0)
        sunward, north = sun_direction(time, None), ecliptic_north(time)
        # Along Earth's motion; sunward of L1 the halo moves with it.
        along = unit(np.cross(sunward, north))
        return np.asarray(
            (self.distance_km + self.toward_sun_km * math.cos(angle)) * sunward
            + self.along_ecliptic_km * math.sin(angle) * along
            + self.out_of_ecliptic_km * math.cos(angle) * np.cross(along, sunward)
        )


ORBITS: Mapping[str, Orbit] = {
    "XTE": LowOrbit(580.0, 23.0, 40.0),
    "SWAS": LowOrbit(638.0, 69.9, 200.0),
    "SOHO": HaloOrbit(),
}


def orbit_of(mission: Mission) -> Orbit:
    """Orbit of a known mission; otherwise about L1 for a band, and a low orbit for a cap."""
    other = HaloOrbit() if isinstance(mission.zone, Band) else LowOrbit(600.0, 51.6)
    return ORBITS.get(mission.name, other)


def _seconds(time: Utc) -> float:
    return (time.tai_ns - _EPOCH.tai_ns) * 1e-9
