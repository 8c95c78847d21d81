"""Detection of star candidates in a frame: background, threshold, SEP, hot pixels.

The search is SExtractor's (Bertin & Arnouts 1996), in SEP: a mesh of clipped medians for the
background, a filter of the shape of a star's image, a threshold in the noise behind that filter,
and deblending.

The level of the background is a mesh of clipped modes, by SEP. Where stray light (a limb, a bright
corner) varies faster than that mesh can follow, medians of finer meshes are subtracted too, with
linear interpolation, so that the level does not overshoot beside a step. The noise is measured on
the residual: a slope within a mesh is no noise, the photons of stray light are.
"""

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import sep
from scipy.ndimage import median_filter

from service.features.pictures.centroids.psf import GaussianPsf
from service.features.pictures.centroids.window import Detector
from service.features.pictures.detection.cosmic_rays import is_sharp, stars_behind
from service.features.pictures.detection.levels import count_step
from service.features.pictures.detection.star_images import ImageSearch, PsfAt, StarImages, psf_of
from service.features.pictures.frames.frame import CountArray, Frame, bad_frame
from service.missions.camera import Camera
from service.vectors import Vector, read_only

MESH_PX = 64
FINE_MESH_PX = 16
FINE_MESH_SIGMAS = 12.0
"""Least side of a fine background mesh, in widths of a star's image."""
MOST_FINE_MESH_PX = 32
UNEVEN, UNEVEN_SHARE = 0.5, 0.005
"""Residual level of a coarse mesh, in sigmas of noise, that is taken for stray light, and the least
share of such meshes that starts the fine meshes. On even frames a few meshes have 0.3 sigmas.
"""
SURE_SIGMAS = 6.0
"""Least level of a fine mesh that is subtracted, in multiples of its own error."""
MEDIAN_ERROR = 1.25
"""Ratio of the standard error of a median to that of a mean."""
MAD_SIGMAS = 1.48
CLIP_SIGMAS = 3.0
CROSSED = 1.5
"""Ratio of a square's spread to that of its neighbours above which a limb crosses the square."""
CLIPPED_SHARE = 0.987
"""Standard deviation of unit Gaussian noise after clipping at three sigmas."""

Mask = npt.NDArray[np.bool_]


def take_background_off(
    light: CountArray, mask: Mask | None, psf_sigma_px: float, step_counts: float = 1.0
) -> tuple[CountArray, CountArray]:
    """Subtract the background from light (rows, columns) in place; returns level and noise.

    `mask` is True where a pixel holds no number. If images of stars are too wide for a fine mesh,
    only the coarse mesh is subtracted. `step_counts` is the difference of neighbouring counts.
    """
    level = sep.Background(light, mask=mask, bw=MESH_PX, bh=MESH_PX).back(dtype=light.dtype)
    light -= level
    left, noise, typical = _left(light, mask)
    uneven = np.abs(left) > UNEVEN * typical
    fine = max(FINE_MESH_PX, 8 * math.ceil(FINE_MESH_SIGMAS * psf_sigma_px / 8.0))
    fits = fine <= MOST_FINE_MESH_PX and min(light.shape) >= MESH_PX
    if fits and np.count_nonzero(uneven) > UNEVEN_SHARE * uneven.size:
        for _ in range(2):
            level += _take_fine_off(light, mask, fine)
        noise = _noise_by_blocks(light, mask, fine, step_counts)
    # Where most pixels are equal, as in a frame clipped at its background, the noise is set to one
    # count step.
    noise[~(noise > 0.0)] = step_counts
    return level, noise


