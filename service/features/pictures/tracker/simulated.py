"""Simulation of star tracker frames with known truth: the real sky, a camera, and all its noise.

Every star of the catalog shines, not only those of the run catalog, each at its own place and time,
so that blends and faint neighbours are included.  In physical order: light through the image of a
point, smeared by the body's rates; the response of each pixel; photon noise of light, sky and dark
current; hot pixels and cosmic rays; read noise; saturation; rounding to counts.
"""

import io
import json
import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal, get_args

import numpy as np

from service.errors import BadFile, BadInput, Fault, shown_value
from service.features.pictures.centroids.psf import ColouredPsf, Psf
from service.features.pictures.detection import star_images
from service.features.pictures.frames.fits import write_fits
from service.features.pictures.frames.frame import CountArray
from service.missions.camera import Camera, PsfKind
from service.missions.mission import Mission, RunCatalogSettings, Tracker
from service.simulate.motion import orbit_of, pointed, random_axis, turned_by
from service.simulate.sightings import RealSky, real_sky
from service.sky.catalog.run_catalog import build_run_catalog
from service.sky.ephemeris import apparent, observer_velocity
from service.sky.model import SkyModel
from service.times import Utc, parse_utc, shifted
from service.vectors import Matrix, Vector, quaternion_from_matrix

DEFAULT_START = "2026-03-01T00:00:00.000Z"
CADENCE_S = 60.0
FAINTEST_RENDERED_MAG = 9.0
"""Magnitude of the faintest simulated stars, the limit of the embedded catalog."""
FAINTEST_TOLD_MAG = 8.0
MARGIN_PX = 10
"""Width in pixels of the margin around a frame from which stars shine in; more for wide images."""
FAINT_REACHES = ((2e3, 16), (3e4, 48))
"""Electrons of a star below which the image of an aperture is drawn to a radius in pixels only; a
pixel outside holds a tenth of an electron.
"""
DRAWN_BV_MAG = (-0.4, -0.2, 0.0, 0.3, 0.6, 1.0, 1.4, 1.8, 2.4, 3.2)
"""Colour indices for which star images are computed; others are interpolated."""
TYPICAL_BV_MAG = 0.65
"""Colour index of a star without one in the catalog: the median down to V 9."""
FULL_SCALE = 65535


@dataclass(frozen=True)
class FrameSettings:
    """Settings of simulated frames; equal settings always give equal frames."""

    frames: int
    seed: int = 1
    tracker: str | None = None
    start: str = DEFAULT_START
    psf: PsfKind | None = None
    """Kind of star image; None: as the mission's camera describes."""
    a_priori_error_deg: float | None = 1.0
    """Largest error of the a priori attitude in degrees; None: no a priori attitude."""
    rates_deg_per_s: float = 0.02
    """Largest simulated body rate about any axis, in deg/s."""
    response_sigma: float = 0.005
    """Standard deviation of the pixels' response to light, as a fraction."""
    sky_e_per_s: float = 100.0
    hot_pixels: int = 200
    cosmic_rays: int = 5

    def __post_init__(self) -> None:
        _require(self.frames >= 1, "frames", "must be at least 1", self.frames)
        _require(self.seed >= 0, "seed", "must not be negative", self.seed)
        sane = self.psf is None or self.psf in get_args(PsfKind)
        _require(sane, "psf", "must be gaussian, airy or cross", self.psf)
        error_deg = self.a_priori_error_deg
        sane = error_deg is None or 0.0 <= error_deg <= 180.0
        _require(sane, "prior-error", "must be from 0 to 180 deg", error_deg)
        sane = 0.0 <= self.rates_deg_per_s <= 10.0
        _require(sane, "rates", "must be from 0 to 10 deg/s", self.rates_deg_per_s)
        sane = 0.0 <= self.response_sigma <= 0.3
        _require(sane, "response", "must be from 0 to 0.3", self.response_sigma)
        sane = 0.0 <= self.sky_e_per_s <= 1e6
        _require(sane, "sky", "must be from 0 to 1e6 electrons a second", self.sky_e_per_s)
        for name, count in (("hot-pixels", self.hot_pixels), ("cosmic-rays", self.cosmic_rays)):
            _require(0 <= count <= 100_000, name, "must be from 0 to 100000", count)


@dataclass(frozen=True)
class DrawnFrame:
    """A simulated frame with its metadata for the service, and its truth.

    `known` is sent to the service with the frame; `truth` is not.
    """

    counts: CountArray
    exposure_s: float
    time: Utc
    known: dict[str, Any]
    truth: dict[str, Any]


