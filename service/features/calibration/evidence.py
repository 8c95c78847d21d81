"""Selection of identified stars and their magnitudes from acquired batches, for a calibration."""

from collections.abc import Collection
from typing import Any

import numpy as np

from service.acquire import Acquisition
from service.acquire.choices import aberration_velocity
from service.features.calibration.elimination import Marks
from service.features.calibration.magnitudes import MagnitudeStars, joined
from service.features.calibration.stars import IdentifiedStars, Indices
from service.identify.attitude_from_matches import matched_vectors
from service.observations.batch import TrackerStars
from service.observations.focal_plane import tracker_vectors
from service.sky.ephemeris import sun_distance_au
from service.vectors import Vector, matrix_from_quaternion

Columns = dict[str, Any]


def identified_stars(acquisition: Acquisition, trackers: Collection[str]) -> IdentifiedStars | None:
    """Uniquely identified stars of one batch, for the trackers with the given names.

    None if the batch has no attitude, or no such star.
    """
    if acquisition.solution is None:
        return None
    mission = acquisition.mission
    used = tuple(each for each in mission.trackers if each.name in trackers)
    names = [each.name for each in used]
    parts = []
    for sent, result in zip(acquisition.batch.observations, acquisition.trackers, strict=True):
        if sent.tracker in names:
            star = result.identification.star
            chosen: Indices = np.flatnonzero(result.identification.unique & ~_shared(star))
            if len(chosen):
                part = _of_tracker(acquisition, sent, chosen, star[chosen])
                part["tracker"] = np.full(len(chosen), names.index(sent.tracker))
                part["sigma_rad"] = result.corrected.sigma_rad[chosen]
                parts.append(part)
    if not parts:
        return None
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    count = len(columns["tracker"])
    return IdentifiedStars(
        trackers=used,
        batch=np.zeros(count, np.int64),
        temperature_c=np.full(count, np.nan),
        time_s=np.array([acquisition.batch.time.tai_ns * 1e-9]),
        attitude=matrix_from_quaternion(acquisition.solution.quaternion)[None],
        rates_rad_per_s=np.radians(acquisition.batch.body_rates_deg_per_s)[None],
        **columns,
    )


def identified_magnitudes(
    acquisition: Acquisition, trackers: Collection[str], color_bv_mag: Vector
) -> MagnitudeStars | None:
    """Magnitudes of uniquely identified stars of a batch; `color_bv_mag` (N,) are the catalog's
    colours.

    None if the batch has no attitude, or no such star with a magnitude.
    """
    if acquisition.solution is None:
        return None
    run_catalog = acquisition.run_catalog
    names = [each.name for each in acquisition.mission.trackers if each.name in trackers]
    parts = []
    for sent, result in zip(acquisition.batch.observations, acquisition.trackers, strict=True):
        if sent.tracker in names:
            star, observed_mag = result.identification.star, result.corrected.magnitude_mag
            chosen = result.identification.unique & ~_shared(star) & np.isfinite(observed_mag)
            row = run_catalog.catalog_row[star[chosen]]
            catalog_mag = run_catalog.magnitude_mag[star[chosen]]
            index = np.full(len(row), names.index(sent.tracker))
            found = index, row, observed_mag[chosen], catalog_mag, color_bv_mag[row]
            parts += [MagnitudeStars(*found)] if len(row) else []
    return joined(parts)


def _shared(star: Indices) -> Marks:
    """Mask of stars that share their catalog star with another: one of the two must be wrong."""
    names, count = np.unique(star, return_counts=True)
    return np.isin(star, names[count > 1])


def _of_tracker(
    acquisition: Acquisition, sent: TrackerStars, chosen: Indices, star: Indices
) -> Columns:
    """Measured angles and catalog directions of chosen stars; `star` are their catalog rows."""
    mission, batch = acquisition.mission, acquisition.batch
    calibration = mission.tracker(sent.tracker, "observations").calibration
    vector, angles_deg = sent.vector[chosen], sent.angles_deg[chosen]
    as_vector = np.isfinite(vector[:, :1])
    directions = np.where(as_vector, vector, tracker_vectors(angles_deg, calibration))
    angles = np.arctan2(directions[:, :2], directions[:, 2:])
    # The kernel picks the observed direction and the sigma too; only the references matter here.
    _, reference, _ = matched_vectors(
        directions,
        np.ones(len(star)),
        star,
        acquisition.run_catalog.direction_at(batch.time),
        aberration_velocity(batch),
        sun_distance_au(batch.time),
    )
    return {
        "measured_rad": np.where(as_vector, angles, np.radians(angles_deg)),
        "angles_rad": angles,
        "reference": reference,
        "time_offset_s": sent.time_offset_s[chosen],
    }
