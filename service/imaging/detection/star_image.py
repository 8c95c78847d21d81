"""The image of a star that a camera makes: still, and drawn out by the body's rates."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from service.imaging.centroids.psf import (
    ColouredPsf,
    GaussianPsf,
    Psf,
    SampledPsf,
    airy_psf,
    psfs_in_colours,
    wired_psf,
)
from service.imaging.optics import thermal
from service.missions.camera import Camera, PsfKind, Wire
from service.missions.mission import Tracker
from service.vectors import Matrix, Vector, rotate_about

PsfAt = Callable[[Vector, Vector], list[Psf]]
"""The image of a star at each of (n,) places of a frame."""

AIRY_OVER_SIGMA = 2.29
"""lambda f / D over the sigma of the Gaussian that is as wide at half of its height."""
REACH_OVER_AIRY = 45.0
"""How far the image of an aperture is known, in lambda f / D: two nulls of a wire of a tenth."""
LEAST_REACH_PX, MOST_REACH_PX = 48, 160
GAUSSIAN_REACH_PX = 8
CORE_SIGMAS = 3.0
COLOURS = 61
"""Wavelengths that a band is summed over."""
BLUE_BV_MAG, RED_BV_MAG = -0.2, 1.6
"""Colour indices of the two stars that the images of all others are mixed of."""
SHORT_TRAIL_PX = 0.1


def reach_px(camera: Camera) -> int:
    """How far from a star its image is drawn and taken off, in whole pixels."""
    if camera.psf == "gaussian":
        return GAUSSIAN_REACH_PX
    reach = math.ceil(REACH_OVER_AIRY * AIRY_OVER_SIGMA * camera.psf_sigma_px)
    return min(max(reach, LEAST_REACH_PX), MOST_REACH_PX)


def still_psf(camera: Camera) -> Psf:
    """The image of a star that does not move; that of an aperture is kept once it is computed."""
    if camera.psf != "gaussian" and camera.band_nm is not None:
        blue, red = psfs_of_colours(camera, (BLUE_BV_MAG, RED_BV_MAG))
        return ColouredPsf(blue, red)
    return _psf(camera.psf, camera.psf_sigma_px, camera.wires, reach_px(camera))


def psfs_of_colours(camera: Camera, bv_mag: tuple[float, ...]) -> Sequence[Psf]:
    """The still images of stars of some colour indices B-V, in the band of a camera.

    Stars shine as black bodies (Ballesteros 2012), the detector counts photons.
    """
    assert camera.band_nm is not None
    return _psfs(
        camera.psf, camera.psf_sigma_px, camera.wires, reach_px(camera), camera.band_nm, bv_mag
    )


@lru_cache(maxsize=8)
def _psfs(
    kind: PsfKind,
    sigma_px: float,
    wires: tuple[Wire, ...],
    reach: int,
    band_nm: tuple[float, float],
    bv_mag: tuple[float, ...],
) -> Sequence[Psf]:
    shortest, longest = band_nm
    weights = []
    for bv in bv_mag:
        heat_k = 4600.0 * (1.0 / (0.92 * bv + 1.7) + 1.0 / (0.92 * bv + 0.62))
        light = thermal(heat_k, shortest * 1e-9, longest * 1e-9, COLOURS)
        photons = light.power * light.wavelength_m
        weights.append(photons / photons.sum())
    sharpest_px = sigma_px * shortest / (0.5 * (shortest + longest))
    sharpest = _psf(kind, sharpest_px, wires, reach)
    assert isinstance(sharpest, SampledPsf)
    return psfs_in_colours(sharpest, light.wavelength_m * 1e9 / shortest, np.array(weights))


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
            _drawn_out(still, u, v) if math.hypot(u, v) > SHORT_TRAIL_PX else still
            for u, v in zip(*(each.tolist() for each in along), strict=True)
        ]

    return at


Array = npt.NDArray[np.float64]

STEP_PX = 0.3
"""A trail of steps this short differs from a smooth one by less than a thousandth of its peak."""
MOST_STEPS = 400


@dataclass(frozen=True)
class TrailPsf:
    """A star's image drawn out evenly along (`trail_u_px`, `trail_v_px`), about its middle."""

    psf: Psf
    trail_u_px: float
    trail_v_px: float

    @property
    def fwhm_px(self) -> float:
        """That of the still image with the trail's length, as standard deviations add."""
        # An even stretch of length l has the variance l^2 / 12.
        spread = math.hypot(self.trail_u_px, self.trail_v_px) / math.sqrt(12.0)
        return math.hypot(self.psf.fwhm_px, 2.0 * math.sqrt(2.0 * math.log(2.0)) * spread)

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """See `Psf`."""
        du, dv = np.asarray(du_px, dtype=np.float64), np.asarray(dv_px, dtype=np.float64)
        parts = [self.psf.pixel(du - u, dv - v) for u, v in self._steps()]
        return np.asarray(sum(parts[1:], parts[0]) / len(parts))

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """See `Psf`."""
        du, dv = np.asarray(du_px, dtype=np.float64), np.asarray(dv_px, dtype=np.float64)
        parts = [self.psf.slopes(du - u, dv - v) for u, v in self._steps()]
        along_u, along_v = (np.stack(each).mean(axis=0) for each in zip(*parts, strict=True))
        return along_u, along_v

    def _steps(self) -> list[tuple[float, float]]:
        length = math.hypot(self.trail_u_px, self.trail_v_px)
        count = min(MOST_STEPS, max(1, math.ceil(length / STEP_PX)))
        return [
            (self.trail_u_px * share, self.trail_v_px * share)
            for share in ((k + 0.5) / count - 0.5 for k in range(count))
        ]


def _drawn_out(psf: Psf, u_px: float, v_px: float) -> Psf:
    """The image with a trail; that of a band stays one of two colours."""
    if isinstance(psf, ColouredPsf):
        blue, red = TrailPsf(psf.blue, u_px, v_px), TrailPsf(psf.red, u_px, v_px)
        return replace(psf, blue=blue, red=red)
    return TrailPsf(psf, u_px, v_px)


def trails_px(
    camera: Camera,
    body_from_tracker: Matrix,
    rates_deg_per_s: Vector,
    u_px: Vector,
    v_px: Vector,
    exposure_s: float,
) -> tuple[Vector, Vector]:
    """How far (n,) along u and v stars move over an exposure of a turning body.

    Places are those of mid exposure; rates are of the body relative to inertial, in
    body axes, in which a star that stands still moves with -w x v.
    """
    turn = np.radians(rates_deg_per_s) @ body_from_tracker * (exposure_s / 2.0)
    middle = camera.directions(u_px, v_px)
    begin_u, begin_v = camera.places(rotate_about(turn, middle))
    end_u, end_v = camera.places(rotate_about(-turn, middle))
    return end_u - begin_u, end_v - begin_v
