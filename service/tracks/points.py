"""The unexplained points of a stretch, as the linking takes them."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.times import Utc
from service.vectors import Vector

Indices = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Batches:
    """The batches (b) with an attitude, in order of time.

    `position_km` (b, 3) is geocentric, NaN where the batch gives none.  `id` are results.
    """

    time: tuple[Utc, ...]
    position_km: Vector
    id: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Points:
    """Observed points (n) that no catalog star explains, in order of their batches.

    `batch` (n,) is the place of the point's batch, `tracker` (n,) that of its tracker in
    `trackers`, `number` (n,) its own among the tracker's stars, from 0.  `time_s` (n,) is its own
    time after the first batch.  `direction` (n, 3) is inertial, aberration removed where
    the batch asks for that; `covariance` (n, 3, 3), rad^2, has the noise of the point and of
    the attitude.  `place` (n, 3) is the direction in tracker axes as measured, with
    `sigma_rad` (n,) per tangent axis.  `magnitude_mag` (n,) is NaN where none was given.
    """

    trackers: tuple[str, ...]
    field_sr: Vector
    """The solid angle of each tracker's field of view, (t,)."""
    batch: Indices
    tracker: Indices
    number: Indices
    time_s: Vector
    direction: Vector
    covariance: Vector
    place: Vector
    sigma_rad: Vector
    magnitude_mag: Vector

    def __len__(self) -> int:
        return len(self.batch)

    def taken(self, chosen: Indices) -> "Points":
        """Some of the points, in ascending order of their places."""
        return Points(
            self.trackers,
            self.field_sr,
            *(
                getattr(self, name)[chosen]
                for name in (
                    *("batch", "tracker", "number", "time_s", "direction", "covariance"),
                    *("place", "sigma_rad", "magnitude_mag"),
                )
            ),
        )

    def per_steradian(self) -> Vector:
        """The density (n,) of unexplained points about each: those of its batch and tracker."""
        own = self.batch * len(self.trackers) + self.tracker
        _, inverse, count = np.unique(own, return_inverse=True, return_counts=True)
        return np.asarray(count[inverse] / self.field_sr[self.tracker])
