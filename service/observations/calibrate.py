"""The conversion of tracker measurements to unit vectors in body axes at the batch's epoch.

Focal-plane calibration, alignment of tracker to body, then rotation of each star from its own time
to the batch's with the body rates. Observed vectors are never corrected for aberration.
"""

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.compiled.jit import njit, njit_no_refcount
from service.missions.mission import Magnitudes, Mission, Tracker
from service.observations.batch import ObservationBatch
from service.observations.columns import BatchColumns, Integers, joined, offsets_of
from service.observations.focal_plane import true_tangents
from service.observations.scans.reduce import reduced
from service.vectors import ARCSEC_PER_RADIAN, Vector, read_only


class CorrectedObservations(Struct, frozen=True, eq=False, gc=False):
    """The calibrated stars of one tracker: unit vectors (n, 3) in body axes at the batch's epoch.

    Magnitude is NaN if missing; sigma, in either unit, is one standard deviation per tangent axis;
    `outside_field_of_view` marks stars beyond the tracker's field of view.
    """

    tracker: Tracker
    direction_body: Vector
    magnitude_mag: Vector
    sigma_arcsec: Vector
    sigma_rad: Vector
    outside_field_of_view: npt.NDArray[np.bool_]


class CorrectedColumns(Struct, frozen=True, eq=False, gc=False):
    """The calibrated stars of n batches and t trackers as columns; see `CorrectedObservations`.

    Offsets are those of `BatchColumns`; `trackers` (t,) is None for trackers whose stars are not
    computed. The other columns, by star, are the fields of `CorrectedObservations`.
    """

    tracker_offsets: Integers
    trackers: Sequence[Tracker | None]
    star_offsets: Integers
    direction_body: Vector
    magnitude_mag: Vector
    sigma_arcsec: Vector
    sigma_rad: Vector
    outside_field_of_view: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, corrected: Sequence[CorrectedObservations]) -> "CorrectedColumns":
        """The columns of calibrated stars for a single batch, from those of its trackers."""
        return cls(
            tracker_offsets=np.array((0, len(corrected))),
            trackers=[each.tracker for each in corrected],
            star_offsets=offsets_of([len(each.sigma_rad) for each in corrected]),
            direction_body=joined([each.direction_body for each in corrected], 3),
            magnitude_mag=joined([each.magnitude_mag for each in corrected]),
            sigma_arcsec=joined([each.sigma_arcsec for each in corrected]),
            sigma_rad=joined([each.sigma_rad for each in corrected]),
            outside_field_of_view=np.concatenate([e.outside_field_of_view for e in corrected]),
        )

    def trackers_of(self, row: int) -> range:
        """The row numbers of a batch's trackers among those of all batches."""
        return range(*self.tracker_offsets[row : row + 2].tolist())

    def of_batch(self, row: int) -> tuple[CorrectedObservations, ...]:
        """The calibrated stars of a batch, separately for each tracker."""
        return tuple(self._of_tracker(t) for t in self.trackers_of(row))

    def _of_tracker(self, t: int) -> CorrectedObservations:
        first, last = self.star_offsets[t : t + 2].tolist()
        tracker = self.trackers[t]
        assert tracker is not None
        return CorrectedObservations(
            tracker,
            read_only(self.direction_body[first:last]),
            read_only(self.magnitude_mag[first:last]),
            read_only(self.sigma_arcsec[first:last]),
            self.sigma_rad[first:last],
            self.outside_field_of_view[first:last],
        )


def correct(batch: ObservationBatch, mission: Mission) -> tuple[CorrectedObservations, ...]:
    """The stars of a batch as unit vectors in body axes at its epoch, with one object per tracker.

    Raises `BadInput` naming the field of a tracker unknown to the mission, and the errors of
    `reduced`.
    """
    batch = reduced(batch, mission)
    return correct_columns(BatchColumns.of([batch]), trackers_of(batch, mission)).of_batch(0)


def trackers_of(batch: ObservationBatch, mission: Mission) -> list[Tracker]:
    """The mission's trackers for those of a batch; raises `BadInput` with the field of another."""
    return [
        mission.tracker(each.tracker, f"observations.{index}.tracker")
        for index, each in enumerate(batch.observations)
    ]


