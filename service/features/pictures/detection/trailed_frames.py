"""Star trails on frames of a calibrated camera: detection, and places at mid exposure.

The images themselves show how the stars moved. If too few images are bright, the body's rates are
used.
"""

import math

import numpy as np

from service.features.pictures.centroids.trail_fit import TrailPlaces
from service.features.pictures.centroids.window import CentroidRecord, too_faint
from service.features.pictures.detection.clipped import clipped_stars
from service.features.pictures.detection.detect import Detections
from service.features.pictures.detection.measure import MeasuredStar, chosen_stars
from service.features.pictures.detection.points import (
    TRAIL_PEAKS,
    TRAIL_ROUNDS,
    TRAIL_WEIGHT_PX,
    image_moments,
)
from service.features.pictures.detection.trails import (
    CLEAR_RATIO,
    LEAST_DRAWN_OUT,
    LEAST_WIDTHS,
    MOST_UNEXPLAINED,
    Motion,
    Trails,
    find_trails,
    measured_trails,
    placed_trails,
    twin_distance_px,
)
from service.features.pictures.frames.frame import CountArray, Frame, bad_frame
from service.missions.camera import Camera, CentroidMethod
from service.missions.mission import Tracker
from service.observations.scans.lines import BREAKDOWN_RATIO
from service.vectors import Vector

LEAST_FRAME_WIDTHS = 1.4
"""Least trail length in widths of an image; sigmas of calibrated cameras are not rescaled."""
PIXEL_VARIANCE = 1.0 / 12.0
"""The variance that a pixel adds to the width of an image, in square pixels."""
CONTRADICTED_SHARE = 0.3
"""Relative difference of trail lengths by rates and by frame that is a contradiction."""


def trails_of_frame(
    frame: Frame,
    found: Detections,
    tracker: Tracker,
    camera: Camera,
    rates_deg_per_s: Vector,
    exposure_s: float,
) -> Trails | None:
    """The star trails on a frame; None for still stars, and for cameras with no Gaussian image.

    Raises `BadFile` where the motion of stars does not allow a place at mid exposure.
    """
    if camera.psf != "gaussian":
        return None
    side_px = max(camera.shape)
    apart_px = twin_distance_px(found.u_px, found.v_px, found.flux_counts, side_px)
    if apart_px is not None:
        raise bad_frame(_refusal(apart_px, "in two images of each"))
    expected = _by_rates(tracker, camera, rates_deg_per_s, exposure_s)
    if expected is None and not _may_trail(found, camera):
        return None
    # Hot pixels and cosmic rays would outnumber the stars.
    usable = usable_pixels(frame, camera) & found.good
    trails = measured_trails(found.light, found.noise_counts, usable, LEAST_FRAME_WIDTHS)
    if trails is None:
        return expected
    if trails.refused is not None:
        discs = clipped_stars(found.light) if expected is None else None
        if discs is not None:
            raise bad_frame(
                f"is stretched or overexposed: {len(discs.u_px)} stars are cut off at the largest "
                "count, and have neither places nor magnitudes; send the counts of the detector"
            )
        raise bad_frame(_refusal(trails.length_px, trails.refused))
    return trails


def _refusal(length_px: float, reason: str) -> str:
    return (
        f"is trailed: stars moved by about {length_px:.0f} px during the exposure, {reason}: where "
        "they were at mid exposure cannot be told"
    )


def _may_trail(found: Detections, camera: Camera) -> bool:
    """True if most of the brightest candidates are elongated, in any direction."""
    u, v = (np.round(each[:TRAIL_PEAKS]).astype(np.int64) for each in (found.u_px, found.v_px))
    weight_px = max(TRAIL_WEIGHT_PX, 2.0 * camera.psf_sigma_px)
    shapes = image_moments(found.light, u, v, weight_px, TRAIL_ROUNDS)
    return len(u) > 0 and bool(np.median(np.abs(shapes.drawn_out)) > LEAST_DRAWN_OUT)


def _by_rates(
    tracker: Tracker, camera: Camera, rates_deg_per_s: Vector, exposure_s: float
) -> Trails | None:
    """The star trails predicted from the body's rates; None where they are short."""
    motion = _motion_by_rates(tracker, camera, rates_deg_per_s, exposure_s)
    u, v = np.array([camera.center_u_px]), np.array([camera.center_v_px])
    length = float(np.hypot(*motion.trails(u, v)[:2])[0])
    corner = 0.5 * math.hypot(*camera.shape) * abs(motion.turn_rad)
    sigma = math.hypot(camera.psf_sigma_px, math.sqrt(PIXEL_VARIANCE))
    longest = max(length, corner)
    return Trails(motion, sigma, longest) if longest > LEAST_WIDTHS * sigma else None


