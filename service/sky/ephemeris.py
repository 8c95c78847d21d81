"""The Sun and the observer's motion: directions as seen from a moving spacecraft.

Velocities are barycentric, in units of the speed of light; positions and
velocities of the spacecraft are geocentric; every axis is ICRS, with which
EME2000 is taken as one.
"""

from functools import lru_cache

import erfa
import numpy as np
import numpy.typing as npt
from erfa import ufunc

from service.times import Utc
from service.vectors import Vector, unit

KM_PER_AU = erfa.DAU / 1000.0
LIGHT_AU_PER_DAY = erfa.DAYSEC / erfa.AULT
LIGHT_KM_PER_S = erfa.CMPS / 1000.0


@lru_cache(maxsize=64)
def _earth(time: Utc) -> tuple[npt.NDArray[np.void], npt.NDArray[np.void]]:
    # epv00 asks for TDB, which differs from TT by under 2 ms.  Its status only
    # tells that the date lies outside 1900 to 2100.
    heliocentric, barycentric, _ = ufunc.epv00(*time.tt)
    return heliocentric, barycentric


def observer_velocity(time: Utc, velocity_km_per_s: npt.ArrayLike | None) -> Vector:
    """Velocity (3,) of the spacecraft about the barycentre, in units of c.

    Earth's velocity with the spacecraft's geocentric one added; Earth's alone
    where the latter is None.
    """
    _, barycentric = _earth(time)
    velocity = np.asarray(barycentric["v"]) / LIGHT_AU_PER_DAY
    if velocity_km_per_s is not None:
        velocity = velocity + np.asarray(velocity_km_per_s) / LIGHT_KM_PER_S
    return np.asarray(velocity)


def sun_distance_au(time: Utc) -> float:
    """Distance from Earth to the Sun in astronomical units: near enough for a spacecraft's."""
    heliocentric, _ = _earth(time)
    return float(np.linalg.norm(heliocentric["p"]))


def apparent(directions: npt.ArrayLike, velocity_c: Vector, time: Utc) -> Vector:
    """Apparent unit vectors of geometric ones (..., 3), aberration applied by `erfa.ab`."""
    inverse_lorentz = float(np.sqrt(1.0 - velocity_c @ velocity_c))
    return np.asarray(ufunc.ab(directions, velocity_c, sun_distance_au(time), inverse_lorentz))


def sun_direction(time: Utc, position_km: npt.ArrayLike | None) -> Vector:
    """Unit vector (3,) from the spacecraft to the Sun, from Earth where no position is given."""
    heliocentric, _ = _earth(time)
    sun_km = -np.asarray(heliocentric["p"]) * KM_PER_AU
    return unit(sun_km if position_km is None else sun_km - np.asarray(position_km))


def ecliptic_north(time: Utc) -> Vector:
    """Unit vector (3,) to the north pole of the mean ecliptic of date."""
    return np.asarray(erfa.ecm06(*time.tt)[2])
