"""The image of a star that a camera makes: still, and drawn out by the body's rates."""

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from service.imaging.centroids.psf import GaussianPsf, Psf
from service.imaging.centroids.sampled_psf import airy_psf, wired_psf
from service.imaging.detection.trail import TrailPsf, trails_px
from service.missions.camera import Camera, PsfKind, Wire
from service.missions.mission import Tracker
from service.vectors import Vector

PsfAt = Callable[[Vector, Vector], list[Psf]]
"""The image of a star at each of (n,) places of a frame."""

AIRY_OVER_SIGMA = 2.29
"""lambda f / D over the sigma of the Gaussian that is as wide at half of its height."""
REACH_OVER_AIRY = 45.0
"""How far the image of an aperture is known, in lambda f / D: two nulls of a wire of a tenth."""
LEAST_REACH_PX, MOST_REACH_PX = 48, 160
GAUSSIAN_REACH_PX = 8
CORE_SIGMAS = 3.0
SHORT_TRAIL_PX = 0.1


def reach_px(camera: Camera) -> int:
    """How far from a star its image is drawn and taken off, in whole pixels."""
    if camera.psf == "gaussian":
        return GAUSSIAN_REACH_PX
    reach = math.ceil(REACH_OVER_AIRY * AIRY_OVER_SIGMA * camera.psf_sigma_px)
    return min(max(reach, LEAST_REACH_PX), MOST_REACH_PX)


def still_psf(camera: Camera) -> Psf:
    """The image of a star that does not move; that of an aperture is kept once it is computed."""
    return _psf(camera.psf, camera.psf_sigma_px, camera.wires, reach_px(camera))


@lru_cache(maxsize=8)
def _psf(kind: PsfKind, sigma_px: float, wires: tuple[Wire, ...], reach: int) -> Psf:
    if kind == "gaussian":
        return GaussianPsf(sigma_px)
    if kind == "airy":
        return airy_psf(AIRY_OVER_SIGMA * sigma_px, reach_px=reach)
    return wired_psf(AIRY_OVER_SIGMA * sigma_px, wires, reach_px=reach)


def core_share(camera: Camera) -> float:
    """The share of a star's light that its core holds; the rest is in tails and rings."""
    if camera.psf == "gaussian":
        return 1.0
    half = math.ceil(CORE_SIGMAS * camera.psf_sigma_px)
    steps = np.arange(-half, half + 1, dtype=np.float64)
    return float(still_psf(camera).pixel(steps[None, :], steps[:, None]).sum())


def psf_of(
    camera: Camera,
    tracker: Tracker | None = None,
    rates_deg_per_s: Vector | None = None,
    exposure_s: float = 0.0,
) -> PsfAt:
    """The images of stars on a tracker whose body turns, in body axes; else they stand still."""
    still = still_psf(camera)

    def at(u_px: Vector, v_px: Vector) -> list[Psf]:
        if tracker is None or rates_deg_per_s is None:
            return [still] * len(u_px)
        along = trails_px(
            camera, tracker.body_from_tracker, rates_deg_per_s, u_px, v_px, exposure_s
        )
        return [
            TrailPsf(still, u, v) if math.hypot(u, v) > SHORT_TRAIL_PX else still
            for u, v in zip(*(each.tolist() for each in along), strict=True)
        ]

    return at
