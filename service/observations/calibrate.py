"""From tracker counts to body vectors at the batch's epoch.

Focal-plane calibration, alignment of tracker to body, then each star carried
from its own time to the batch's with the body rates.  Aberration is not
touched here: observed vectors are never changed for it.
"""

import math

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.compiled.jit import njit
from service.missions.corrections import Magnitudes
from service.missions.mission import Mission, Tracker
from service.observations.batch import ObservationBatch, TrackerStars
from service.observations.focal_plane import tracker_vectors
from service.observations.scans.reduce import reduced
from service.vectors import ARCSEC_PER_RADIAN, Vector, locked, read_only


class CorrectedObservations(Struct, frozen=True, eq=False, gc=False):
    """The stars of one tracker as unit vectors (n, 3) in body axes at the batch's epoch.

    Magnitude is NaN where none was given; sigma, in either unit, is one standard
    deviation per tangent axis; `outside_field_of_view` marks stars that the tracker should
    not be able to see.
    """

    tracker: Tracker
    direction_body: Vector
    magnitude_mag: Vector
    sigma_arcsec: Vector
    sigma_rad: Vector
    outside_field_of_view: npt.NDArray[np.bool_]


def correct(batch: ObservationBatch, mission: Mission) -> tuple[CorrectedObservations, ...]:
    """Every tracker's stars as body vectors at the epoch.

    Raises `BadInput` naming the field of a tracker that the mission has not, and as
    `reduced` does.
    """
    batch = reduced(batch, mission)
    return tuple(
        _corrected(
            stars,
            mission.tracker(stars.tracker, f"observations.{index}.tracker"),
            batch.body_rates_deg_per_s,
        )
        for index, stars in enumerate(batch.observations)
    )


def _corrected(
    stars: TrackerStars, tracker: Tracker, rates_deg_per_s: Vector
) -> CorrectedObservations:
    n = len(stars.vector)
    body, sigma, outside = np.empty((n, 3)), np.empty((2, n)), np.empty(n, np.bool_)
    # The same for every tracker and batch, so that they are compiled once.
    given = (
        tracker.body_from_tracker,
        tracker.least_cosine,
        tracker.sigma_arcsec,
        rates_deg_per_s,
        stars.time_offset_s,
        stars.sigma_arcsec,
        body,
        sigma,
        outside,
    )
    if not _to_body(stars.vector, *given):
        from_angles = tracker_vectors(stars.angles_deg, tracker.calibration)
        direction = np.where(np.isnan(stars.vector), from_angles, stars.vector)
        _to_body(read_only(direction), *given)
    return CorrectedObservations(
        tracker,
        read_only(body),
        true_magnitudes(stars.magnitude_mag, tracker.magnitudes),
        read_only(sigma[0]),
        sigma[1],
        outside,
    )


@njit
def _to_body(  # type: ignore[no-untyped-def]
    direction,  # (n, 3) in tracker axes
    body_from_tracker,
    least_cosine,  # of the angle to the boresight within the field of view
    default_sigma,
    rates_deg_per_s,
    time_offset_s,
    sigma,
    body,  # (n, 3) in body axes
    sigmas,  # (2, n) in arcsec and in radians
    outside,  # (n,) of the field of view
):
    """Whether every direction is known; if so `body`, `sigmas` and `outside` are written.

    v(epoch) = exp([w x] dt) v, dt being the star's time minus the batch's.
    """
    rate = math.radians(
        math.sqrt(rates_deg_per_s[0] ** 2 + rates_deg_per_s[1] ** 2 + rates_deg_per_s[2] ** 2)
    )
    x = y = z = 0.0
    if rate > 0.0:
        x, y, z = (
            math.radians(rates_deg_per_s[0]) / rate,
            math.radians(rates_deg_per_s[1]) / rate,
            math.radians(rates_deg_per_s[2]) / rate,
        )
    for k in range(len(direction)):
        if math.isnan(direction[k, 0]):
            return False
        outside[k] = direction[k, 2] < least_cosine
        sigmas[0, k] = default_sigma if math.isnan(sigma[k]) else sigma[k]
        sigmas[1, k] = sigmas[0, k] / ARCSEC_PER_RADIAN
        for i in range(3):
            body[k, i] = (
                direction[k, 0] * body_from_tracker[i, 0]
                + direction[k, 1] * body_from_tracker[i, 1]
                + direction[k, 2] * body_from_tracker[i, 2]
            )
        angle = rate * time_offset_s[k]
        if angle == 0.0:
            continue
        u, v, w = body[k, 0], body[k, 1], body[k, 2]
        once0, once1, once2 = y * w - z * v, z * u - x * w, x * v - y * u
        half = math.sin(0.5 * angle)
        sine, versine = math.sin(angle), 2.0 * half * half
        body[k, 0] += sine * once0 + versine * (y * once2 - z * once1)
        body[k, 1] += sine * once1 + versine * (z * once0 - x * once2)
        body[k, 2] += sine * once2 + versine * (x * once1 - y * once0)
    return True


def true_magnitudes(measured_mag: Vector, settings: Magnitudes) -> Vector:
    """The magnitudes (n,) that a tracker would measure if it were as the run catalog assumes."""
    if settings.zero_mag == 0.0 and settings.scale == 1.0:
        return locked(measured_mag)
    return read_only(settings.zero_mag + settings.scale * measured_mag)


def measured_magnitudes(true_mag: Vector, settings: Magnitudes) -> Vector:
    """`true_magnitudes` undone."""
    return np.asarray((true_mag - settings.zero_mag) / settings.scale)
