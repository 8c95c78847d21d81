"""From tracker counts to body vectors at the batch's epoch.

Focal-plane calibration, alignment of tracker to body, then each star carried
from its own time to the batch's with the body rates.  Aberration is not
touched here: observed vectors are never changed for it.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from service.missions.mission import Calibration, Mission, Tracker
from service.observe.batch import ObservationBatch, TrackerStars
from service.vectors import Vector, locked, read_only, unit


@dataclass(frozen=True)
class CorrectedObservations:
    """The stars of one tracker as unit vectors (n, 3) in body axes at the batch's epoch.

    Magnitude is NaN where none was given; sigma is one standard deviation per
    tangent axis; `outside_field_of_view` marks stars that the tracker should
    not be able to see.
    """

    tracker: Tracker
    direction_body: Vector
    magnitude_mag: Vector
    sigma_arcsec: Vector
    outside_field_of_view: npt.NDArray[np.bool_]


def correct(batch: ObservationBatch, mission: Mission) -> tuple[CorrectedObservations, ...]:
    """Every tracker's stars as body vectors at the epoch.

    Raises `BadInput` naming the field of a tracker that the mission has not.
    """
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
    # The same for every tracker and batch, so that they are compiled once.
    given = (
        tracker.body_from_tracker,
        math.cos(math.radians(tracker.field_of_view_radius_deg)),
        tracker.sigma_arcsec,
        rates_deg_per_s,
        stars.time_offset_s,
        stars.sigma_arcsec,
    )
    complete, body, sigma_arcsec, outside = _to_body(stars.vector, *given)
    if not complete:
        from_angles = tracker_vectors(stars.angles_deg, tracker.calibration)
        direction = np.where(np.isnan(stars.vector), from_angles, stars.vector)
        _, body, sigma_arcsec, outside = _to_body(read_only(direction), *given)
    return CorrectedObservations(
        tracker=tracker,
        direction_body=read_only(body),
        magnitude_mag=locked(stars.magnitude_mag),
        sigma_arcsec=read_only(sigma_arcsec),
        outside_field_of_view=outside,
    )


@njit(cache=True)
def _to_body(  # type: ignore[no-untyped-def]
    direction,  # (n, 3) in tracker axes
    body_from_tracker,
    least_cosine,  # of the angle to the boresight within the field of view
    default_sigma,
    rates_deg_per_s,
    time_offset_s,
    sigma,
):
    """Whether every direction is known, and if so (n, 3) in body axes, sigmas, and who is outside.

    v(epoch) = exp([w x] dt) v, dt being the star's time minus the batch's.
    """
    n = len(direction)
    body, sigmas, outside = np.empty((n, 3)), np.empty(n), np.empty(n, np.bool_)
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
    for k in range(n):
        if math.isnan(direction[k, 0]):
            return False, body, sigmas, outside
        outside[k] = direction[k, 2] < least_cosine
        sigmas[k] = default_sigma if math.isnan(sigma[k]) else sigma[k]
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
    return True, body, sigmas, outside


def tracker_vectors(angles_deg: Vector, calibration: Calibration) -> Vector:
    """Unit vectors (n, 3) in tracker axes of measured angles (n, 2).

    The direction is that of (tan h, tan v, 1), h and v being the true angles.
    """
    h, v = angles_deg[:, 0], angles_deg[:, 1]
    true_h, true_v = (
        calibration.scale * (measured + sum(c * h**i * v**j for i, j, c in terms))
        for measured, terms in ((h, calibration.h_terms), (v, calibration.v_terms))
    )
    plane = np.stack(
        [np.tan(np.radians(true_h)), np.tan(np.radians(true_v)), np.ones_like(h)], axis=1
    )
    return unit(plane)
