"""Conversion of a frame to a batch of its stars, for calibrated and uncalibrated cameras."""

import json
import math
from dataclasses import replace
from time import perf_counter_ns
from typing import IO, Any

import numpy as np

from service.features.pictures.blind.lens import Lens
from service.features.pictures.blind.picture import (
    PictureAttitude,
    PictureResult,
    blind_sky,
    solve_picture,
    trail_refusal,
)
from service.features.pictures.blind.picture_remarks import doubt_of_exposure
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import Frame, FrameLimits, bad_frame, require_light
from service.features.pictures.tracker import submit
from service.missions.camera import Camera
from service.missions.mission import Mission
from service.observations.frame_record import FrameRecord, rounded_counts
from service.observations.schema import Submission, submission_from_model
from service.sky.catalog.star_catalog import Catalog
from service.times import parse_utc
from service.vectors import ARCSEC_PER_RADIAN, Vector

ROUGH_SHARE = 0.05
"""Position error if no lens could be fitted, as a share of the half diagonal."""
LEAST_SIGMA_PX = 0.05


def submit_frame(
    file: IO[bytes],
    digest: str,
    known: submit.FrameIn,
    mission: Mission,
    catalog: Catalog,
    max_pixels: int,
) -> Submission:
    """The submission of the stars on a frame; for an uncalibrated camera the lens is fitted first.

    Raises `BadFile` for a file that is no frame of the tracker and for a frame without a star,
    `BadInput` for data that do not fit the mission.
    """
    _, camera = mission.camera_tracker(known.tracker, "tracker")
    if camera.calibrated:
        return submit.submission_of_frame(file, digest, known, mission, max_pixels)
    return _of_unknown_lens(file, digest, known, mission, catalog, max_pixels)


