"""Interpolation of the attitude of a rotating body between two known ones, with its error.

Two attitudes leave open how many turns the body made between them, and in which direction.  If
rates are known at both, the body is carried from one attitude to the other at their mean, and a
cubic (Hermite's) adds the difference at the end, so that attitudes and rates are met.  If none are
known, the body is assumed to have turned the shorter way, by a quarter turn at most.

A body that turns farther than a quarter turn may nutate between two attitudes and leave no other
trace than this: its rates differ, or do not lead from one attitude to the other.  Both widen the
error, and where it becomes too large, the attitude in between is unknown.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.vectors import Vector, rotate_about, rotation_vectors, turned_quaternion

QUARTER_TURN_RAD = math.pi / 2.0
"""Largest rotation between two attitudes that can be told from one in the opposite direction."""
LARGEST_ERROR_RAD = math.radians(1.0)
"""Largest error of a known attitude; no zone of a mission is wide enough for a greater one."""
NEAR, FAR = (0.2, 0.01, 0.0), (4.0, 1.0, 0.1)
"""Error coefficients of the cubic over steps of at most a quarter turn, and over longer ones.

They are factors on the angle by which the mean rate misses the second attitude, and on the change
of rate, across the rate and along it, times the step.  They hold for random bodies that nutate,
drawn by the tests.
"""


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps (n) between known attitudes, within which the attitude is interpolated.

    `first` (n, 4) are the attitudes at their beginnings.  The motion, about the body axes in rad:
    `turn` (n, 3) at the mean rate, `missing` (n, 3) the remainder to the second attitude, `begin`
    and `end` (n, 3) the slopes of the missing part at both ends, a step being the unit of time.
    `error_rad` (n,) bounds the error between; infinite where it is not known.
    """

    first: Vector
    turn: Vector
    missing: Vector
    begin: Vector
    end: Vector
    error_rad: Vector

    @property
    def is_known(self) -> npt.NDArray[np.bool_]:
        """True (n,) for the steps within which the attitude is known."""
        return np.asarray(self.error_rad <= LARGEST_ERROR_RAD)

    def at(self, share: Vector) -> Vector:
        """Attitudes (n, 4) at a fraction (n,) of each step after its beginning."""
        s = share[:, None]
        carried = turned_quaternion(self.first, self.turn * s)
        cubic = s * s * (3.0 - 2.0 * s) * self.missing
        cubic += s * (1.0 - s) ** 2 * self.begin - s * s * (1.0 - s) * self.end
        return turned_quaternion(carried, cubic)


def steps_between(
    first: Vector,
    second: Vector,
    step_s: Vector,
    first_rate: Vector | None = None,
    second_rate: Vector | None = None,
) -> Steps:
    """Prepare interpolation between attitudes (n, 4) and others (n, 4), `step_s` (n,) later.

    Rates (n, 3) are of the body relative to inertial, in body axes, rad/s; NaN where unknown.
    Where only one of both is known, it is used for the whole step.
    """
    shorter = rotation_vectors(first, second)
    none = np.full_like(shorter, np.nan)
    one = none if first_rate is None else first_rate
    other = none if second_rate is None else second_rate
    one, other = (np.where(np.isnan(a), b, a) for a, b in ((one, other), (other, one)))
    rated: npt.NDArray[np.bool_] = np.asarray(~np.isnan(one).any(axis=1))
    h, known = step_s[:, None], rated[:, None]
    turn = np.where(known, 0.5 * (one + other) * h, shorter)
    missing = rotation_vectors(turned_quaternion(first, turn), second)
    begin = one * h - turn
    # At the end the axes have turned by the missing part as well.
    end = other * h - rotate_about(-missing, turn)
    end += 0.5 * np.cross(end, missing)
    missing, begin, end = (np.where(known, each, 0.0) for each in (missing, begin, end))
    error = np.where(rated, _error_rad(turn, missing, (other - one) * h), 0.0)
    unrated = np.linalg.norm(shorter, axis=1)
    error[~rated & (unrated > QUARTER_TURN_RAD)] = np.inf
    return Steps(first, turn, missing, begin, end, error)


def _error_rad(turn: Vector, missing: Vector, change: Vector) -> Vector:
    """Bounds (n,) on the interpolation error in rad, from motion not explained by the rates."""
    missed = np.linalg.norm(missing, axis=1)
    angle = np.linalg.norm(turn, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.nan_to_num(turn / angle[:, None])
    along = np.abs(np.sum(change * axis, axis=1))
    across = np.linalg.norm(np.cross(change, axis), axis=1)
    is_far = angle + 0.5 * np.linalg.norm(change, axis=1) > QUARTER_TURN_RAD
    shares = np.where(is_far[:, None], FAR, NEAR)
    return np.asarray(np.sum(shares * np.stack([missed, across, along], axis=1), axis=1))
