"""Stars that move while a frame is exposed: how far, and what that makes of their image."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.imaging.centroids.psf import Psf
from service.missions.camera import Camera
from service.vectors import Matrix, Vector, rotate_about

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
