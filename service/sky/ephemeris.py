"""The Sun, the planets and the observer's motion: directions as seen from a moving spacecraft.

Velocities are barycentric, in units of the speed of light; positions and
velocities of the spacecraft are geocentric; every axis is ICRS, with which
EME2000 is taken as one.

Planets are known to about half a minute of arc, from ERFA's `plan94`.  The series are Simon et
al. (1994); the errors are those that ERFA's documentation gives for 1800 to 2100 against JPL's
DE200.
"""

import math
from dataclasses import dataclass
from functools import lru_cache

import erfa
import numpy as np
import numpy.typing as npt
from erfa import ufunc

from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Vector, unit, unit_of

Triple = tuple[float, float, float]

KM_PER_AU = erfa.DAU / 1000.0
LIGHT_AU_PER_DAY = erfa.DAYSEC / erfa.AULT
LIGHT_KM_PER_S = erfa.CMPS / 1000.0
_ROUNDS_OF_ABERRATION = 3
"""Each leaves 1e-4 of what was off before."""
_STEPS_PER_DAY = 32
"""Between so close places a cubic follows epv00 within 0.03 m and 1e-8 m/s."""


EARTH_ORBIT_KM = 7_000.0
"""How far from Earth's centre a spacecraft that gives no position is taken to be."""
_ROUNDS_OF_LIGHT = 2
"""After two the light time of Neptune is right within 1 us."""


# By plain numbers: numpy takes longer for six than Python does.
@lru_cache(maxsize=64)
def _earth(time: Utc) -> tuple[Triple, Triple, float]:
    """Earth from the Sun in au, its barycentric velocity in c, and the Sun's distance in au."""
    tt1, tt2 = time.tt
    whole = (tt1 - erfa.DJ00) * _STEPS_PER_DAY
    number = math.floor(whole + tt2 * _STEPS_PER_DAY)
    at = (whole - number) + tt2 * _STEPS_PER_DAY
    # Lagrange's weights for steps -1, 0, 1 and 2.
    before, after, beyond = at + 1.0, at - 1.0, at - 2.0
    a = -at * after * beyond / 6.0
    b = before * after * beyond / 2.0
    c = -before * at * beyond / 2.0
    d = before * at * after / 6.0
    x, y, z, u, v, w = [a * p + b * q + c * r + d * s for p, q, r, s in _about(number)]
    return (x, y, z), (u, v, w), math.hypot(x, y, z)


@lru_cache(maxsize=256)
def _about(number: int) -> list[list[float]]:
    """Earth's six numbers, each at the steps from one before to two after a numbered one."""
    numbers: list[list[float]] = np.stack(
        [_at(number + step) for step in (-1, 0, 1, 2)], axis=1
    ).tolist()
    return numbers


@lru_cache(maxsize=1024)
def _at(number: int) -> Vector:
    """Earth at a step: heliocentric place in au and barycentric velocity in c, (6,)."""
    # epv00 asks for TDB, which differs from TT by under 2 ms.  Its status only
    # tells that the date lies outside 1900 to 2100.
    heliocentric, barycentric, _ = ufunc.epv00(erfa.DJ00, number / _STEPS_PER_DAY)
    return np.concatenate([heliocentric["p"], barycentric["v"] / LIGHT_AU_PER_DAY])


def observer_velocity(time: Utc, velocity_km_per_s: npt.ArrayLike | None) -> Vector:
    """Velocity (3,) of the spacecraft about the barycentre, in units of c.

    Earth's velocity with the spacecraft's geocentric one added; Earth's alone
    where the latter is None.
    """
    u, v, w = _earth(time)[1]
    if velocity_km_per_s is None:
        return np.array((u, v, w))
    x, y, z = np.asarray(velocity_km_per_s).tolist()
    return np.array((u + x / LIGHT_KM_PER_S, v + y / LIGHT_KM_PER_S, w + z / LIGHT_KM_PER_S))


def sun_distance_au(time: Utc) -> float:
    """Distance from Earth to the Sun in astronomical units: near enough for a spacecraft's."""
    return _earth(time)[2]


def apparent(directions: npt.ArrayLike, velocity_c: Vector, time: Utc) -> Vector:
    """Apparent unit vectors of geometric ones (..., 3), aberration applied by `erfa.ab`."""
    inverse_lorentz = float(np.sqrt(1.0 - velocity_c @ velocity_c))
    return np.asarray(ufunc.ab(directions, velocity_c, sun_distance_au(time), inverse_lorentz))


def natural(directions: npt.ArrayLike, velocity_c: Vector, time: Utc) -> Vector:
    """Geometric unit vectors of apparent ones (..., 3): `apparent` undone, within 1e-12 rad."""
    seen = np.asarray(directions, dtype=np.float64)
    found = seen
    for _ in range(_ROUNDS_OF_ABERRATION):
        found = unit(found + seen - apparent(found, velocity_c, time))
    return found


def sun_direction(time: Utc, position_km: npt.ArrayLike | None) -> Vector:
    """Unit vector (3,) from the spacecraft to the Sun, from Earth where no position is given."""
    sun_km = np.array(_earth(time)[0]) * -KM_PER_AU
    return unit_of(sun_km if position_km is None else sun_km - np.asarray(position_km))


def ecliptic_north(time: Utc) -> Vector:
    """Unit vector (3,) to the north pole of the mean ecliptic of date."""
    return np.asarray(erfa.ecm06(*time.tt)[2])


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
    """Direction of a planet, a unit vector (3,), ICRS, and its largest error."""

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