def correct_columns(batches: BatchColumns, trackers: Sequence[Tracker | None]) -> CorrectedColumns:
    """The stars of many batches as unit vectors in body axes at the epochs of their batches.

    `trackers` correspond to `batches.tracker`; the stars of a tracker that is None are left out.
    """
    m = len(batches.magnitude_mag)
    found = CorrectedColumns(
        tracker_offsets=batches.tracker_offsets,
        trackers=trackers,
        star_offsets=batches.star_offsets,
        direction_body=np.empty((m, 3)),
        magnitude_mag=np.empty(m),
        sigma_arcsec=np.empty(m),
        sigma_rad=np.empty(m),
        outside_field_of_view=np.empty(m, np.bool_),
    )
    different = {each.name: each for each in trackers if each is not None}
    place_of = {name: place for place, name in enumerate(different)}
    places = np.array([-1 if each is None else place_of[each.name] for each in trackers])
    observed = (
        batches.vector,
        batches.rates_deg_per_s,
        batches.time_offset_s,
        batches.sigma_arcsec,
        batches.magnitude_mag,
    )
    written = (
        found.direction_body,
        found.magnitude_mag,
        found.sigma_arcsec,
        found.sigma_rad,
        found.outside_field_of_view,
    )
    for place, tracker in enumerate(different.values()):
        rows = place, places, batches.tracker_offsets, batches.star_offsets
        settings = (
            tracker.body_from_tracker,
            tracker.least_cosine,
            tracker.sigma_arcsec,
            tracker.magnitudes.zero_mag,
            tracker.magnitudes.scale,
        )
        tangents = true_tangents(batches.angles_deg, tracker.calibration)
        _to_body(tangents, rows, settings, observed, written)
    return found


@njit
def _to_body(tangents, rows, settings, observed, written):  # type: ignore[no-untyped-def]
    """Fill in the stars of one tracker, rotated to body axes at the epochs of their batches.

    v(epoch) = exp([w x] dt) v, dt being the star's time minus the batch's.  A star without a
    vector has the direction (tan h, tan v, 1) in tracker axes; `tangents` (m, 2) are tan h, tan v.
    """
    # `place` is the index of the tracker among `places` (t,).
    place, places, tracker_offsets, star_offsets = rows
    # `least_cosine` is the cosine of the field of view's radius.
    body_from_tracker, least_cosine, default_sigma, zero_mag, magnitude_scale = settings
    vector, rates_deg_per_s, time_offset_s, sigma, magnitude = observed
    # The true magnitude is on the scale of the run catalog.
    body, true_magnitude, sigma_arcsec, sigma_rad, outside = written
    for i in range(len(tracker_offsets) - 1):
        rates = rates_deg_per_s[i]
        rate = math.radians(math.sqrt(rates[0] ** 2 + rates[1] ** 2 + rates[2] ** 2))
        x = y = z = 0.0
        if rate > 0.0:
            x, y, z = (
                math.radians(rates[0]) / rate,
                math.radians(rates[1]) / rate,
                math.radians(rates[2]) / rate,
            )
        for s in range(tracker_offsets[i], tracker_offsets[i + 1]):
            if places[s] != place:
                continue
            for k in range(star_offsets[s], star_offsets[s + 1]):
                u, v, w = vector[k, 0], vector[k, 1], vector[k, 2]
                if math.isnan(u):
                    u, v = tangents[k, 0], tangents[k, 1]
                    norm = math.sqrt(u * u + v * v + 1.0)
                    u, v, w = u / norm, v / norm, 1.0 / norm
                outside[k] = w < least_cosine
                true_magnitude[k] = zero_mag + magnitude_scale * magnitude[k]
                sigma_arcsec[k] = default_sigma if math.isnan(sigma[k]) else sigma[k]
                sigma_rad[k] = sigma_arcsec[k] / ARCSEC_PER_RADIAN
                for j in range(3):
                    body[k, j] = (
                        u * body_from_tracker[j, 0]
                        + v * body_from_tracker[j, 1]
                        + w * body_from_tracker[j, 2]
                    )
                _turn(body[k], x, y, z, rate * time_offset_s[k])


@njit_no_refcount
def _turn(vector, x, y, z, angle):  # type: ignore[no-untyped-def]
    """Rotate a vector (3,) about a unit axis by an angle in radians, in place."""
    if angle == 0.0:
        return
    u, v, w = vector[0], vector[1], vector[2]
    once0, once1, once2 = y * w - z * v, z * u - x * w, x * v - y * u
    half = math.sin(0.5 * angle)
    sine, versine = math.sin(angle), 2.0 * half * half
    vector[0] += sine * once0 + versine * (y * once2 - z * once1)
    vector[1] += sine * once1 + versine * (z * once0 - x * once2)
    vector[2] += sine * once2 + versine * (x * once1 - y * once0)


def measured_magnitudes(true_mag: Vector, settings: Magnitudes) -> Vector:
    """The magnitudes that a tracker would measure for true magnitudes; the inverse of `correct`."""
    return np.asarray((true_mag - settings.zero_mag) / settings.scale)