def _motion_by_rates(
    tracker: Tracker, camera: Camera, rates_deg_per_s: Vector, exposure_s: float
) -> Motion:
    # In tracker axes an inertially fixed star moves opposite to the body.
    turn = -np.radians(rates_deg_per_s) @ tracker.body_from_tracker * exposure_s
    f = camera.focal_length_px
    return Motion(
        camera.center_u_px, camera.center_v_px, f * turn[1], -f * turn[0], float(turn[2]), f
    )


def usable_pixels(frame: Frame, camera: Camera) -> CountArray:
    """True for pixels (rows, columns) that hold a number below saturation."""
    full = min(camera.saturation_counts, frame.full_scale)
    return np.asarray(np.isfinite(frame.counts) & (frame.counts < full))


def measure_trails(
    frame: Frame,
    found: Detections,
    trails: Trails,
    camera: Camera,
    method: CentroidMethod,
    faintest_mag: float,
    exposure_s: float,
) -> list[MeasuredStar]:
    """The stars of a frame with trails, measured, brightest first, in the form of `measure`.

    All methods place a star by the best fit of its trail.
    """
    light, noise = found.light, found.noise_counts
    u, v, ratio = find_trails(light, noise, trails, camera.threshold_sigma, 2 * camera.most_stars)
    usable = usable_pixels(frame, camera)
    placed = placed_trails(light, noise, usable, trails, u, v, camera.gain_e_per_count)
    alike = (placed.unexplained < MOST_UNEXPLAINED) | (ratio < CLEAR_RATIO)
    records = [_record(placed, k, method) for k in np.flatnonzero(alike).tolist()]
    flux = np.array([record.flux_counts for record in records], dtype=np.float64)
    magnitudes = camera.magnitude(flux, exposure_s)
    return chosen_stars(records, magnitudes.tolist(), faintest_mag, camera.most_stars)


def _record(placed: TrailPlaces, number: int, method: str) -> CentroidRecord:
    """The centroid record of one trailed star; unexplained light enlarges its sigmas."""
    covariance = placed.covariance[number] * max(float(placed.chi_square[number]), 1.0)
    flux = float(placed.flux_counts[number])
    sigma = math.sqrt(float(placed.covariance[number][2, 2]))
    if not flux > BREAKDOWN_RATIO * sigma:
        return too_faint(method, flux, sigma, ())
    sigma_u, sigma_v = math.sqrt(covariance[0, 0]), math.sqrt(covariance[1, 1])
    return CentroidRecord(
        method=method,
        u_px=float(placed.u_px[number]),
        v_px=float(placed.v_px[number]),
        sigma_u_px=sigma_u,
        sigma_v_px=sigma_v,
        correlation_uv=float(covariance[0, 1]) / (sigma_u * sigma_v),
        flux_counts=flux,
        sigma_flux_counts=sigma,
        signal_ratio=flux / sigma,
    )


def remarks_on_trails(
    trails: Trails, tracker: Tracker, camera: Camera, rates_deg_per_s: Vector, exposure_s: float
) -> list[str]:
    """Remarks for a frame with star trails, including a contradiction with the body's rates."""
    middles = (
        f"trailed: stars moved by about {trails.length_px:.0f} px during the exposure; the middles "
        "of their trails were taken, where they were at mid exposure"
    )
    remarks = [middles]
    expected = _motion_by_rates(tracker, camera, rates_deg_per_s, exposure_s)
    u, v = np.array([camera.center_u_px]), np.array([camera.center_v_px])
    seen, told = (np.concatenate(motion.trails(u, v)[:2]) for motion in (trails.motion, expected))
    seen_px, told_px = float(np.hypot(*seen)), float(np.hypot(*told))
    # A trail does not tell which of its ends came first.
    apart_px = min(float(np.hypot(*(seen - told))), float(np.hypot(*(seen + told))))
    if apart_px > CONTRADICTED_SHARE * max(seen_px, told_px) + trails.sigma_px:
        if not rates_deg_per_s.any():
            contradiction = f"are zero or not given, and the frame shows {seen_px:.1f} px"
        elif abs(seen_px - told_px) < 0.5 * apart_px:
            contradiction = "move a star in the middle in another direction than the frame shows"
        else:
            contradiction = (
                f"move a star in the middle by {told_px:.1f} px, the frame shows {seen_px:.1f} px"
            )
        remarks.append(f"body_rates_deg_per_s: they {contradiction}")
    return remarks
