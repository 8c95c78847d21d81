"""The Sun and the observer's motion: directions as seen from a moving spacecraft.

Velocities are barycentric, in units of the speed of light; positions and
velocities of the spacecraft are geocentric; every axis is ICRS, with which
EME2000 is taken as one.
"""

import math
from functools import lru_cache

import erfa
import numpy as np
import numpy.typing as npt
from erfa import ufunc

from service.times import Utc
from service.vectors import Vector, read_only, unit_of

KM_PER_AU = erfa.DAU / 1000.0
LIGHT_AU_PER_DAY = erfa.DAYSEC / erfa.AULT
LIGHT_KM_PER_S = erfa.CMPS / 1000.0


_STEPS_PER_DAY = 32
"""Between so close places a cubic follows epv00 within 0.03 m and 1e-8 m/s."""


@lru_cache(maxsize=64)
def _earth(time: Utc) -> tuple[Vector, float]:
    """Earth from the Sun in au and its barycentric velocity in c (6,), and the Sun's distance."""
    tt1, tt2 = time.tt
    whole = (tt1 - erfa.DJ00) * _STEPS_PER_DAY
    number = math.floor(whole + tt2 * _STEPS_PER_DAY)
    x = (whole - number) + tt2 * _STEPS_PER_DAY
    # Lagrange's weights for steps -1, 0, 1 and 2.
    before, after, beyond = x + 1.0, x - 1.0, x - 2.0
    weights = (
        -x * after * beyond / 6.0,
        before * after * beyond / 2.0,
        -before * x * beyond / 2.0,
        before * x * after / 6.0,
    )
    earth = read_only(np.dot(weights, _about(number)))
    x, y, z, *_ = earth.tolist()
    return earth, math.hypot(x, y, z)


@lru_cache(maxsize=256)
def _about(number: int) -> Vector:
    """Earth (4, 6) at the steps from one before to two after a numbered one."""
    return np.stack([_at(number + step) for step in (-1, 0, 1, 2)])


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
    velocity = _earth(time)[0][3:]
    if velocity_km_per_s is None:
        # Of one kind with the sum below: kernels are compiled for either.
        return velocity.copy()
    total: Vector = velocity + np.divide(velocity_km_per_s, LIGHT_KM_PER_S)
    return total


def sun_distance_au(time: Utc) -> float:
    """Distance from Earth to the Sun in astronomical units: near enough for a spacecraft's."""
    return _earth(time)[1]


def apparent(directions: npt.ArrayLike, velocity_c: Vector, time: Utc) -> Vector:
    """Apparent unit vectors of geometric ones (..., 3), aberration applied by `erfa.ab`."""
    inverse_lorentz = float(np.sqrt(1.0 - velocity_c @ velocity_c))
    return np.asarray(ufunc.ab(directions, velocity_c, sun_distance_au(time), inverse_lorentz))


def sun_direction(time: Utc, position_km: npt.ArrayLike | None) -> Vector:
    """Unit vector (3,) from the spacecraft to the Sun, from Earth where no position is given."""
    sun_km = _earth(time)[0][:3] * -KM_PER_AU
    return unit_of(sun_km if position_km is None else sun_km - np.asarray(position_km))


def ecliptic_north(time: Utc) -> Vector:
    """Unit vector (3,) to the north pole of the mean ecliptic of date."""
    return np.asarray(erfa.ecm06(*time.tt)[2])
