"""The image of a star that a camera makes: still, and drawn out by the body's rates."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from service.imaging.centroids.psf import GaussianPsf, Psf, airy_psf, wired_psf
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