def _of_unknown_lens(
    file: IO[bytes],
    digest: str,
    known: submit.FrameIn,
    mission: Mission,
    catalog: Catalog,
    max_pixels: int,
) -> Submission:
    start = perf_counter_ns()
    tracker, camera = mission.camera_tracker(known.tracker, "tracker")
    limits = FrameLimits(max_pixels, camera.shape, tracker.name, known.image)
    frame = read_frame(file, limits, digest)
    require_light(frame, camera.saturation_counts)
    time, remarks = submit.time_of(known, frame)
    exposure_s = known.exposure_s or frame.exposure_s or camera.exposure_s
    frame = replace(frame, exposure_s=exposure_s)
    read = perf_counter_ns()
    sky, solver = blind_sky(catalog, round(parse_utc(time).julian_year))
    result = solve_picture(
        _without_time(frame), sky, solver, camera.focal_length_px, whole_only=True
    )
    if result.points.trailed is not None:
        raise bad_frame(f"cannot be measured: {trail_refusal(result.points)}")
    if result.points.count == 0:
        raise bad_frame("shows no star that could be used", "; ".join(result.remarks)[:200])
    chosen = _chosen(result, camera.most_stars, mission.catalog.magnitude_limit_mag)
    found = result.attitude
    if found is not None and known.a_priori is None:
        # The whole sky has been searched already. The identification about this prior still depends
        # on its own evidence.
        prior = {"a_priori": {"quaternion": _unit(found.quaternion)}}
        known = submit.FrameIn.model_validate_json(json.dumps(_sent_fields(known) | prior))
    stars = _observed(result, chosen, camera)
    model = submit.batch_of_stars(mission.name, known, digest, time, tracker, stars)
    done = perf_counter_ns()
    timings = {"read": (read - start) // 1000, "detect": (done - read) // 1000, "centroid": 0}
    record = _record(result, chosen, stars, camera, tracker.name, timings)
    remarks += [*doubt_of_exposure(result, camera.zero_point_mag), *submit.choices_of(result.frame)]
    record = replace(record, remarks=[*record.remarks, *remarks])
    submission = submission_from_model(model)
    return Submission(
        submission.batch, submission.text, known.fingerprint(mission.name, digest), record
    )


def _sent_fields(known: submit.FrameIn) -> dict[str, Any]:
    fields: dict[str, Any] = json.loads(known.model_dump_json(exclude_defaults=True))
    return fields


def _unit(quaternion: Vector) -> list[float]:
    return [float(each) for each in quaternion / np.linalg.norm(quaternion)]


def _without_time(frame: Frame) -> Frame:
    """A frame without its time, so that aberration is corrected only in the acquisition."""
    return replace(frame, time=None)


def _chosen(result: PictureResult, most: int, limit_mag: float) -> list[int]:
    """Indices of the points for a batch: those with a star in the run catalog first, then others.

    Points with fainter stars are left out, since the mission's catalog does not have them.
    """
    found = result.attitude.stars if result.attitude is not None else ()
    magnitude = {(star.u_px, star.v_px): star.magnitude_v_mag for star in found}
    pairs = zip(result.points.u_px.tolist(), result.points.v_px.tolist(), strict=True)
    starless = [magnitude.get(place, math.nan) for place in pairs]
    known = [k for k, mag in enumerate(starless) if not mag > limit_mag]
    stars = [k for k in known if not math.isnan(starless[k])]
    others = [k for k in known if math.isnan(starless[k])]
    if stars:
        # Enough clutter to be weighed, but not so much that the search takes long.
        others = others[: max(len(stars) // 2, 3)]
    return (stars + others)[:most]


def _scale_of(found: PictureAttitude, directions: Vector, sigma_rad: Vector) -> float:
    """Factor on star sigmas that makes the attitude as uncertain as the lens fit; at least 1."""
    outer = np.einsum("ni,nj->nij", directions, directions)
    information = ((np.eye(3) - outer) / sigma_rad[:, None, None] ** 2).sum(axis=0)
    alone = np.diag(np.linalg.inv(information))
    return math.sqrt(max(float((np.diag(found.covariance_rad2) / alone).max()), 1.0))


def _observed(result: PictureResult, chosen: list[int], camera: Camera) -> list[dict[str, Any]]:
    points, found = result.points, result.attitude
    u, v, sigma = points.u_px[chosen], points.v_px[chosen], points.sigma_px[chosen]
    if found is None:
        lens = Lens(camera.width_px, camera.height_px, camera.focal_length_px)
        directions, focal_px = lens.directions(u, v), lens.focal_px
        sigma = np.hypot(sigma, ROUGH_SHARE * lens.radius_px)
        magnitude = np.full(len(chosen), math.nan)
    else:
        directions, focal_px = found.directions(u, v), found.lens.focal_px
        sigma = np.maximum(sigma, LEAST_SIGMA_PX) * max(found.sigma_scale, 1.0)
        sigma = sigma * _scale_of(found, directions, sigma / focal_px)
        light = points.flux_counts[chosen] / (result.frame.exposure_s or 1.0)
        magnitude = found.zero_point_mag - 2.5 * np.log10(light)
    sigma_arcsec = np.clip(sigma / focal_px * ARCSEC_PER_RADIAN, 1e-3, 3600.0)
    return [
        {
            "vector": vector,
            "magnitude": round(mag, 3) if -30.0 <= mag <= 30.0 else None,
            "sigma_arcsec": round(each, 4),
        }
        for vector, mag, each in zip(
            np.round(directions, 10).tolist(),
            magnitude.tolist(),
            sigma_arcsec.tolist(),
            strict=True,
        )
    ]


def _record(
    result: PictureResult,
    chosen: list[int],
    stars: list[dict[str, Any]],
    camera: Camera,
    tracker: str,
    timings_us: dict[str, int],
) -> FrameRecord:
    points = result.points
    preview, step = submit.preview_png(points.light, points.noise_counts)
    remarks = list(result.remarks)
    if result.attitude is not None:
        lens, scale = result.attitude.lens, result.attitude.sigma_scale
        remarks.insert(
            0,
            f"lens_fitted: focal length {lens.focal_px:.1f} px, field "
            f"{result.attitude.field_deg[0]:.2f} x {result.attitude.field_deg[1]:.2f} deg, zero "
            f"point {result.attitude.zero_point_mag:.2f} mag; sigmas are scaled by {scale:.2f} "
            "after the residuals and widened by what is not known of the lens; the a priori "
            "attitude of the batch, if none was given, is the frame's own",
        )
    return FrameRecord(
        digest=result.frame.digest,
        file_format=result.frame.file_format,
        tracker=tracker,
        width_px=points.width_px,
        height_px=points.height_px,
        exposure_s=result.frame.exposure_s or camera.exposure_s,
        centroid=camera.centroid,
        background_counts=rounded_counts(points.background_counts, 3),
        noise_counts=rounded_counts(points.noise_counts, 3),
        candidates=points.count,
        sharp=[],
        stars=[
            {
                "u_px": round(float(points.u_px[k]), 4),
                "v_px": round(float(points.v_px[k]), 4),
                "sigma_u_px": round(math.sqrt(points.covariance_px2[k, 0, 0]), 5),
                "sigma_v_px": round(math.sqrt(points.covariance_px2[k, 1, 1]), 5),
                "flux_counts": rounded_counts(float(points.flux_counts[k]), 1),
                "magnitude": star["magnitude"],
                "signal_ratio": round(float(points.signal_ratio[k]), 1),
                "flags": [],
                "used": True,
                "left_out": None,
            }
            for k, star in zip(chosen, stars, strict=True)
        ],
        timings_us=timings_us,
        preview=preview,
        preview_step=step * points.binning,
        remarks=remarks,
    )
