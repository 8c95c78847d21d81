"""Pitch, yaw and roll from stars that should stand elsewhere (report, 7.6).

Displacements have the sign of 7.6: where a star is, minus where it should be.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.imaging.centroids.window import Array


@dataclass(frozen=True)
class Misalignment:
    """How a pattern stands off: displacements in the units of the image plane, roll in radians.

    The image is the nominal one turned by `roll_rad` about the boresight, then moved by
    (`du`, `dv`).
    """

    du: float
    dv: float
    roll_rad: float


def by_two_scans(a1: float, b1: float, a2: float, b2: float, half_distance: float) -> Misalignment:
    """From the displacements of two stars that should stand at (-u0, 0) and (u0, 0) (7.23 to 7.25).

    Only right for a pair symmetric about the boresight.  Two stars that look alike leave
    half a turn open: this is the answer within a quarter turn.
    """
    if half_distance <= 0.0:
        raise BadInput(Fault("half_distance", "must be above zero", str(half_distance)))
    roll = math.atan2(b2 - b1, 2.0 * half_distance - a1 + a2)
    if abs(roll) > math.pi / 2.0:
        roll -= math.copysign(math.pi, roll)
    return Misalignment((a1 + a2) / 2.0, (b1 + b2) / 2.0, roll)


def by_positions(nominal: npt.ArrayLike, observed: npt.ArrayLike) -> Misalignment:
    """From any two or more stars (n, 2), wherever they stand: roll first, then displacement.

    Least squares of a turn and a move, stars told apart, so that any roll is found.
    Raises `BadInput` for fewer than two stars, or for stars all in one place.
    """
    should, are = _pairs(nominal, observed)
    middle_should, middle_are = should.mean(axis=0), are.mean(axis=0)
    arms, found = should - middle_should, are - middle_are
    along = float(np.sum(arms * found))
    across = float(np.sum(arms[:, 0] * found[:, 1] - arms[:, 1] * found[:, 0]))
    if math.hypot(along, across) == 0.0:
        raise BadInput(Fault("nominal", "all stars are in one place: no roll can be told"))
    roll = math.atan2(across, along)
    c, s = math.cos(roll), math.sin(roll)
    moved = middle_are - np.array([[c, -s], [s, c]]) @ middle_should
    return Misalignment(float(moved[0]), float(moved[1]), roll)


def sigmas(position_sigma: float, half_distance: float) -> tuple[float, float]:
    """Of either displacement, sigma / sqrt 2, and of the roll, sqrt 2 sigma / (2 u0)."""
    return position_sigma / math.sqrt(2.0), math.sqrt(2.0) * position_sigma / (2.0 * half_distance)


def _pairs(nominal: npt.ArrayLike, observed: npt.ArrayLike) -> tuple[Array, Array]:
    should = np.asarray(nominal, dtype=np.float64)
    are = np.asarray(observed, dtype=np.float64)
    if should.shape != are.shape or should.ndim != 2 or should.shape[1] != 2:
        raise BadInput(
            Fault("observed", "must be as many (u, v) as nominal", f"{should.shape}, {are.shape}")
        )
    if len(should) < 2:
        raise BadInput(Fault("nominal", "two stars are needed", str(len(should))))
    return should, are
