"""Conversion of trackers' readings: scans to measured angles, and Sun counts to a direction.

The stored record keeps the readings as sent; angles and sigmas are computed with the mission's
settings at every reading of the record.
"""

import math
from typing import NamedTuple

import numpy as np
from msgspec import structs

from service.errors import BadBatch, Fault, shown_value
from service.missions.mission import Mission, Tracker
from service.missions.scan import WIDEST_DEG, CrossScan, Raster, Sweep
from service.observations.batch import (
    MAX_STARS_PER_TRACKER,
    ObservationBatch,
    Readings,
    TrackerStars,
)
from service.observations.focal_plane import tracker_vectors
from service.observations.scans.lines import BREAKDOWN_RATIO, cross_scan
from service.observations.scans.raster import raster_stars
from service.vectors import Vector, read_only, rotate_about, unit

_FIELDS = {"counts": "h_counts", "times": "h_times"}
_ROUNDS = 20
_SETTLED_DEG = 1e-9


def reduced(batch: ObservationBatch, mission: Mission) -> ObservationBatch:
    """A batch with scanning trackers' readings replaced by angles, sigmas and, for a raster, stars.

    A batch without readings is returned as it is. Raises `BadInput` naming the field of a tracker
    unknown to the mission, or of readings that do not fit its scan.
    """
    if not any(each.readings for each in batch.observations):
        return batch
    observations = []
    for index, stars in enumerate(batch.observations):
        field = f"observations.{index}"
        tracker = mission.tracker(stars.tracker, f"{field}.tracker")
        rates_body = np.radians(batch.body_rates_deg_per_s)
        rates = tracker.body_from_tracker.T @ rates_body
        observations.append(_reduced(stars, tracker, rates, field) if stars.readings else stars)
    if not any(each.count for each in observations):
        raise BadBatch(Fault("observations", "no star stands out in the lines of the raster"))
    return structs.replace(batch, observations=tuple(observations))


def _reduced(stars: TrackerStars, tracker: Tracker, rates: Vector, field: str) -> TrackerStars:
    """Stars of one scanning tracker, with angles; `rates` are the body's, rad/s in tracker axes."""
    first = next(each for each in stars.readings if each is not None)
    if first.kind == "lines":
        return _of_raster(first, tracker, field)
    angles, sigma = stars.angles_deg.copy(), stars.sigma_arcsec.copy()
    offset = stars.time_offset_s.copy()
    for k, reading in enumerate(stars.readings):
        if reading is None:
            continue
        star_field = f"{field}.stars.{k}"
        if isinstance(tracker.scan, CrossScan) and reading.kind == "counts":
            shift, of_scan = _of_counts(reading, tracker.scan, star_field)
            angles[k] += shift
        elif isinstance(tracker.scan, Sweep) and reading.kind == "times":
            angles[k], of_scan, passed_s = _of_times(
                reading, tracker, tracker.scan, rates, star_field
            )
            offset[k] += passed_s
        else:
            raise _other_kind(tracker, f"{star_field}.{_FIELDS[reading.kind]}", reading.kind)
        if not (np.abs(angles[k]) < WIDEST_DEG).all():
            h_deg, v_deg = angles[k].tolist()
            place = f"{h_deg:.4g}, {v_deg:.4g} deg from the boresight"
            message = f"is {place}: outside of any field of view"
            raise BadBatch(Fault(star_field, message))
        if math.isnan(sigma[k]):
            sigma[k] = of_scan
    return structs.replace(
        stars,
        angles_deg=read_only(angles),
        sigma_arcsec=read_only(sigma),
        time_offset_s=read_only(offset),
        readings=(),
    )


def _other_kind(tracker: Tracker, field: str, kind: str) -> BadBatch:
    scan = "no scan" if tracker.scan is None else f"a scan of the kind {tracker.scan.kind}"
    message = f"the mission file gives {tracker.name} {scan}, which has no {kind}"
    return BadBatch(Fault(field, message))


