"""What a point of light looks like on pixels: the shape that every centroid method is told.

All shapes are integrated over the pixel, hold a total light of 1, and are even
in both directions, as those of a pupil f(x, y) = f(-x, y) = f(x, -y) are
(report, eqs. 7.10 to 7.16).  Distances are in pixels, from the star to the
centre of the pixel: u along columns, v along rows.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault

Array = npt.NDArray[np.float64]


class Psf(Protocol):
    """The shape of a star's image."""

    @property
    def fwhm_px(self) -> float:
        """The full width at half of the maximum."""

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """The share of the light on pixels whose centres lie (du, dv) from the star."""

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """The derivatives of `pixel` with respect to du and dv, per pixel."""


@dataclass(frozen=True)
class GaussianPsf:
    """A round Gaussian, `sigma_px` per axis before the pixel integrates it."""

    sigma_px: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sigma_px) and self.sigma_px > 0.0):
            raise BadInput(Fault("sigma_px", "must be above zero", str(self.sigma_px)))

    @property
    def fwhm_px(self) -> float:
        """Of the Gaussian itself, without the pixel."""
        return 2.0 * math.sqrt(2.0 * math.log(2.0)) * self.sigma_px

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """See `Psf`."""
        return self._share(du_px) * self._share(dv_px)

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """See `Psf`."""
        in_u, in_v = self._share(du_px), self._share(dv_px)
        return self._share_slope(du_px) * in_v, in_u * self._share_slope(dv_px)

    def _share(self, distance_px: npt.ArrayLike) -> Array:
        # Loaded with the first frame: nothing else that is served asks for it.
        from scipy.special import erf

        x = np.asarray(distance_px, dtype=np.float64)
        scale = math.sqrt(2.0) * self.sigma_px
        return np.asarray(0.5 * (erf((x + 0.5) / scale) - erf((x - 0.5) / scale)))

    def _share_slope(self, distance_px: npt.ArrayLike) -> Array:
        x = np.asarray(distance_px, dtype=np.float64)
        scale = math.sqrt(2.0) * self.sigma_px
        outer, inner = np.exp(-(((x + 0.5) / scale) ** 2)), np.exp(-(((x - 0.5) / scale) ** 2))
        return np.asarray((outer - inner) / (math.sqrt(math.pi) * scale))
