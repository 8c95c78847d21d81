"""Where the sample spacecraft are and how they move: geocentric, ICRS axes.

Good enough for what a star tracker feels of an orbit: the aberration of its
velocity and, about L1, where the Sun is seen.  Not an ephemeris.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from service.missions.mission import Band, Mission
from service.sky.ephemeris import ecliptic_north, sun_direction
from service.times import Utc, parse_utc, shifted
from service.vectors import Vector, coordinate_rotation, unit

EARTH_GM_KM3_PER_S2 = 398600.4418
EARTH_RADIUS_KM = 6378.137
DAY_S = 86400.0

_EPOCH = parse_utc("2000-01-01T12:00:00Z")


class Orbit(Protocol):
    """Something that has a position and a velocity at any time."""

    def state(self, time: Utc) -> tuple[Vector, Vector]:
        """Position (3,) in km and velocity (3,) in km/s."""
        ...


@dataclass(frozen=True)
class LowOrbit:
    """A circular orbit about Earth whose node stands still."""

    altitude_km: float
    inclination_deg: float
    node_deg: float = 0.0

    def state(self, time: Utc) -> tuple[Vector, Vector]:
        """Position (3,) in km and velocity (3,) in km/s."""
        radius_km = EARTH_RADIUS_KM + self.altitude_km
        rate = math.sqrt(EARTH_GM_KM3_PER_S2 / radius_km**3)
        angle = math.fmod(rate * _seconds(time), math.tau)
        plane = coordinate_rotation(0, self.inclination_deg) @ coordinate_rotation(2, self.node_deg)
        along = np.array([math.cos(angle), math.sin(angle), 0.0])
        ahead = np.array([-math.sin(angle), math.cos(angle), 0.0])
        return radius_km * along @ plane, radius_km * rate * ahead @ plane


@dataclass(frozen=True)
class HaloOrbit:
    """A halo about L1, between Earth and the Sun; the sizes are SOHO's."""

    distance_km: float = 1.48e6
    toward_sun_km: float = 206_448.0
    along_ecliptic_km: float = 666_672.0
    out_of_ecliptic_km: float = 120_000.0
    period_days: float = 177.7

    def state(self, time: Utc) -> tuple[Vector, Vector]:
        """Position (3,) in km and velocity (3,) in km/s."""
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
    """The mission's own orbit; for a site's mission, about L1 with a band and low with a cap."""
    other = HaloOrbit() if isinstance(mission.zone, Band) else LowOrbit(600.0, 51.6)
    return ORBITS.get(mission.name, other)


def _seconds(time: Utc) -> float:
    return (time.tai_ns - _EPOCH.tai_ns) * 1e-9
