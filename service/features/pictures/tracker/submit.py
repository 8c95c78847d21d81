"""Conversion of a frame and its metadata to an observation batch for the pipeline.

The batch holds all inputs of the answer, so that it can be solved again without the frame.
"""

import hashlib
import io
import json
import math
from dataclasses import replace
from itertools import pairwise
from time import perf_counter_ns as clock_ns
from typing import IO, TYPE_CHECKING, Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, Field

from service.errors import BadBatch, Fault
from service.features.pictures.centroids.window import Flag
from service.features.pictures.frames.files import read_frame
from service.features.pictures.frames.frame import (
    CountArray,
    Frame,
    FrameLimits,
    bad_frame,
    require_light,
)
from service.missions.camera import STARS_TO_MAG, Camera, CentroidMethod
from service.missions.mission import Mission, Tracker
from service.observations import schema
from service.observations.batch import Aberration
from service.observations.field_faults import checked_by
from service.observations.frame_record import FrameRecord, rounded_counts
from service.times import utc_now
from service.vectors import Vector

if TYPE_CHECKING:
    from service.features.pictures.detection.detect import Detections
    from service.features.pictures.detection.measure import MeasuredStar


LEAST_SIGMA_ARCSEC = 1e-3
RANKS, LEAST_RANKS = (3, 21), 4
"""Range of the brightness ranks that are compared with the average sky, and their least number."""
MOST_OFF_MAG = 3.0
"""Largest plausible difference of magnitudes from the average sky: star fields differ by a factor
of five in number, 1.5 mag, and cameras in colour.
"""
BLENDED_SHARE = 0.15
"""Share of the image's sigma by which an undetected companion may shift a blended star.

A companion with the share r of the light shifts the star by 0.86 r sigma at most, at a distance of
1.4 sigma; closer ones are merged in run catalogs too.
"""


class FrameIn(schema.Wire):
    """The metadata sent with a frame: the fields of a batch except its stars."""

    batch: schema.Key | None = None
    time: Annotated[str, AfterValidator(schema.is_time)] | None = None
    run: schema.RunName = schema.LIVE
    tracker: schema.Key | None = None
    a_priori: schema.APrioriIn | None = None
    body_rates_deg_per_s: tuple[schema.BodyRate, schema.BodyRate, schema.BodyRate] = (0.0, 0.0, 0.0)
    velocity_km_per_s: tuple[schema.Speed, schema.Speed, schema.Speed] | None = None
    sun_vector: schema.UnitVector | None = None
    position_km: schema.Position | None = None
    aberration: Aberration = "to_correct"
    exposure_s: Annotated[schema.Number, Field(gt=0, le=3600)] | None = None
    centroid: CentroidMethod | None = None
    image: Annotated[str, Field(min_length=1, max_length=80)] | None = None
    """The chosen image in a frame's file with several; see `FrameLimits`."""
    options: schema.OptionsIn = schema.OptionsIn()

    def batch_of(self, digest: str) -> str:
        """The batch id of a frame: as given, or made from the digest and the chosen image."""
        if self.batch is not None:
            return self.batch
        name = digest.removeprefix("sha256:")
        if self.image is not None:
            name = hashlib.sha256(f"{name}\n{self.image}".encode()).hexdigest()
        return f"frame-{name[:16]}"

    def fingerprint(self, spacecraft: str, digest: str) -> str:
        """A digest of a spacecraft's frame and all of its metadata."""
        text = f"{spacecraft}\n{digest}\n{self.model_dump_json(exclude_defaults=True)}"
        return hashlib.sha256(text.encode()).hexdigest()


def read_known(values: dict[str, Any]) -> FrameIn:
    """The validated metadata of a frame; raises `BadBatch` with every fault."""
    # Through JSON, since a list in JSON is a tuple in the model.
    return checked_by(FrameIn.model_validate_json, json.dumps(values))


