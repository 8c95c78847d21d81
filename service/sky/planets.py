"""Where a spacecraft sees the planets: to about half a minute of arc, from ERFA's `plan94`.

The series are Simon et al. (1994); the errors are those that ERFA's documentation gives
for 1800 to 2100 against JPL's DE200.
"""

import math
from dataclasses import dataclass

import numpy as np
from erfa import ufunc

from service.sky.ephemeris import KM_PER_AU, LIGHT_AU_PER_DAY
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Vector

EARTH_ORBIT_KM = 7_000.0
"""How far from Earth's centre a spacecraft that gives no position is taken to be."""
_ROUNDS_OF_LIGHT = 2
"""After two the light time of Neptune is right within 1 us."""


@dataclass(frozen=True)
class Planet:
    """A planet, its number in `plan94`, and the largest errors of its heliocentric place."""

    name: str
    number: int
    longitude_arcsec: float
    latitude_arcsec: float


PLANETS = (
    Planet("Mercury", 1, 7.0, 1.0),
    Planet("Venus", 2, 7.0, 1.0),
    Planet("Mars", 4, 26.0, 1.0),
    Planet("Jupiter", 5, 78.0, 6.0),
    Planet("Saturn", 6, 87.0, 14.0),
    Planet("Uranus", 7, 86.0, 7.0),
    Planet("Neptune", 8, 11.0, 2.0),
)


@dataclass(frozen=True, eq=False)
class PlanetPlace:
    """Where a planet is seen: a unit vector (3,), ICRS, and the largest error of it."""

    direction: Vector
    distance_au: float
    error_arcsec: float


def planet_place(planet: Planet, time: Utc, position_km: Vector | None) -> PlanetPlace:
    """A planet as seen from a spacecraft at a geocentric position, light time counted.

    The direction is the astrometric one, as that of catalog stars: without aberration.
    Where no position is given the spacecraft may be anywhere in an orbit of
    `EARTH_ORBIT_KM`, and the error says so.
    """
    tt1, tt2 = time.tt
    earth, _, _ = ufunc.epv00(tt1, tt2)
    observer = earth["p"] + (0.0 if position_km is None else position_km / KM_PER_AU)
    light_days = 0.0
    for _ in range(1 + _ROUNDS_OF_LIGHT):
        pv, _ = ufunc.plan94(tt1, tt2 - light_days, planet.number)
        path = pv["p"] - observer
        distance_au = float(np.sqrt(path @ path))
        light_days = distance_au / LIGHT_AU_PER_DAY
    heliocentric_au = float(np.sqrt(pv["p"] @ pv["p"]))
    off_arcsec = math.hypot(planet.longitude_arcsec, planet.latitude_arcsec)
    error_arcsec = off_arcsec * heliocentric_au / distance_au
    if position_km is None:
        error_arcsec += EARTH_ORBIT_KM / KM_PER_AU / distance_au * ARCSEC_PER_RADIAN
    return PlanetPlace(path / distance_au, distance_au, error_arcsec)
