"""The attitude of a turning body between two known ones, and how well it is known there.

Two attitudes leave open how many turns the body made between them, and which way round.  Where
rates are known at both, the body is carried from one attitude to the other at their mean, and a
cubic (Hermite's) adds what is missing at the end, so that attitudes and rates are met.  Where
none are known, the body is taken to have turned the shorter way, by a quarter turn at most.

A body that turns farther than a quarter turn may nutate between two attitudes without a trace in
them but this: its rates differ, or they do not lead from one attitude to the other.  Both widen
the error, and where it becomes too large, the attitude between is not known.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.vectors import Vector, rotate_about, rotation_vectors, turned_quaternion

QUARTER_TURN_RAD = math.pi / 2.0
"""A larger turn between two attitudes is not told from the one the other way round."""
LARGEST_ERROR_RAD = math.radians(1.0)
"""An attitude that may be off by more is not known: no zone of a mission is wide enough for it."""
NEAR, FAR = (0.2, 0.01, 0.0), (4.0, 1.0, 0.1)
"""Error of the cubic over steps of at most a quarter turn, and over longer ones: shares of the
angle by which the mean rate misses the second attitude, and of the change of rate, across the
rate and along it, times the step.  They hold for random bodies that nutate, drawn by the tests."""


@dataclass(frozen=True, eq=False)
class Steps:
    """n steps from one attitude to the next, between which the attitude is interpolated.

    `first` (n, 4) are the attitudes at their beginnings.  Of the motion, about the body axes in
    rad: `turn` (n, 3) at the mean rate, `missing` (n, 3) what that leaves to the second
    attitude, `begin` and `end` (n, 3) the slopes of the missing part at both ends, a step being
    the unit of time.  `error_rad` (n,) bounds the error between; infinite where it is not known.
    """

    first: Vector
    turn: Vector
    missing: Vector
    begin: Vector
    end: Vector
    error_rad: Vector

    @property
    def is_known(self) -> npt.NDArray[np.bool_]:
        """Marks (n,) of the steps between whose ends the attitude is known."""
        return np.asarray(self.error_rad <= LARGEST_ERROR_RAD)

    def at(self, share: Vector) -> Vector:
        """The attitudes (n, 4) a share (n,) of each step after its beginning."""
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
    """The steps between attitudes (n, 4) and others (n, 4) that are `step_s` (n,) later.

    Rates (n, 3) are of the body relative to inertial, in body axes, rad/s; NaN where none is
    known.  Where one of both is known, it is taken for the whole step.
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
    # At the end the axes have turned by the missing part too.
    end = other * h - rotate_about(-missing, turn)
    end += 0.5 * np.cross(end, missing)
    missing, begin, end = (np.where(known, each, 0.0) for each in (missing, begin, end))
    error = np.where(rated, _error_rad(turn, missing, (other - one) * h), 0.0)
    unrated = np.linalg.norm(shorter, axis=1)
    error[~rated & (unrated > QUARTER_TURN_RAD)] = np.inf
    return Steps(first, turn, missing, begin, end, error)


def _error_rad(turn: Vector, missing: Vector, change: Vector) -> Vector:
    """Bounds (n,) of the error between, from what the rates leave unexplained."""
    missed = np.linalg.norm(missing, axis=1)
    angle = np.linalg.norm(turn, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.nan_to_num(turn / angle[:, None])
    along = np.abs(np.sum(change * axis, axis=1))
    across = np.linalg.norm(np.cross(change, axis), axis=1)
    is_far = angle + 0.5 * np.linalg.norm(change, axis=1) > QUARTER_TURN_RAD
    shares = np.where(is_far[:, None], FAR, NEAR)
    return np.asarray(np.sum(shares * np.stack([missed, across, along], axis=1), axis=1))
