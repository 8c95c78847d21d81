"""Point spread functions integrated over pixels: a Gaussian, or a sampled image.

scipy is imported by the functions that need it: most processes never evaluate one.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.features.pictures.centroids.optics import behind_wires, disc, image_at

LEAST_SAMPLES_PER_PX = 3


# All shapes are integrated over the pixel, hold a total light of 1, and are even
# in both directions, as those of a pupil f(x, y) = f(-x, y) = f(x, -y) are
# (report, eqs. 7.10 to 7.16).  Distances are in pixels, from the star to the
# centre of the pixel: u along columns, v along rows.

Array = npt.NDArray[np.float64]


class Psf(Protocol):
    """The shape of a star's image (point spread function), integrated over pixels."""

    @property
    def fwhm_px(self) -> float:
        """The full width of a star's image at half of its maximum, in pixels."""

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """Share of the star's light on pixels whose centres lie (du, dv) pixels from the star."""

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """The derivatives of the pixels' share of light with respect to du and dv, per pixel."""


@dataclass(frozen=True)
class GaussianPsf:
    """A round Gaussian star image; `sigma_px` per axis, before integration over the pixel."""

    sigma_px: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.sigma_px) and self.sigma_px > 0.0):
            raise BadInput(Fault("sigma_px", "must be above zero", str(self.sigma_px)))

    @property
    def fwhm_px(self) -> float:
        """The full width at half maximum of a Gaussian image, before integration over the pixel."""
        return 2.0 * math.sqrt(2.0 * math.log(2.0)) * self.sigma_px

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """The share of the light on pixels at (du, dv) from the star; see `Psf`."""
        return self._share(du_px) * self._share(dv_px)

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """The derivatives of a pixel's share of light with respect to du and dv; see `Psf`."""
        in_u, in_v = self._share(du_px), self._share(dv_px)
        return self._share_slope(du_px) * in_v, in_u * self._share_slope(dv_px)

    def _share(self, distance_px: npt.ArrayLike) -> Array:
        from scipy.special import erf

        x = np.asarray(distance_px, dtype=np.float64)
        scale = math.sqrt(2.0) * self.sigma_px
        return np.asarray(0.5 * (erf((x + 0.5) / scale) - erf((x - 0.5) / scale)))

    def _share_slope(self, distance_px: npt.ArrayLike) -> Array:
        x = np.asarray(distance_px, dtype=np.float64)
        scale = math.sqrt(2.0) * self.sigma_px
        outer, inner = np.exp(-(((x + 0.5) / scale) ** 2)), np.exp(-(((x - 0.5) / scale) ** 2))
        return np.asarray((outer - inner) / (math.sqrt(math.pi) * scale))


