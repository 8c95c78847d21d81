"""From tracker counts to body vectors at the batch's epoch.

Focal-plane calibration, alignment of tracker to body, then each star carried
from its own time to the batch's with the body rates.  Aberration is not
touched here: observed vectors are never changed for it.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.missions.mission import Calibration, Mission, Tracker
from service.observe.batch import ObservationBatch, TrackerStars
from service.vectors import Vector, locked, read_only, turned_at_rate, unit


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
    direction = stars.vector
    as_angles = np.isnan(direction[:, 0])
    if as_angles.any():
        from_angles = tracker_vectors(stars.angles_deg, tracker.calibration)
        direction = np.where(as_angles[:, None], from_angles, direction)
    outside = direction[:, 2] < math.cos(math.radians(tracker.field_of_view_radius_deg))
    body = direction @ tracker.body_from_tracker.T
    if rates_deg_per_s.any() and stars.time_offset_s.any():
        # v(epoch) = exp([w x] dt) v, dt being the star's time minus the batch's.
        body = turned_at_rate(body, np.radians(rates_deg_per_s), stars.time_offset_s)
    return CorrectedObservations(
        tracker=tracker,
        direction_body=read_only(np.ascontiguousarray(body)),
        magnitude_mag=locked(stars.magnitude_mag),
        sigma_arcsec=read_only(
            np.where(np.isnan(stars.sigma_arcsec), tracker.sigma_arcsec, stars.sigma_arcsec)
        ),
        outside_field_of_view=outside,
    )


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
