"""The unexplained points of batches whose attitude is known, carried to inertial directions."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from service.missions.mission import Tracker
from service.observations.batch import ObservationBatch, TrackerStars
from service.observations.calibrate import CorrectedObservations
from service.observations.focal_plane import tracker_vectors
from service.sky.ephemeris import natural, observer_velocity
from service.times import Utc
from service.vectors import ARCSEC_PER_RADIAN, Matrix, Vector

_NAMES = (
    *("batch", "tracker", "number", "time_s", "direction", "covariance"),
    *("place", "sigma_rad", "magnitude_mag"),
)
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
        return replace(self, **{name: getattr(self, name)[chosen] for name in _NAMES})

    def per_steradian(self) -> Vector:
        """The density (n,) of unexplained points about each: those of its batch and tracker."""
        own = self.batch * len(self.trackers) + self.tracker
        _, inverse, count = np.unique(own, return_inverse=True, return_counts=True)
        return np.asarray(count[inverse] / self.field_sr[self.tracker])


@dataclass
class Gathering:
    """Takes batches in order of time; `points` and `batches` are what was taken."""

    trackers: Sequence[Tracker]
    _times: list[Utc] = field(default_factory=list)
    _positions: list[Vector] = field(default_factory=list)
    _ids: list[str] = field(default_factory=list)
    _parts: list[dict[str, npt.NDArray[np.generic]]] = field(default_factory=list)

    def add(
        self,
        batch: ObservationBatch,
        corrected: Sequence[CorrectedObservations],
        unexplained: Sequence[Indices],
        attitude: Matrix,
        covariance_arcsec2: Matrix,
        id: str = "",
    ) -> None:
        """Take a batch with its attitude (3, 3) and the attitude's covariance in body axes.

        `unexplained` are the places of the points of each of its trackers, in the batch's order.
        """
        self._times.append(batch.time)
        unknown = np.full(3, np.nan)
        self._positions.append(unknown if batch.position_km is None else batch.position_km)
        self._ids.append(id)
        names = [each.name for each in self.trackers]
        for sent, seen, own in zip(batch.observations, corrected, unexplained, strict=True):
            if len(own):
                part = _carried(batch, sent, seen, own, attitude, covariance_arcsec2)
                seconds = (batch.time.tai_ns - self._times[0].tai_ns) * 1e-9
                part["time_s"] = seconds + sent.time_offset_s[own]
                part["batch"] = np.full(len(own), len(self._times) - 1)
                part["tracker"] = np.full(len(own), names.index(sent.tracker))
                self._parts.append(part)

    @property
    def batches(self) -> Batches:
        """The batches that were taken."""
        positions = np.array(self._positions).reshape(-1, 3)
        return Batches(tuple(self._times), positions, tuple(self._ids))

    @property
    def points(self) -> Points:
        """Their unexplained points."""
        fields_sr = 2.0 * np.pi * (1.0 - np.array([each.least_cosine for each in self.trackers]))
        names = tuple(each.name for each in self.trackers)
        if not self._parts:
            whole, single = np.zeros(0, np.int64), np.zeros(0)
            triple = np.zeros((0, 3))
            return Points(
                *(names, fields_sr, whole, whole, whole, single, triple),
                *(np.zeros((0, 3, 3)), triple, single, single),
            )
        return Points(
            names,
            fields_sr,
            **{name: np.concatenate([each[name] for each in self._parts]) for name in _NAMES},
        )


def _carried(
    batch: ObservationBatch,
    sent: TrackerStars,
    seen: CorrectedObservations,
    own: Indices,
    attitude: Matrix,
    covariance_arcsec2: Matrix,
) -> dict[str, npt.NDArray[np.generic]]:
    """Directions with their covariances, and places on the detector."""
    body = seen.direction_body[own]
    direction = body @ attitude
    if batch.aberration == "to_correct":
        velocity_c = observer_velocity(batch.time, batch.velocity_km_per_s)
        direction = natural(direction, velocity_c, batch.time)
    # An attitude that is off by the rotation e moves a direction b by b x e, or e x b.
    across = np.cross(body[:, None, :], np.eye(3)[None, :, :])
    of_attitude = across.transpose(0, 2, 1) @ (covariance_arcsec2 / ARCSEC_PER_RADIAN**2) @ across
    square = seen.sigma_rad[own, None, None] ** 2
    of_point = square * (np.eye(3) - body[:, :, None] * body[:, None, :])
    vector = sent.vector[own]
    from_angles = tracker_vectors(sent.angles_deg[own], seen.tracker.calibration)
    return {
        "number": own,
        "direction": direction,
        "covariance": attitude.T @ (of_attitude + of_point) @ attitude,
        "place": np.where(np.isnan(vector), from_angles, vector),
        "sigma_rad": seen.sigma_rad[own],
        "magnitude_mag": seen.magnitude_mag[own],
    }