@dataclass(frozen=True)
class _Chip:
    """Properties of a detector that all frames share: pixel response and hot pixels."""

    response: CountArray
    hot: CountArray
    hot_e_per_s: Vector


@dataclass(frozen=True)
class _FrameStars:
    """Stars on one frame at mid exposure, brightest first."""

    row: Any
    u_px: Vector
    v_px: Vector
    magnitude_mag: Vector
    bv_mag: Vector
    trail_u_px: Vector
    trail_v_px: Vector = field(default_factory=lambda: np.zeros(0))


def draw_frames(
    mission: Mission, sky: SkyModel, wanted: FrameSettings, numbers: Iterable[int] | None = None
) -> Iterator[DrawnFrame]:
    """Simulate the frames of one tracker, or some by number; each has its own random generator."""
    tracker, camera = mission.camera_tracker(wanted.tracker, "tracker")
    start = parse_utc(wanted.start, "start")
    root = (wanted.seed, *mission.name.encode(), *tracker.name.encode())
    chip = _chip(camera, wanted, np.random.default_rng([*root, 0]))
    lens = camera if wanted.psf is None else camera.model_copy(update={"psf": wanted.psf})
    digits = max(4, len(str(wanted.frames)))
    for k in range(wanted.frames) if numbers is None else numbers:
        rng = np.random.default_rng([*root, 1, k])
        time = shifted(start, k * CADENCE_S)
        attitude = pointed(tracker.body_from_tracker[:, 2], random_axis(rng), rng.uniform(0, 7))
        limit = wanted.rates_deg_per_s
        rates = np.round(rng.uniform(-limit, limit, 3), 7)
        position_km, velocity_km_per_s = (
            np.round(each, 4) for each in orbit_of(mission).state(time)
        )
        everything = whole_sky(sky, mission, time)
        stars = _stars(
            everything, tracker, lens, attitude, rates, time, position_km, velocity_km_per_s
        )
        counts, hits = _exposed(lens, stars, chip, wanted, rng)
        known: dict[str, Any] = {
            "batch": f"{time.text[:10]}-{k + 1:0{digits}d}",
            "time": time.text,
            "tracker": tracker.name,
            "a_priori": _a_priori(attitude, wanted.a_priori_error_deg, rng),
            "body_rates_deg_per_s": rates.tolist(),
            "velocity_km_per_s": velocity_km_per_s.tolist(),
            "position_km": position_km.tolist(),
        }
        truth = {
            "batch": known["batch"],
            "quaternion": quaternion_from_matrix(attitude).tolist(),
            "cosmic_rays": hits,
            "stars": [
                {
                    "id": everything.run.star_id[row],
                    "u_px": round(float(u), 4),
                    "v_px": round(float(v), 4),
                    "magnitude": round(float(magnitude), 4),
                }
                for row, u, v, magnitude in zip(
                    stars.row, stars.u_px, stars.v_px, stars.magnitude_mag, strict=True
                )
                if magnitude <= FAINTEST_TOLD_MAG
            ],
        }
        yield DrawnFrame(counts, camera.exposure_s, time, known, truth)


def whole_sky(sky: SkyModel, mission: Mission, time: Utc) -> RealSky:
    """All stars of the catalog, blends not merged, in magnitudes of the mission's instrument."""
    settings = RunCatalogSettings(
        magnitude_limit_mag=FAINTEST_RENDERED_MAG,
        epoch_step_years=mission.catalog.epoch_step_years,
        merge_within_arcsec=0.0,
        color_polynomial_mag=mission.run_catalog_settings.color_polynomial_mag,
    )
    epoch_year = settings.epoch_of(time.julian_year)
    run, _ = sky.cache.get(
        ("whole sky", sky.catalog.digest, settings.digest, epoch_year),
        lambda: build_run_catalog(sky.catalog, settings, epoch_year),
    )
    return real_sky(sky.catalog, settings, run)