def _left(light: CountArray, mask: Mask | None) -> tuple[CountArray, CountArray, float]:
    """Background left in each coarse mesh of a frame, noise of each pixel, noise of the frame.

    Computed from every other pixel.
    """
    coarse = np.ascontiguousarray(light[::2, ::2])
    hidden = None if mask is None else np.ascontiguousarray(mask[::2, ::2])
    half = MESH_PX // 2
    found = sep.Background(coarse, mask=hidden, bw=half, bh=half)
    left = found.back(dtype=light.dtype)[half // 2 :: half, half // 2 :: half]
    noise = np.repeat(np.repeat(found.rms(dtype=light.dtype), 2, axis=0), 2, axis=1)
    rows, columns = light.shape
    return left, np.ascontiguousarray(noise[:rows, :columns]), float(found.globalrms)


def _take_fine_off(light: CountArray, mask: Mask | None, side: int) -> CountArray:
    """Subtract the level of fine meshes where it is significant; returns the subtracted level."""
    blocks = _blocks(light, mask, side)
    middle = _median(blocks)
    spread = MAD_SIGMAS * _median(np.abs(blocks - middle[:, :, None]))
    # A mesh that a limb crosses has a larger spread than its neighbours.
    noise = np.minimum(spread, median_filter(spread, 3, mode="nearest"))
    sure = np.abs(middle) > SURE_SIGMAS * MEDIAN_ERROR * noise / side
    level = _between(np.where(sure, middle, 0.0), side, light.shape).astype(light.dtype)
    light -= level
    return level


def _noise_by_blocks(
    light: CountArray, mask: Mask | None, side: int, step_counts: float
) -> CountArray:
    """One standard deviation of the noise of each pixel, from clipped squares of the frame.

    In a square that a limb crosses, the limb's light counts as noise, so that no star is detected
    there.
    """
    blocks = _blocks(light, mask, side)
    away = np.abs(blocks - _median(blocks)[:, :, None])
    sigma = np.maximum(MAD_SIGMAS * _median(away), 0.5 * step_counts)
    squares = away**2
    for _ in range(2):
        kept = away < CLIP_SIGMAS * sigma[:, :, None]
        total = np.sum(squares, axis=2, where=kept)
        mean = total / np.maximum(np.count_nonzero(kept, axis=2), 1)
        sigma = np.maximum(np.sqrt(mean) / CLIPPED_SHARE, 0.3 * step_counts)
    smooth = median_filter(sigma, 3, mode="nearest")
    crossed = sigma > CROSSED * smooth
    return _between(np.where(crossed, sigma, smooth), side, light.shape).astype(light.dtype)


def _blocks(light: CountArray, mask: Mask | None, side: int) -> CountArray:
    """Squares of a frame (down, across, pixels); the last ones may overlap their neighbours."""
    rows, columns = light.shape
    tops, lefts = _starts(rows, side), _starts(columns, side)
    if mask is not None:
        light = np.where(mask, np.nan, light)
    windows = np.lib.stride_tricks.sliding_window_view(light, (side, side))
    return np.asarray(windows[np.ix_(tops, lefts)].reshape(len(tops), len(lefts), side * side))


def _median(blocks: CountArray) -> CountArray:
    """The median of each square (down, across) over its finite numbers; zero without any."""
    if np.isfinite(blocks[:, :, 0]).all() and not np.isnan(blocks.sum(dtype=np.float64)):
        return np.asarray(np.median(blocks, axis=2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(np.nan_to_num(np.nanmedian(blocks, axis=2)))


def _starts(length: int, side: int) -> npt.NDArray[np.intp]:
    starts = np.arange(0, length - side + 1, side)
    return np.append(starts, length - side) if length % side else starts


def _between(values: CountArray, side: int, shape: tuple[int, ...]) -> CountArray:
    """Values at the middles of squares, interpolated linearly (and extrapolated) to pixels."""
    down, across = (_weights(length, side) for length in shape)
    return np.asarray(down @ values @ across.T, dtype=np.float32)


def _weights(length: int, side: int) -> CountArray:
    """Linear interpolation weights (pixels, squares) of squares' values along one axis."""
    middles = _starts(length, side) + 0.5 * (side - 1)
    at = np.arange(length, dtype=np.float64)
    place = np.clip(np.searchsorted(middles, at) - 1, 0, max(len(middles) - 2, 0))
    weights = np.zeros((length, len(middles)))
    if len(middles) == 1:
        weights[:, 0] = 1.0
        return weights
    share = (at - middles[place]) / (middles[place + 1] - middles[place])
    rows = np.arange(length)
    weights[rows, place] = 1.0 - share
    weights[rows, place + 1] = share
    return weights


LEAST_PIXELS = 3
DEBLEND_LEVELS, DEBLEND_CONTRAST = 32, 0.005
HOT_SIGMAS = 5.0
TRACK_PIXELS = 9
BEHIND_SIGMAS = 15.0
EXTENDED_SIGMAS = 60.0
"""Largest side of a star candidate, in widths of a star's image; a wider one is an extended
source.
"""
_CLOSE_PX = 6.0


@dataclass(frozen=True)
class Detections:
    """The star candidates of a frame, those with the most light first, with background and noise.

    `light` is the frame above its background, `background_counts` that background without the bias,
    `noise_counts` one standard deviation of a pixel of `light`. `good` is False where a pixel holds
    no number or is part of a hot pixel or cosmic ray.
    """

    light: CountArray
    background_counts: CountArray
    noise_counts: float
    good: npt.NDArray[np.bool_]
    u_px: Vector
    v_px: Vector
    flux_counts: Vector
    """The light of each candidate above the threshold: somewhat less than its total."""
    sharp_u_px: Vector
    sharp_v_px: Vector
    """Places of hot pixels and cosmic rays: detections that are not stars."""
    images: StarImages | None
    """The subtracted images of bright stars, for a camera whose PSF reaches far; else None."""
    image_of: npt.NDArray[np.intp]
    """The index of each candidate's image (n,); -1 for a candidate without one."""

    @property
    def count(self) -> int:
        """The number of candidates."""
        return len(self.u_px)


def detect(frame: Frame, camera: Camera, psf_at: PsfAt | None = None) -> Detections:
    """Star candidates on a frame; raises `BadFile` for a frame that is bright nearly everywhere.

    `psf_at` gives the images of moving stars; by default stars stand still. Only a camera whose
    images reach far needs it.
    """
    light = frame.counts - np.asarray(camera.bias_counts, dtype=frame.counts.dtype)
    known = np.isfinite(light)
    # SEP takes a mask of pixels to ignore; without a mask it is faster.
    mask = None if known.all() else ~known
    if mask is not None:
        light[mask] = 0.0
    step_counts = count_step(frame.counts)
    level, noise_map = take_background_off(light, mask, camera.psf_sigma_px, step_counts)
    noise = float(np.median(noise_map[::8, ::8]))
    if camera.psf == "gaussian":
        images, left = None, light
        signal = light / noise_map
        found = _extracted(signal, 1.0, mask, camera)
        wide = found["npix"] > (EXTENDED_SIGMAS * camera.psf_sigma_px) ** 2
        if wide.any():
            # The wings that SEP assumes for an extended source would hide faint stars all over the
            # frame.
            known &= ~_footprint(signal, mask, camera, wide)
            mask = ~known
            found = _extracted(signal, 1.0, mask, camera)
        for name in ("flux", "peak"):
            found[name] *= noise_map[found["ypeak"], found["xpeak"]]
    else:
        detector = detector_of(frame, level, noise, camera)
        search = ImageSearch(
            light, level, noise, mask, detector, camera, psf_at or psf_of(camera), _extracted
        )
        images, found, left = search.taken_off()
    u, v = found["x"].astype(np.float64), found["y"].astype(np.float64)
    sharp = is_sharp(left, u, v, camera.psf_sigma_px)
    good = _good(left, known, noise_map, found[~sharp], found[sharp])
    # A star can be behind a hot pixel only if there is light beside the brightest pixel.
    local = noise_map[found["ypeak"], found["xpeak"]]
    dense = sharp & (found["flux"] - found["peak"] > BEHIND_SIGMAS * local)
    behind = stars_behind(left, u[dense], v[dense], camera.psf_sigma_px, local[dense])
    good[behind.hot_v_px, behind.hot_u_px] = False
    stars = np.concatenate(
        [
            np.stack([found[name][~sharp] for name in ("x", "y", "flux")]),
            np.stack([behind.u_px, behind.v_px, behind.flux_counts]),
            np.empty((3, 0)) if images is None else images.places_and_light(),
        ],
        axis=1,
    )
    order = np.argsort(-stars[2], kind="stable")
    u_px, v_px, flux = stars[:, order]
    without_image = stars.shape[1] - (0 if images is None else len(images.stars))
    return Detections(
        light=light,
        background_counts=level,
        noise_counts=noise,
        good=good,
        u_px=read_only(u_px),
        v_px=read_only(v_px),
        flux_counts=read_only(flux),
        sharp_u_px=read_only(u[sharp]),
        sharp_v_px=read_only(v[sharp]),
        images=images,
        image_of=read_only(np.maximum(order - without_image, -1)),
    )


def detector_of(frame: Frame, level: CountArray, noise_counts: float, camera: Camera) -> Detector:
    """The detector of a camera, with readout noise from the frame's noise beyond photon noise."""
    gain = camera.gain_e_per_count
    light = max(float(np.median(level)), 0.0)
    variance_e = (noise_counts * gain) ** 2 - light * gain
    full = min(camera.saturation_counts, frame.full_scale) - camera.bias_counts
    return Detector(gain, math.sqrt(max(variance_e, 0.0)), full)


def detection_kernel(camera: Camera) -> npt.NDArray[np.float32]:
    """The convolution kernel for detection: the core of a star's image on whole pixels.

    A wider kernel finds no more stars, and fills the gap between a star and a bright neighbour.
    """
    half = max(1, round(1.2 * camera.psf_sigma_px))
    steps = np.arange(-half, half + 1, dtype=np.float64)
    image = GaussianPsf(camera.psf_sigma_px).pixel(steps[None, :], steps[:, None])
    return np.asarray(image, dtype=np.float32)


def _footprint(
    signal: CountArray,
    mask: npt.NDArray[np.bool_] | None,
    camera: Camera,
    chosen: npt.NDArray[np.bool_],
) -> npt.NDArray[np.bool_]:
    """The pixels (rows, columns) covered by chosen candidates of an extraction."""
    _, segments = sep.extract(signal, err=1.0, segmentation_map=True, **_options(1.0, mask, camera))
    return np.asarray(np.isin(segments, np.flatnonzero(chosen) + 1))


def _options(
    noise: float | CountArray, mask: npt.NDArray[np.bool_] | None, camera: Camera
) -> dict[str, Any]:
    """Options of an extraction by SEP, with the threshold in the noise of the filtered image.

    SEP itself takes the noise before the filter, unless it has a noise map, with which it takes
    three times as long.
    """
    kernel = detection_kernel(camera)
    is_map = np.ndim(noise) > 0
    share = 1.0 if is_map else float(np.sqrt((kernel**2).sum()) / np.abs(kernel).sum())
    return {
        "thresh": share * camera.threshold_sigma,
        "mask": mask,
        "minarea": LEAST_PIXELS,
        "filter_kernel": kernel,
        "deblend_nthresh": DEBLEND_LEVELS,
        "deblend_cont": DEBLEND_CONTRAST,
    }


def _extracted(
    light: CountArray,
    noise: float | CountArray,
    mask: npt.NDArray[np.bool_] | None,
    camera: Camera,
) -> npt.NDArray[np.void]:
    try:
        found: npt.NDArray[np.void] = sep.extract(light, err=noise, **_options(noise, mask, camera))
    except Exception as error:
        # SEP raises one plain exception: its buffers are full of bright pixels.
        raise bad_frame(f"is bright nearly everywhere: {str(error)[:100]}") from None
    return found


def _good(
    light: CountArray,
    known: npt.NDArray[np.bool_],
    noise: CountArray,
    stars: npt.NDArray[np.void],
    others: npt.NDArray[np.void],
) -> npt.NDArray[np.bool_]:
    """True for pixels usable for stars: finite, and no part of hot pixels, cosmic rays, tracks."""
    good = known.copy()
    good[others["ypeak"], others["xpeak"]] = False
    # All pixels of a track are masked, unless a star is among them.
    tracks = others[others["npix"] > TRACK_PIXELS]
    away = np.hypot(tracks["x"][:, None] - stars["x"], tracks["y"][:, None] - stars["y"])
    for each in tracks[away.min(axis=1, initial=np.inf) > _CLOSE_PX]:
        box = slice(each["ymin"], each["ymax"] + 1), slice(each["xmin"], each["xmax"] + 1)
        good[box] &= light[box] < HOT_SIGMAS * noise[box]
    return good