@dataclass(frozen=True)
class SampledPsf:
    """The shape of an image that was computed on a grid finer than the pixels.

    `image` is odd in both directions, the star in its middle, and should be even; `total` is the
    light in all directions, also outside the image, in the units of the image's sum; by default no
    light is outside. `jitter_px` is the sigma of a Gaussian that smears the image.
    """

    image: Array = field(repr=False)
    samples_per_px: float
    total: float | None = None
    jitter_px: float = 0.0

    def __post_init__(self) -> None:
        rows, columns = self.image.shape
        if rows % 2 == 0 or columns % 2 == 0:
            raise BadInput(
                Fault("image", "must be odd, the star in its middle", f"{rows, columns}")
            )
        if self.samples_per_px < LEAST_SAMPLES_PER_PX:
            raise BadInput(
                Fault(
                    "samples_per_px",
                    f"must be at least {LEAST_SAMPLES_PER_PX}",
                    str(self.samples_per_px),
                )
            )

    @cached_property
    def fwhm_px(self) -> float:
        """Full width at half of the peak along u in pixels, before integration over the pixel."""
        middle = self.image.shape[1] // 2
        along = self.image[self.image.shape[0] // 2, middle:] / self.image.max()
        first = int(np.argmax(along < 0.5))
        whole = first - 1 + (along[first - 1] - 0.5) / (along[first - 1] - along[first])
        return 2.0 * float(whole) / self.samples_per_px

    @cached_property
    def reach_px(self) -> tuple[float, float]:
        """Largest distances along u and v (px) at which a star's sampled image is known."""
        rows, columns = self.image.shape
        return (columns // 2) / self.samples_per_px - 0.5, (rows // 2) / self.samples_per_px - 0.5

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import RectBivariateSpline
        from scipy.ndimage import gaussian_filter

        rows, columns = self.image.shape
        fine = self.image / (self.image.sum() if self.total is None else self.total)
        if self.jitter_px > 0.0:
            fine = gaussian_filter(fine, self.jitter_px * self.samples_per_px, mode="constant")
        # The pixel is a box; its transform is exact for any number of samples per pixel.
        box = np.outer(
            np.sinc(np.fft.fftfreq(rows) * self.samples_per_px),
            np.sinc(np.fft.rfftfreq(columns) * self.samples_per_px),
        )
        share = np.fft.irfft2(np.fft.rfft2(fine) * box, s=fine.shape) * self.samples_per_px**2
        v = np.arange(-(rows // 2), rows // 2 + 1) / self.samples_per_px
        u = np.arange(-(columns // 2), columns // 2 + 1) / self.samples_per_px
        return RectBivariateSpline(v, u, share, kx=3, ky=3)

    @cached_property
    def _slopes(self) -> tuple[Any, Any]:
        """Splines of an image's derivatives along u and v, cached for repeated calls."""
        return self._spline.partial_derivative(0, 1), self._spline.partial_derivative(1, 0)

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """The share of the light on pixels at (du, dv) from the star; see `psf.Psf`."""
        return self._at(self._spline, du_px, dv_px)

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """The derivatives of a pixel's share of light with respect to du and dv; see `psf.Psf`."""
        along_u, along_v = self._slopes
        return self._at(along_u, du_px, dv_px), self._at(along_v, du_px, dv_px)

    def _at(self, spline: Any, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        u, v = np.asarray(du_px, dtype=np.float64), np.asarray(dv_px, dtype=np.float64)
        known = (np.abs(u) <= self.reach_px[0]) & (np.abs(v) <= self.reach_px[1])
        if _is_raster(u, v):
            # Evaluation on a grid is twenty times as fast as point by point.
            found = spline(v[:, 0], u[0], grid=True)
        else:
            found = spline(*np.broadcast_arrays(v, u), grid=False)
        return np.where(known, found, 0.0)


def _is_raster(u: Array, v: Array) -> bool:
    """True if the places form a grid: rising columns (1, n) and rising rows (m, 1)."""
    if u.ndim != 2 or v.ndim != 2 or u.shape[0] != 1 or v.shape[1] != 1:
        return False
    return bool(np.all(np.diff(u[0]) > 0.0) and np.all(np.diff(v[:, 0]) > 0.0))


def psfs_in_colours(shortest: SampledPsf, longer: Array, weights: Array) -> list[SampledPsf]:
    """Images (m) of stars in light of many colours, made from the image at the shortest wavelength.

    An aperture's image grows with the wavelength: those of the colours, `longer` (n,) times as long
    as the shortest, are summed with the `weights` (m, n), which are shares of photons, to m images.
    """
    from scipy.interpolate import RectBivariateSpline

    rows, columns = shortest.image.shape
    v = np.arange(-(rows // 2), rows // 2 + 1, dtype=np.float64)
    u = np.arange(-(columns // 2), columns // 2 + 1, dtype=np.float64)
    spline = RectBivariateSpline(v, u, shortest.image, kx=5, ky=5)
    images = np.zeros((len(weights), rows, columns))
    for ratio, shares in zip(longer.tolist(), weights.T, strict=True):
        images += shares[:, None, None] * spline(v / ratio, u / ratio, grid=True) / ratio**2
    return [
        SampledPsf(image, shortest.samples_per_px, shortest.total, shortest.jitter_px)
        for image in images
    ]


@dataclass(frozen=True)
class ColouredPsf:
    """A star's image in its own colour, mixed from the images of a blue and a red star."""

    blue: Psf
    red: Psf
    red_share: float = 0.5
    """Share of the red star's image; below 0 for stars bluer than blue, above 1 for redder ones."""

    @property
    def fwhm_px(self) -> float:
        """The full width at half maximum in pixels, mixed from the widths of both images."""
        return (1.0 - self.red_share) * self.blue.fwhm_px + self.red_share * self.red.fwhm_px

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """The share of the light on pixels at (du, dv) from the star; see `Psf`."""
        blue, red = self.blue.pixel(du_px, dv_px), self.red.pixel(du_px, dv_px)
        return (1.0 - self.red_share) * blue + self.red_share * red

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """The derivatives of a pixel's share of light with respect to du and dv; see `Psf`."""
        (blue_u, blue_v), (red_u, red_v) = (
            each.slopes(du_px, dv_px) for each in (self.blue, self.red)
        )
        share = self.red_share
        return (1.0 - share) * blue_u + share * red_u, (1.0 - share) * blue_v + share * red_v


def airy_psf(
    lambda_over_d_px: float,
    obscuration: float = 0.0,
    reach_px: int = 24,
    jitter_px: float = 0.0,
) -> SampledPsf:
    """The Airy pattern of a clear or centrally obscured circular aperture in one colour.

    `lambda_over_d_px` is lambda f / D in pixels; `obscuration` the dark share of the
    diameter.  [A(q) - e² A(e q)]² / (1 - e²)² with A(q) = 2 J1(q) / q.
    """
    from scipy.special import j1

    if not 0.0 <= obscuration < 1.0:
        raise BadInput(Fault("obscuration", "must be from 0 to below 1", str(obscuration)))
    if not lambda_over_d_px > 0.0:
        raise BadInput(Fault("lambda_over_d_px", "must be above zero", str(lambda_over_d_px)))
    samples = max(LEAST_SAMPLES_PER_PX + 1, math.ceil(6.0 / lambda_over_d_px))
    place = np.arange(-reach_px * samples, reach_px * samples + 1) / samples
    q = math.pi * np.hypot(place[None, :], place[:, None]) / lambda_over_d_px

    def amplitude(x: Array) -> Array:
        return np.where(x == 0.0, 1.0, 2.0 * j1(x) / np.where(x == 0.0, 1.0, x))

    ring = 1.0 - obscuration**2
    image = ((amplitude(q) - obscuration**2 * amplitude(obscuration * q)) / ring) ** 2
    # Total light over the whole plane: the open area, by Parseval.
    total = 4.0 / math.pi * (lambda_over_d_px * samples) ** 2 / ring
    return SampledPsf(image, samples, total, jitter_px)


def wired_psf(
    lambda_over_d_px: float,
    wires: Sequence[tuple[float, float, float]],
    reach_px: int = 48,
    cells_across: int = 512,
) -> SampledPsf:
    """The diffraction image of a round aperture behind straight wires, in light of one colour.

    `lambda_over_d_px` is lambda f / D of the aperture without wires; each wire is (direction along
    the wire, deg from u towards v; offset and width in diameters of the aperture), as in a
    `Camera`.
    """
    clear = disc(cells_across, 1.0 / cells_across, 0.5)
    pupil = behind_wires(clear, [(math.radians(d), offset, width) for d, offset, width in wires])
    samples = max(LEAST_SAMPLES_PER_PX + 1, math.ceil(6.0 / lambda_over_d_px))
    # With a diameter of one metre, a wavelength of one metre is an angle of one radian.
    step_rad = 1.0 / (lambda_over_d_px * samples)
    reach = reach_px * samples
    angle = np.arange(-reach, reach + 1, dtype=np.float64) * step_rad
    intensity = image_at(pupil, 1.0, angle, angle)
    return SampledPsf(intensity, samples, pupil.open_area_m2 / step_rad**2)
