"""What was recorded of a window of time, as the filter may use it."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.filtering.samples import (
    LARGEST_SIGMA_RAD,
    AttitudeMeasurements,
    DirectionMeasurements,
)
from service.gyro.block import Nanoseconds
from service.vectors import ARCSEC_PER_RADIAN, Vector

Mask = npt.NDArray[np.bool_]
LEAST_RATIO = 1e-10
"""Of the smallest variance to the largest: a covariance of less is no better than singular."""


@dataclass(frozen=True, eq=False)
class Recorded:
    """Gyro samples and measurements of a window, each in order of time.

    `gyro_ns` (n,) and `rates_rad_s` (n, 3) are as recorded, about the gyro's axes.  Of m
    attitudes those are left out whose covariance says nothing, and counted in `unusable`.
    """

    gyro_ns: Nanoseconds
    rates_rad_s: Vector
    attitudes: AttitudeMeasurements
    directions: DirectionMeasurements
    unusable: int = 0


def usable_attitudes(
    tai_ns: Nanoseconds, quaternion: Vector, covariance_arcsec2: Vector
) -> tuple[AttitudeMeasurements, int]:
    """The attitudes with a sound covariance, and how many there are without one.

    `covariance_arcsec2` (m, 6) is the upper triangle: 11, 12, 13, 22, 23, 33.
    """
    full = covariance_arcsec2[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].reshape(-1, 3, 3)
    full = full / ARCSEC_PER_RADIAN**2
    sound: Mask = np.asarray(np.isfinite(full).all(axis=(1, 2)))
    sound &= np.asarray(np.isfinite(quaternion).all(axis=1))
    variances = np.linalg.eigvalsh(np.where(sound[:, None, None], full, np.eye(3)))
    sound &= variances[:, 0] > LEAST_RATIO * variances[:, 2]
    sound &= variances[:, 2] < LARGEST_SIGMA_RAD**2
    norm = np.linalg.norm(quaternion[sound], axis=1, keepdims=True)
    kept = AttitudeMeasurements(tai_ns[sound], quaternion[sound] / norm, full[sound])
    return kept, int(np.count_nonzero(~sound))


def attitudes_where(given: AttitudeMeasurements, places: Any) -> AttitudeMeasurements:
    """Some of the attitudes."""
    return AttitudeMeasurements(
        given.tai_ns[places], given.quaternion[places], given.covariance_rad2[places]
    )


def directions_where(given: DirectionMeasurements, places: Any) -> DirectionMeasurements:
    """Some of the directions."""
    return DirectionMeasurements(
        given.tai_ns[places], given.body[places], given.inertial[places], given.sigma_rad[places]
    )
