"""From counts to candidates: background, threshold, detection by SEP, what is no star left out.

The search itself is that of SExtractor (Bertin & Arnouts 1996), in SEP: a mesh of
clipped medians for the background, a filter of the shape of a star's image, a
threshold in the noise behind that filter, and deblending.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import sep

from service.imaging.centroids.psf import GaussianPsf
from service.imaging.centroids.window import Detector
from service.imaging.detection.background import take_background_off
from service.imaging.detection.cosmic_rays import is_sharp, stars_behind
from service.imaging.detection.star_image import PsfAt, psf_of
from service.imaging.detection.star_images import ImageSearch, StarImages
from service.imaging.frames.frame import CountArray, Frame, bad_frame
from service.missions.camera import Camera
from service.vectors import Vector, read_only

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
    level, noise_map = take_background_off(light, mask, camera.psf_sigma_px)
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
