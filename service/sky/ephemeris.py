"""Ephemerides of the Sun and planets, the observer's velocity, and aberration.

Velocities are barycentric, in units of the speed of light; positions and velocities of the
spacecraft are geocentric; all axes are ICRS, which is taken to be EME2000.

Planets are accurate to about half an arc minute, from ERFA's `plan94`. The series are Simon et al.
(1994); the errors are those that ERFA's documentation gives for 1800 to 2100 against JPL's DE200.
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
"""Number of iterations for removing aberration; each leaves 1e-4 of the error before."""
_STEPS_PER_DAY = 32
"""Nodes per day at which Earth's place is computed, for cubic interpolation between them."""


EARTH_ORBIT_KM = 7_000.0
"""Largest distance from Earth's centre assumed for a spacecraft without a position, in km."""
_ROUNDS_OF_LIGHT = 2
"""Number of iterations of light time; two are correct within 1 us for Neptune."""


# Plain numbers are faster: numpy's overhead is larger for six numbers.
@lru_cache(maxsize=64)
def _earth(time: Utc) -> tuple[Triple, Triple, float]:
    """Earth from the Sun in au, Earth's barycentric velocity in c, the Sun's distance in au."""
    tt1, tt2 = time.tt
    whole = (tt1 - erfa.DJ00) * _STEPS_PER_DAY
    number = math.floor(whole + tt2 * _STEPS_PER_DAY)
    at = (whole - number) + tt2 * _STEPS_PER_DAY
    # Lagrange weights for nodes -1, 0, 1 and 2.
    before, after, beyond = at + 1.0, at - 1.0, at - 2.0
    a = -at * after * beyond / 6.0
    b = before * after * beyond / 2.0
    c = -before * at * beyond / 2.0
    d = before * at * after / 6.0
    x, y, z, u, v, w = [a * p + b * q + c * r + d * s for p, q, r, s in _about(number)]
    return (x, y, z), (u, v, w), math.hypot(x, y, z)


@lru_cache(maxsize=256)
def _about(number: int) -> list[list[float]]:
    """Earth's six coordinates at the four nodes about a time, from one before node `number`."""
    numbers: list[list[float]] = np.stack(
        [_at(number + step) for step in (-1, 0, 1, 2)], axis=1
    ).tolist()
    return numbers


@lru_cache(maxsize=1024)
def _at(number: int) -> Vector:
    """Earth at a node: heliocentric position in au and barycentric velocity in c, as (6,)."""
    # epv00 expects TDB, which differs from TT by under 2 ms. Its status only flags dates outside of
    # 1900 to 2100.
    heliocentric, barycentric, _ = ufunc.epv00(erfa.DJ00, number / _STEPS_PER_DAY)
    return np.concatenate([heliocentric["p"], barycentric["v"] / LIGHT_AU_PER_DAY])


def observer_velocity(time: Utc, velocity_km_per_s: npt.ArrayLike | None) -> Vector:
    """The barycentric velocity (3,) of a spacecraft, or of Earth, in units of c.

    It is Earth's velocity plus the spacecraft's geocentric one, if that is not None.
    """
    u, v, w = _earth(time)[1]
    if velocity_km_per_s is None:
        return np.array((u, v, w))
    x, y, z = np.asarray(velocity_km_per_s).tolist()
    return np.array((u + x / LIGHT_KM_PER_S, v + y / LIGHT_KM_PER_S, w + z / LIGHT_KM_PER_S))


def sun_distance_au(time: Utc) -> float:
    """The distance from Earth to the Sun in au, accurate enough for a spacecraft."""
    return _earth(time)[2]


def apparent(directions: npt.ArrayLike, velocity_c: Vector, time: Utc) -> Vector:
    """Apparent unit vectors of geometric ones (..., 3), with aberration by `erfa.ab`."""
    inverse_lorentz = float(np.sqrt(1.0 - velocity_c @ velocity_c))
    return np.asarray(ufunc.ab(directions, velocity_c, sun_distance_au(time), inverse_lorentz))


def natural(directions: npt.ArrayLike, velocity_c: Vector, time: Utc) -> Vector:
    """Geometric unit vectors of apparent ones (..., 3): inverse of `apparent`, to 1e-12 rad."""
    seen = np.asarray(directions, dtype=np.float64)
    found = seen
    for _ in range(_ROUNDS_OF_ABERRATION):
        found = unit(found + seen - apparent(found, velocity_c, time))
    return found


def sun_direction(time: Utc, position_km: npt.ArrayLike | None) -> Vector:
    """The unit vector (3,) from the spacecraft to the Sun, or from Earth without a position."""
    sun_km = np.array(_earth(time)[0]) * -KM_PER_AU
    return unit_of(sun_km if position_km is None else sun_km - np.asarray(position_km))


def ecliptic_north(time: Utc) -> Vector:
    """The unit vector (3,) to the north pole of the mean ecliptic of date."""
    return np.asarray(erfa.ecm06(*time.tt)[2])


@dataclass(frozen=True)
class Planet:
    """A planet with its number in `plan94`, and the largest errors of its heliocentric position."""

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
    """Direction of a planet as a unit vector (3,), ICRS, with its distance and largest error."""

    direction: Vector
    distance_au: float
    error_arcsec: float


def planet_place(planet: Planet, time: Utc, position_km: Vector | None) -> PlanetPlace:
    """A planet's place as seen from a geocentric position, corrected for light time.

    The direction is the astrometric one, as that of catalog stars: without aberration. Without a
    position the spacecraft may be anywhere within `EARTH_ORBIT_KM`, which enlarges the error.
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