def _of_counts(reading: Readings, scan: CrossScan, field: str) -> tuple[Vector, float]:
    """The displacement (2,) of a star from the middle of two lines in deg, its sigma in arcsec."""
    places, variance = [], scan.sigma_floor_arcsec**2
    for axis, counts in (("h", reading.h), ("v", reading.v)):
        line_field = f"{field}.{axis}_counts"
        if len(counts) != scan.samples:
            message = f"has {len(counts)} samples; a scan of the tracker has {scan.samples}"
            raise BadBatch(Fault(line_field, message))
        if scan.saturation_counts is not None and (counts >= scan.saturation_counts).any():
            at = int(np.argmax(counts))
            message = f"is full: a sample saturates at {scan.saturation_counts:g} counts"
            raise BadBatch(Fault(f"{line_field}.{at}", message, str(float(counts[at]))))
        found = cross_scan(
            counts,
            scan.step_arcsec,
            scan.noise_counts,
            scan.background_counts,
            math.inf if scan.gain_e_per_count is None else scan.gain_e_per_count,
        )
        if found.refused:
            message = (
                f"holds no star: its light is {found.signal_ratio:.2f} times the noise, below "
                f"{BREAKDOWN_RATIO:g}; leave the star out"
            )
            raise BadBatch(Fault(line_field, message))
        half_arcsec = (scan.samples // 2) * scan.step_arcsec
        if abs(found.displacement) > half_arcsec:
            message = (
                f"puts its light {found.displacement:.4g} arcsec from the middle of a line that "
                f"ends at {half_arcsec:g}: the level is not the {scan.background_counts:g} counts "
                "of the mission file"
            )
            raise BadBatch(Fault(line_field, message))
        places.append(found.displacement / 3600.0)
        variance += 0.5 * found.sigma**2
    return np.array(places), math.sqrt(variance)


def _of_times(
    reading: Readings, tracker: Tracker, scan: Sweep, rates: Vector, field: str
) -> tuple[Vector, float, float]:
    """Star's angles (2,) in deg, their sigma in arcsec, and their time in s after the first sweep.

    They hold for the crossing along h; the body's rotation until the crossing along v is corrected.
    """
    h = crossing_of(reading.h, scan, f"{field}.h_times")
    v = crossing_of(reading.v, scan, f"{field}.v_times")
    later_s = scan.v_after_s + v.time_s - h.time_s
    angles = np.array([[h.angle_deg, v.angle_deg]])
    if rates.any():
        aim = _v_deg(tracker_vectors(angles, tracker.calibration))
        for _ in range(_ROUNDS):
            direction = tracker_vectors(angles, tracker.calibration)
            off_deg = aim - _v_deg(rotate_about(-rates * later_s, direction))
            angles[0, 1] += off_deg / tracker.calibration.scale
            if abs(off_deg) < _SETTLED_DEG:
                break
        else:
            message = f"cannot be carried over the {later_s:.4g} s to the second sweep: the body "
            raise BadBatch(Fault(f"{field}.v_times", message + "turns too fast"))
    variance = scan.sigma_floor_arcsec**2 + 0.5 * (h.sigma_arcsec**2 + v.sigma_arcsec**2)
    return angles[0], math.sqrt(variance), h.time_s


def _v_deg(direction: Vector) -> float:
    return math.degrees(math.atan2(direction[0, 1], direction[0, 2]))


def _of_raster(reading: Readings, tracker: Tracker, field: str) -> TrackerStars:
    scan = tracker.scan
    if not isinstance(scan, Raster):
        raise _other_kind(tracker, f"{field}.column_counts", reading.kind)
    found = raster_stars(reading.h, reading.v, scan, field)
    light = found.light_counts[:MAX_STARS_PER_TRACKER]
    count = len(light)
    sigmas = found.sigma_arcsec[:count]
    magnitude = np.full(count, np.nan)
    if scan.zero_point_mag is not None:
        magnitude = scan.zero_point_mag - 2.5 * np.log10(light)
    return TrackerStars(
        tracker=tracker.name,
        vector=read_only(np.full((count, 3), np.nan)),
        angles_deg=read_only(found.angles_deg[:count].copy()),
        magnitude_mag=read_only(magnitude),
        time_offset_s=read_only(np.zeros(count)),
        sigma_arcsec=read_only(
            np.sqrt(scan.sigma_floor_arcsec**2 + 0.5 * np.sum(sigmas**2, axis=1))
        ),
    )


class Crossing(NamedTuple):
    """The mean crossing of a star over the wires: its angle at a time after the sweep began."""

    angle_deg: float
    time_s: float
    sigma_arcsec: float


def crossing_of(times: Vector, scan: Sweep, field: str) -> Crossing:
    """The mean of a star's crossings over all wires, at the mean of their times.

    `times` are in the mission's unit. Raises `BadBatch` naming `field` for a number of times other
    than that of the wires, for times that do not rise, and for times after the end of the sweep.
    """
    wires_deg = np.array(scan.wires_deg)
    if len(times) != len(wires_deg):
        there_are = f"has {len(times)} times; the tracker has {len(wires_deg)} wires"
        raise BadBatch(Fault(field, there_are))
    seconds = times * scan.time_unit_s
    late = np.flatnonzero(seconds > scan.duration_s)
    if len(late):
        at = int(late[0])
        message = f"is outside of the scan, which lasts {scan.duration_s:g} s"
        raise BadBatch(Fault(f"{field}.{at}", message, shown_value(float(times[at]))))
    early = np.flatnonzero(np.diff(times) <= 0.0)
    if len(early):
        at = int(early[0]) + 1
        message = "is not after the time before it: a star crosses the wires one after the other"
        raise BadBatch(Fault(f"{field}.{at}", message, shown_value(float(times[at]))))
    angles_deg = scan.start_deg + scan.rate_deg_per_s * seconds - wires_deg
    sigma_deg = scan.rate_deg_per_s * scan.time_sigma_s / math.sqrt(len(times))
    return Crossing(float(angles_deg.mean()), float(seconds.mean()), 3600.0 * sigma_deg)


def sun_body(counts: Vector, mission: Mission, field: str) -> Vector:
    """The unit vector (3,) to the Sun in body axes, from a Sun tracker's counts.

    `counts` are I+ and I- of the pair along the tracker's X, then of that along Y. Raises
    `BadBatch` naming `field` for a mission without a sun tracker, for pairs without light, and for
    signals beyond their linear range.
    """
    tracker = mission.sun_tracker
    if tracker is None:
        raise BadBatch(Fault(field, f"the mission file of {mission.name} has no sun_tracker"))
    limit = tracker.slope_per_arcmin * tracker.straight_to_arcmin
    plane = []
    for axis, (plus, minus) in zip(
        "XY", (counts - tracker.background_counts).reshape(2, 2), strict=True
    ):
        light = float(plus + minus)
        if light < BREAKDOWN_RATIO * math.sqrt(2.0) * tracker.noise_counts:
            message = f"the pair along {axis} has no sunlight: its light is below the noise"
            raise BadBatch(Fault(field, message, shown_value(light)))
        signal = float(plus - minus) / light
        if abs(signal) > limit:
            message = (
                f"the signal along {axis} is beyond {limit:.3g}: the Sun is farther off than "
                f"{tracker.straight_to_arcmin:g} arcmin, where the signal is not straight"
            )
            raise BadBatch(Fault(field, message, shown_value(signal)))
        plane.append(math.tan(math.radians(signal / tracker.slope_per_arcmin / 60.0)))
    return unit(tracker.body_from_tracker @ np.array([*plane, 1.0]))