def submission_of_frame(
    file: IO[bytes], digest: str, known: FrameIn, mission: Mission, max_pixels: int
) -> schema.Submission:
    """The submission of a frame: a batch of its stars, with a record of their detection.

    Raises `BadFile` for a file that is no frame of the tracker and for a frame without a star,
    `BadInput` for metadata that do not fit the mission.
    """
    clock = [clock_ns()]
    tracker, camera = mission.camera_tracker(known.tracker, "tracker")
    limits = FrameLimits(max_pixels, camera.shape, tracker.name, known.image)
    frame = read_frame(file, limits, digest)
    require_light(frame, camera.saturation_counts)
    time, remarks = time_of(known, frame)
    stated = exposure_stated(frame)
    if known.exposure_s is not None:
        frame = replace(frame, exposure_s=known.exposure_s)
        stated = f"{known.exposure_s:.6g} s, as given"
    clock.append(clock_ns())
    # Importing these modules takes a third of the service's start, and some services get no frame.
    from service.features.pictures.detection.detect import detect
    from service.features.pictures.detection.measure import measure
    from service.features.pictures.detection.star_images import psf_of
    from service.features.pictures.detection.trailed_frames import (
        measure_trails,
        remarks_on_trails,
        trails_of_frame,
    )

    rates_deg_per_s = np.array(known.body_rates_deg_per_s)
    exposure_s = frame.exposure_s or camera.exposure_s
    found = detect(frame, camera, psf_of(camera, tracker, rates_deg_per_s, exposure_s))
    clock.append(clock_ns())
    method, faintest_mag = known.centroid or camera.centroid, camera.faintest_mag
    faintest_mag = mission.catalog.magnitude_limit_mag if faintest_mag is None else faintest_mag
    trails = trails_of_frame(frame, found, tracker, camera, rates_deg_per_s, exposure_s)
    if trails is None:
        stars = measure(frame, found, tracker, camera, rates_deg_per_s, method, faintest_mag)
    else:
        stars = measure_trails(frame, found, trails, camera, method, faintest_mag, exposure_s)
        remarks += remarks_on_trails(trails, tracker, camera, rates_deg_per_s, exposure_s)
    clock.append(clock_ns())
    used = [star for star in stars if star.left_out is None]
    doubt = [] if trails else doubt_of_exposure(found, camera, frame.exposure_s, stated)
    if not used:
        if not found.count and np.ptp(frame.counts[np.isfinite(frame.counts)]) < 1.0:
            doubt = ["its counts differ by less than 1: they are not those of the detector"]
        message = "; ".join(["shows no star that could be used", *doubt])
        raise bad_frame(message, f"{found.count} candidates")
    model = batch_of_stars(mission.name, known, digest, time, tracker, _observed(used, camera))
    steps = dict(
        zip(
            ("read", "detect", "centroid"),
            ((end - start) // 1000 for start, end in pairwise(clock)),
            strict=True,
        )
    )
    record = _record(frame, found, stars, tracker, camera, known, steps)
    record = replace(record, remarks=[*remarks, *doubt, *choices_of(frame)])
    submission = schema.submission_from_model(model)
    fingerprint = known.fingerprint(mission.name, digest)
    return schema.Submission(submission.batch, submission.text, fingerprint, record)


def time_of(known: FrameIn, frame: Frame) -> tuple[str, list[str]]:
    """The time of a frame in UTC, and remarks on it.

    Without a time, aberration cannot be corrected. If aberration is ignored anyway, the time of
    arrival is recorded; otherwise raises `BadBatch`.
    """
    time = known.time or frame.time
    if time is not None:
        return time, []
    if known.aberration != "ignore":
        message = f"must be given: {frame.no_time}; it may be absent where aberration is ignored"
        raise BadBatch(Fault("time", message))
    remark = (
        "time_unknown: the time of arrival stands for that of the exposure; aberration, up to 20 "
        "arcsec, is not corrected"
    )
    return utc_now().text, [remark]


def choices_of(frame: Frame) -> list[str]:
    """Remarks on the options chosen for a file, and on how its pixels were turned."""
    turned = [f"orientation: {frame.orientation}"] if frame.is_turned else []
    return [*turned, *frame.remarks]


def exposure_stated(frame: Frame) -> str:
    """The exposure of a frame in words, with the keyword that states it."""
    mark = "exposure_of_file: "
    stated = (remark.removeprefix(mark) for remark in frame.remarks if remark.startswith(mark))
    return next(stated, "1 s" if frame.exposure_s is None else f"{frame.exposure_s:.6g} s")


def doubt_of_exposure(
    found: "Detections", camera: Camera, exposure_s: float | None, stated: str
) -> list[str]:
    """Remarks, none or one, on a stated exposure by which the stars' magnitudes are implausible.

    The candidates' magnitudes, without the two brightest, are compared with the average magnitudes
    of as many stars in a field of this size.
    """
    ranks = np.arange(RANKS[0], min(found.count, RANKS[1]))
    if camera.zero_point_mag is None or len(ranks) < LEAST_RANKS:
        return []
    if exposure_s is None:
        exposure_s, stated = camera.exposure_s, f"{camera.exposure_s:.6g} s, from the mission"
    field_deg2 = camera.width_px * camera.height_px * math.degrees(1 / camera.focal_length_px) ** 2
    seen = camera.magnitude(found.flux_counts[ranks - 1], exposure_s)
    off_mag = float(np.median(seen - usual_magnitude(ranks, field_deg2)))
    if not abs(off_mag) > MOST_OFF_MAG:
        return []
    remark = (
        f"exposure_doubtful: with {stated}, the candidates would be "
        f"{abs(off_mag):.1f} mag {'fainter' if off_mag > 0.0 else 'brighter'} than the stars of "
        f"a field of this size: a factor of {10.0 ** (0.4 * abs(off_mag)):.2g} in the exposure or "
        "in the unit of the counts"
    )
    return [remark]


def usual_magnitude(ranks: npt.NDArray[np.intp], field_deg2: float) -> npt.NDArray[np.floating]:
    """The average magnitude (n,) down to which a field holds a given number of stars."""
    magnitudes, counts = np.array(STARS_TO_MAG).T
    # The logarithm of the number of stars is nearly linear in magnitude.
    slope, level = np.polyfit(magnitudes, np.log10(counts), 1)
    return np.asarray((np.log10(ranks * 41253.0 / field_deg2) - level) / slope)


def batch_of_stars(
    spacecraft: str,
    known: FrameIn,
    digest: str,
    time: str,
    tracker: Tracker,
    stars: list[dict[str, Any]],
) -> schema.BatchIn:
    """The observation batch of a tracker's stars, with the metadata of their frame."""
    fields = json.loads(known.model_dump_json(exclude_defaults=True))
    for name in ("tracker", "exposure_s", "centroid", "image"):
        fields.pop(name, None)
    whole = {
        "spacecraft": spacecraft,
        "a_priori": None,
        **fields,
        "batch": known.batch_of(digest),
        "time": time,
        "observations": [{"tracker": tracker.name, "stars": stars}],
    }
    return schema.BatchIn.model_validate_json(json.dumps(whole))


def _observed(stars: "list[MeasuredStar]", camera: Camera) -> list[dict[str, Any]]:
    """The measured stars as fields of a batch: direction, sigma and magnitude."""
    u, v = (np.array([getattr(star.record, name) for star in stars]) for name in ("u_px", "v_px"))
    sigma_u, sigma_v = (
        np.array([_sigma_px(star, name, camera) for star in stars])
        for name in ("sigma_u_px", "sigma_v_px")
    )
    sigma = camera.tangent_sigmas_arcsec(u, v, sigma_u, sigma_v)
    directions: Vector = camera.directions(u, v)
    return [
        {
            "vector": vector,
            "magnitude": _rounded(star.magnitude_mag, 3),
            "sigma_arcsec": round(max(sigma_arcsec, LEAST_SIGMA_ARCSEC), 4),
        }
        for star, vector, sigma_arcsec in zip(
            stars, np.round(directions, 10).tolist(), sigma.tolist(), strict=True
        )
    ]


def _sigma_px(star: "MeasuredStar", name: str, camera: Camera) -> float:
    """A star's position error in pixels: centroid error, calibration residual, and for a blend the
    shift by a hidden companion.
    """
    hidden = BLENDED_SHARE * camera.psf_sigma_px if Flag.BLENDED in star.record.flags else 0.0
    return math.hypot(getattr(star.record, name), camera.sigma_floor_px, hidden)


def _record(
    frame: Frame,
    found: "Detections",
    stars: "list[MeasuredStar]",
    tracker: Tracker,
    camera: Camera,
    known: FrameIn,
    timings_us: dict[str, int],
) -> FrameRecord:
    preview, step = preview_of(found)
    sharp = zip(found.sharp_u_px.tolist(), found.sharp_v_px.tolist(), strict=True)
    return FrameRecord(
        digest=frame.digest,
        file_format=frame.file_format,
        tracker=tracker.name,
        width_px=frame.width_px,
        height_px=frame.height_px,
        exposure_s=frame.exposure_s or camera.exposure_s,
        centroid=known.centroid or camera.centroid,
        background_counts=rounded_counts(float(np.median(found.background_counts)), 3),
        noise_counts=rounded_counts(found.noise_counts, 3),
        candidates=found.count,
        sharp=[(round(u, 1), round(v, 1)) for u, v in sharp][:500],
        stars=[_star_fields(star) for star in stars],
        timings_us=timings_us,
        preview=preview,
        preview_step=step,
    )


def _star_fields(star: "MeasuredStar") -> dict[str, Any]:
    """The fields of a measured star candidate in a frame's record, rounded for JSON."""
    record = star.record
    return {
        "u_px": _rounded(record.u_px, 4),
        "v_px": _rounded(record.v_px, 4),
        "sigma_u_px": _rounded(record.sigma_u_px, 5),
        "sigma_v_px": _rounded(record.sigma_v_px, 5),
        "flux_counts": _rounded_counts(record.flux_counts, 1),
        "magnitude": _rounded(star.magnitude_mag, 3),
        "signal_ratio": _rounded(record.signal_ratio, 1),
        "flags": [str(flag) for flag in record.flags],
        "used": star.left_out is None,
        "left_out": star.left_out,
    }


def _rounded(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None


def _rounded_counts(value: float, digits: int) -> float | None:
    return rounded_counts(value, digits) if math.isfinite(value) else None


MAX_SIDE_PX = 1024
BLACK_SIGMAS = 2.0
WHITE_SIGMAS = 400.0
GREYS = 48
"""Number of grey levels in a preview: few, with black for noise, make a small file."""


def preview_of(found: "Detections") -> tuple[bytes, int]:
    """A PNG preview of a frame, and the number of frame pixels per preview pixel along a side."""
    return preview_png(np.where(found.good, found.light, 0.0), found.noise_counts)


def preview_png(light: CountArray, noise_counts: float) -> tuple[bytes, int]:
    """A PNG preview of light (rows, columns) above its background, and the pixels per preview pixel
    along a side.

    Each preview pixel shows the brightest of its pixels, so that no star is lost.
    """
    from PIL import Image

    rows, columns = light.shape
    step = -(-max(rows, columns) // MAX_SIDE_PX)
    light = np.pad(light, ((0, -rows % step), (0, -columns % step)))
    blocks = light.reshape(light.shape[0] // step, step, light.shape[1] // step, step)
    image = Image.fromarray(_greys(blocks.max(axis=(1, 3)) / noise_counts))
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue(), step


def _greys(sigmas: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Grey levels (0 to 255) of light in sigmas of noise, by the inverse hyperbolic sine."""
    above = np.clip(sigmas - BLACK_SIGMAS, 0.0, WHITE_SIGMAS)
    share = np.arcsinh(above / 4.0) / np.arcsinh(WHITE_SIGMAS / 4.0)
    return np.asarray(np.round(share * GREYS) * (255.0 / GREYS), dtype=np.uint8)