def _stars(
    everything: RealSky,
    tracker: Tracker,
    camera: Camera,
    attitude: Matrix,
    rates_deg_per_s: Vector,
    time: Utc,
    position_km: Vector,
    velocity_km_per_s: Vector,
) -> _FrameStars:
    run = everything.run
    boresight = attitude.T @ tracker.body_from_tracker[:, 2]
    margin = float(max(MARGIN_PX, star_images.reach_px(camera)))
    beyond_deg = max(0.5, math.degrees(1.5 * margin / camera.focal_length_px))
    near = math.cos(math.radians(min(camera.corner_radius_deg + beyond_deg, 89.0)))
    row = np.flatnonzero(run.direction @ boresight >= near)
    # The light of these stars is already part of another row.
    row = row[~everything.catalog.light_elsewhere[run.catalog_row[row]]]
    direction = everything.directions(row, time, position_km)
    direction = apparent(direction, observer_velocity(time, velocity_km_per_s), time)
    u, v = camera.places(direction @ attitude.T @ tracker.body_from_tracker)
    rows, columns = camera.shape
    inside = (u > -margin) & (u < columns + margin) & (v > -margin) & (v < rows + margin)
    row, u, v = row[inside], u[inside], v[inside]
    trails = star_images.trails_px(
        camera, tracker.body_from_tracker, rates_deg_per_s, u, v, camera.exposure_s
    )
    bv_mag = everything.catalog.color_bv_mag[run.catalog_row[row]]
    bv_mag = np.where(np.isfinite(bv_mag), bv_mag, TYPICAL_BV_MAG)
    return _FrameStars(row, u, v, everything.magnitude_mag[row], bv_mag, *trails)


def _exposed(
    camera: Camera,
    stars: _FrameStars,
    chip: _Chip,
    wanted: FrameSettings,
    rng: np.random.Generator,
) -> tuple[CountArray, int]:
    """Simulated counts of one exposure, and the number of cosmic rays."""
    light_e = np.full(camera.shape, wanted.sky_e_per_s * camera.exposure_s)
    flux_e = camera.flux_counts(stars.magnitude_mag, camera.exposure_s) * camera.gain_e_per_count
    half = star_images.reach_px(camera)
    for u, v, along_u, along_v, flux, psf in zip(
        *(stars.u_px, stars.v_px, stars.trail_u_px, stars.trail_v_px),
        *(flux_e, _psfs(camera, stars.bv_mag)),
        strict=True,
    ):
        near = [reach for most_e, reach in FAINT_REACHES if flux < most_e]
        add_star(
            light_e, star_images.TrailPsf(psf, along_u, along_v), u, v, flux, min([half, *near])
        )
    light_e *= chip.response
    light_e += camera.dark_e_per_s * camera.exposure_s
    light_e.reshape(-1)[chip.hot] += chip.hot_e_per_s * camera.exposure_s
    electrons = rng.poisson(light_e).astype(np.float64)
    hits = int(rng.poisson(wanted.cosmic_rays))
    for _ in range(hits):
        _add_cosmic_ray(electrons, rng)
    electrons += rng.normal(0.0, camera.read_noise_e, electrons.shape)
    counts = np.round(electrons / camera.gain_e_per_count + camera.bias_counts)
    return np.clip(counts, 0, min(camera.saturation_counts, FULL_SCALE)).astype(np.uint16), hits


def _psfs(camera: Camera, bv_mag: Vector) -> list[Psf]:
    """Image of each star without motion; with a passband, for the star's colour."""
    if camera.psf == "gaussian" or camera.band_nm is None:
        return [star_images.still_psf(camera)] * len(bv_mag)
    images, known = star_images.psfs_of_colours(camera, DRAWN_BV_MAG), np.array(DRAWN_BV_MAG)
    bv_mag = np.clip(bv_mag, known[0], known[-1])
    redder = np.clip(np.searchsorted(known, bv_mag), 1, len(known) - 1)
    share = (bv_mag - known[redder - 1]) / (known[redder] - known[redder - 1])
    return [
        ColouredPsf(images[k - 1], images[k], part)
        for k, part in zip(redder.tolist(), share.tolist(), strict=True)
    ]


def add_star(
    light: CountArray,
    psf: star_images.TrailPsf,
    u_px: float,
    v_px: float,
    flux: float,
    half_px: int,
) -> None:
    """Add a star's image to an array of light, as far as it falls inside."""
    rows, columns = light.shape
    half_u = half_px + math.ceil(abs(psf.trail_u_px) / 2.0)
    half_v = half_px + math.ceil(abs(psf.trail_v_px) / 2.0)
    left, right = max(round(u_px) - half_u, 0), min(round(u_px) + half_u + 1, columns)
    top, bottom = max(round(v_px) - half_v, 0), min(round(v_px) + half_v + 1, rows)
    if left < right and top < bottom:
        du = np.arange(left, right)[None, :] - u_px
        dv = np.arange(top, bottom)[:, None] - v_px
        light[top:bottom, left:right] += flux * psf.pixel(du, dv)


