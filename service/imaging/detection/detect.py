"""From counts to candidates: background, threshold, detection by SEP, what is no star left out.

The search itself is that of SExtractor (Bertin & Arnouts 1996), in SEP: a mesh of
clipped medians for the background, a filter of the shape of a star's image, a
threshold in the noise behind that filter, and deblending.

The level of the background is a mesh of clipped modes, by SEP.  Where stray light leaves more
than that mesh can follow (a limb, a bright corner), medians of finer meshes are taken off too,
between which the level is linear, so that it does not swing beside a step.  The noise is
measured on what is left: a slope within a mesh is no noise, the photons of stray light are.
"""

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import sep
from scipy.ndimage import median_filter

from service.imaging.centroids.psf import GaussianPsf
from service.imaging.centroids.window import Detector
from service.imaging.detection.cosmic_rays import is_sharp, stars_behind
from service.imaging.detection.levels import count_step
from service.imaging.detection.star_images import ImageSearch, PsfAt, StarImages, psf_of
from service.imaging.frames.frame import CountArray, Frame, bad_frame
from service.missions.camera import Camera
from service.vectors import Vector, read_only

MESH_PX = 64
FINE_MESH_PX = 16
FINE_MESH_SIGMAS = 12.0
"""The least side of a fine mesh, in widths of a star's image: a star fills little of it."""
MOST_FINE_MESH_PX = 32
FINE_ROUNDS = 2
UNEVEN, UNEVEN_SHARE = 0.5, 0.005
"""In sigmas of noise, the level that stray light leaves in a coarse mesh, and the least share of
such meshes.  On even frames a few have 0.3 sigmas."""
SURE_SIGMAS = 6.0
"""A multiple of the error of a fine mesh's level."""
MEDIAN_ERROR = 1.25
"""The error of a median over that of a mean."""
MAD_SIGMAS = 1.48
CLIP_SIGMAS = 3.0
CROSSED = 1.5
"""The spread of a square over that of its neighbours from which a limb crosses it."""
CLIPPED_SHARE = 0.987
"""The standard deviation of Gaussian noise that is cut at three sigmas."""

Mask = npt.NDArray[np.bool_]


def take_background_off(
    light: CountArray, mask: Mask | None, psf_sigma_px: float, step_counts: float = 1.0
) -> tuple[CountArray, CountArray]:
    """Subtract the level from light (rows, columns) in place; returns level and noise.

    `mask` is True where a pixel holds no number.  Images of stars that are too wide for a fine
    mesh keep the coarse one.  `step_counts` is the difference of neighbouring counts.
    """
    level = sep.Background(light, mask=mask, bw=MESH_PX, bh=MESH_PX).back(dtype=light.dtype)
    light -= level
    left, noise, typical = _left(light, mask)
    uneven = np.abs(left) > UNEVEN * typical
    fine = max(FINE_MESH_PX, 8 * math.ceil(FINE_MESH_SIGMAS * psf_sigma_px / 8.0))
    fits = fine <= MOST_FINE_MESH_PX and min(light.shape) >= MESH_PX
    if fits and np.count_nonzero(uneven) > UNEVEN_SHARE * uneven.size:
        for _ in range(FINE_ROUNDS):
            level += _take_fine_off(light, mask, fine)
        noise = _noise_by_blocks(light, mask, fine, step_counts)
    # Where most pixels are equal, as in a frame cut off at its background, a count is the least
    # step.
    noise[~(noise > 0.0)] = step_counts
    return level, noise


def _left(light: CountArray, mask: Mask | None) -> tuple[CountArray, CountArray, float]:
    """The level that is left in each mesh, the noise of each pixel, and that of the whole.

    Every other pixel shows them.
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
    """Subtract the level of fine meshes where it is more than their noise; returns it."""
    blocks = _blocks(light, mask, side)
    middle = _median(blocks)
    spread = MAD_SIGMAS * _median(np.abs(blocks - middle[:, :, None]))
    # A mesh that a limb crosses has a great spread, unlike those beside it.
    noise = np.minimum(spread, median_filter(spread, 3, mode="nearest"))
    sure = np.abs(middle) > SURE_SIGMAS * MEDIAN_ERROR * noise / side
    level = _between(np.where(sure, middle, 0.0), side, light.shape).astype(light.dtype)
    light -= level
    return level


def _noise_by_blocks(
    light: CountArray, mask: Mask | None, side: int, step_counts: float
) -> CountArray:
    """One standard deviation of each pixel, from squares without what stands out in them.

    Of a square that a limb crosses the light of the limb is noise, so that no star is seen in it.
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
    """Squares (down, across, pixels); the last ones of an uneven frame reach back into it."""
    rows, columns = light.shape
    tops, lefts = _starts(rows, side), _starts(columns, side)
    if mask is not None:
        light = np.where(mask, np.nan, light)
    windows = np.lib.stride_tricks.sliding_window_view(light, (side, side))
    return np.asarray(windows[np.ix_(tops, lefts)].reshape(len(tops), len(lefts), side * side))


def _median(blocks: CountArray) -> CountArray:
    """The median of each square (down, across), of numbers alone; zero where there is none."""
    if np.isfinite(blocks[:, :, 0]).all() and not np.isnan(blocks.sum(dtype=np.float64)):
        return np.asarray(np.median(blocks, axis=2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(np.nan_to_num(np.nanmedian(blocks, axis=2)))


def _starts(length: int, side: int) -> npt.NDArray[np.intp]:
    starts = np.arange(0, length - side + 1, side)
    return np.append(starts, length - side) if length % side else starts


def _between(values: CountArray, side: int, shape: tuple[int, ...]) -> CountArray:
    """Values at the middles of squares, linear between them and beyond the outer ones."""
    down, across = (_weights(length, side) for length in shape)
    return np.asarray(down @ values @ across.T, dtype=np.float32)


def _weights(length: int, side: int) -> CountArray:
    """How much of each square's value a pixel has (pixels, squares)."""
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
"""The side of what is too wide for a star, in widths of a star's image."""
_CLOSE_PX = 6.0


@dataclass(frozen=True)
class Detections:
    """Candidates, the most light first, and what they stand on.

    `light` is the frame above its background, `background` the level below it with the
    bias taken off, `noise_counts` one standard deviation of a pixel of it.  `good` is
    False where a pixel holds no number or something sharper than a star.
    """

    light: CountArray
    background_counts: CountArray
    noise_counts: float
    good: npt.NDArray[np.bool_]
    u_px: Vector
    v_px: Vector
    flux_counts: Vector
    """The light above the threshold: somewhat less than all of it."""
    sharp_u_px: Vector
    sharp_v_px: Vector
    """Hot pixels and cosmic rays: what was found and is no star."""
    images: StarImages | None
    """The images of the brighter candidates, of a camera whose images of stars reach far."""
    image_of: npt.NDArray[np.intp]
    """The index of each candidate's image (n,); -1 where none is."""

    @property
    def count(self) -> int:
        """How many candidates there are."""
        return len(self.u_px)


def detect(frame: Frame, camera: Camera, psf_at: PsfAt | None = None) -> Detections:
    """The candidates on a frame; raises `BadFile` for one that is bright nearly everywhere.

    `psf_at` tells the images of stars that move; without it they stand still.  Only a camera
    whose images reach far needs it.
    """
    light = frame.counts - np.asarray(camera.bias_counts, dtype=frame.counts.dtype)
    known = np.isfinite(light)
    # SEP takes a mask of what to pass by; without one it is quicker.
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
            # Its supposed wings would hide faint stars all over the frame.
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
    # Light beside the brightest pixel: without it no star can be behind.
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
    """The detector with the noise that the frame itself shows beyond that of its light."""
    gain = camera.gain_e_per_count
    light = max(float(np.median(level)), 0.0)
    variance_e = (noise_counts * gain) ** 2 - light * gain
    full = min(camera.saturation_counts, frame.full_scale) - camera.bias_counts
    return Detector(gain, math.sqrt(max(variance_e, 0.0)), full)


def detection_kernel(camera: Camera) -> npt.NDArray[np.float32]:
    """The filter: the core of a star's image, pixel by pixel.

    A wider one finds no more, and fills the gap between a star and a bright neighbour.
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
    """The pixels (rows, columns) of the chosen ones of the candidates that are extracted."""
    _, segments = sep.extract(signal, err=1.0, segmentation_map=True, **_options(1.0, mask, camera))
    return np.asarray(np.isin(segments, np.flatnonzero(chosen) + 1))


def _options(
    noise: float | CountArray, mask: npt.NDArray[np.bool_] | None, camera: Camera
) -> dict[str, Any]:
    """Options of SEP: the threshold is in the noise behind the filter.

    SEP itself means the noise before it, unless it is given that of each pixel, with which it
    takes three times as long.
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
        # SEP has one exception for all: its buffers are full of bright pixels.
        raise bad_frame(f"is bright nearly everywhere: {str(error)[:100]}") from None
    return found


def _good(
    light: CountArray,
    known: npt.NDArray[np.bool_],
    noise: CountArray,
    stars: npt.NDArray[np.void],
    others: npt.NDArray[np.void],
) -> npt.NDArray[np.bool_]:
    """The pixels that may be believed: bright ones that are no star's are not."""
    good = known.copy()
    good[others["ypeak"], others["xpeak"]] = False
    # Of a track all pixels, unless a star is among them.
    tracks = others[others["npix"] > TRACK_PIXELS]
    away = np.hypot(tracks["x"][:, None] - stars["x"], tracks["y"][:, None] - stars["y"])
    for each in tracks[away.min(axis=1, initial=np.inf) > _CLOSE_PX]:
        box = slice(each["ymin"], each["ymax"] + 1), slice(each["xmin"], each["xmax"] + 1)
        good[box] &= light[box] < HOT_SIGMAS * noise[box]
    return good