def _add_cosmic_ray(electrons: CountArray, rng: np.random.Generator) -> None:
    """Add a straight track of uneven charge to a frame; most are a few pixels long."""
    rows, columns = electrons.shape
    length, angle = rng.exponential(4.0), rng.uniform(0.0, math.tau)
    along = np.arange(0.0, max(length, 0.5), 0.25)
    u = np.round(rng.uniform(0, columns) + along * math.cos(angle)).astype(int)
    v = np.round(rng.uniform(0, rows) + along * math.sin(angle)).astype(int)
    inside = (u >= 0) & (u < columns) & (v >= 0) & (v < rows)
    charge = rng.lognormal(math.log(400.0), 0.8, len(along))
    np.add.at(electrons, (v[inside], u[inside]), charge[inside])


def _chip(camera: Camera, wanted: FrameSettings, rng: np.random.Generator) -> _Chip:
    response = rng.normal(1.0, wanted.response_sigma, camera.shape).clip(0.0)
    hot = rng.choice(response.size, min(wanted.hot_pixels, response.size), replace=False)
    hot_e = rng.lognormal(math.log(1500.0), 1.0, len(hot))
    return _Chip(response, hot, hot_e / camera.exposure_s)


def _a_priori(
    attitude: Matrix, error_deg: float | None, rng: np.random.Generator
) -> dict[str, Any] | None:
    if error_deg is None:
        return None
    error = random_axis(rng) * math.radians(rng.uniform(0.0, error_deg))
    quaternion = np.round(quaternion_from_matrix(turned_by(attitude, error)), 10)
    return {"quaternion": quaternion.tolist(), "frame": "EME2000"}


def _require(holds: bool, name: str, message: str, value: object) -> None:
    if not holds:
        raise BadInput(Fault(name, message, shown_value(value)))


FrameWriter = Callable[[DrawnFrame, BinaryIO], None]
FrameFormat = Literal["fits", "tiff", "png", "npy"]
TRUTH = "truth.ndjson"


def write_frames(
    drawn: Iterable[DrawnFrame], folder: Path, file_format: FrameFormat = "fits"
) -> int:
    """Write an image and a JSON file for each frame, and truth.ndjson; returns their number."""
    count = 0
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with (folder / TRUTH).open("w", encoding="utf-8") as truth:
            for each in drawn:
                count += 1
                stem = f"frame-{each.known['batch']}"
                (folder / f"{stem}.{file_format}").write_bytes(frame_bytes(each, file_format))
                text = json.dumps(each.known, indent=1) + "\n"
                (folder / f"{stem}.json").write_text(text, encoding="utf-8")
                truth.write(json.dumps(each.truth, separators=(",", ":")) + "\n")
    except OSError as error:
        raise BadFile(Fault(str(folder), f"cannot be written: {error.strerror}")) from None
    return count


def frame_bytes(drawn: DrawnFrame, file_format: FrameFormat = "fits") -> bytes:
    """Encode a simulated frame as a file in a format."""
    file = io.BytesIO()
    _WRITERS[file_format](drawn, file)
    return file.getvalue()


def _fits(drawn: DrawnFrame, file: BinaryIO) -> None:
    start = shifted(drawn.time, -drawn.exposure_s / 2.0)
    cards: dict[str, bool | int | float | str] = {
        "TIMESYS": "UTC",
        "DATE-OBS": start.text.removesuffix("Z"),
        "DATE-AVG": drawn.time.text.removesuffix("Z"),
        "EXPTIME": drawn.exposure_s,
        "INSTRUME": str(drawn.known["tracker"]),
    }
    write_fits(file, drawn.counts, cards)


def _picture(file_format: str) -> FrameWriter:
    def write(drawn: DrawnFrame, file: BinaryIO) -> None:
        from PIL import Image

        Image.fromarray(drawn.counts).save(file, file_format)

    return write


def _npy(drawn: DrawnFrame, file: BinaryIO) -> None:
    np.save(file, drawn.counts)


_WRITERS: Mapping[FrameFormat, FrameWriter] = {
    "fits": _fits, "tiff": _picture("TIFF"), "png": _picture("PNG"), "npy": _npy,
}  # fmt: skip
