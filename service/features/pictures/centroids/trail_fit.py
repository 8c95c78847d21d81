"""Trailed images of stars, along a line or an arc, and the fit of many of them at once.

While the shutter is open a star moves along a path; at mid exposure it is in the middle of the
path. The two ends of an evenly lit path give the place along the path, its whole length the place
across it.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.features.pictures.centroids.window import Array, Mask

ROUNDS = 7
MARGIN_PX = 2.0
"""Margin of pixels kept about a path, so that the path may move to the star during the fit."""
REACH_SIGMAS = 3.5
"""Largest distance of a fitted pixel from a trail's path, in sigmas of a still star's image."""
LONGEST_STEP = 0.6
"""Longest step of a trail fit, in sigmas of a still star's image."""
CONVERGED_PX = 2e-3
CHUNK_PIXELS = 1_000_000


@dataclass(frozen=True)
class TrailImage:
    """The image (a `Psf`) of a star that moves evenly along an arc, given by its chord.

    `bow_px` is the distance of the path's middle from the chord's middle, to the right of the chord
    where v points down. `sigma_px` is the width of a still star's Gaussian image, the pixel
    included. Every value may be an array, one for each star, that broadcasts.
    """

    sigma_px: float
    trail_u_px: npt.ArrayLike
    trail_v_px: npt.ArrayLike
    bow_px: npt.ArrayLike = 0.0

    @property
    def length_px(self) -> Array:
        """The length of the trail's chord, in pixels."""
        return np.maximum(np.hypot(self.trail_u_px, self.trail_v_px), 1e-6)

    @property
    def fwhm_px(self) -> float:
        """The width of a trailed image (px): still image and trail combined in quadrature."""
        spread = float(np.max(self.length_px)) / math.sqrt(12.0)
        return 2.0 * math.sqrt(2.0 * math.log(2.0)) * math.hypot(self.sigma_px, spread)

    def pixel(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> Array:
        """The share of the light on pixels (du, dv) from the star's place at mid exposure."""
        return self.with_slopes(du_px, dv_px)[0]

    def slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array]:
        """The derivatives of a pixel's share of light with respect to du and dv, per pixel."""
        _, by_u, by_v = self.with_slopes(du_px, dv_px)
        return by_u, by_v

    def with_slopes(self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike) -> tuple[Array, Array, Array]:
        """Share of the star's light on pixels, and its derivatives with respect to du and dv."""
        # Imported at the first frame: no other request needs scipy.special.
        from scipy.special import erf

        along, across, cos, sin = self.along_and_across(du_px, dv_px)
        sigma, length = self.sigma_px, self.length_px
        bend = -4.0 * np.asarray(self.bow_px) / length**2
        off = across - bend * along**2
        scale = math.sqrt(2.0) * sigma
        ends = (along + 0.5 * length) / scale, (along - 0.5 * length) / scale
        box = 0.5 * (erf(ends[0]) - erf(ends[1])) / length
        box_slope = (np.exp(-(ends[0] ** 2)) - np.exp(-(ends[1] ** 2))) / (
            math.sqrt(math.pi) * scale * length
        )
        # Where the path is oblique to its chord, a section across the chord is wider.
        slope = 2.0 * bend * along
        steep = np.sqrt(1.0 + slope**2)
        profile = np.exp(-((off / (scale * steep)) ** 2)) / (math.sqrt(math.pi) * scale * steep)
        by_across = -box * profile * off / (sigma * steep) ** 2
        by_along = box_slope * profile - slope * by_across
        value = box * profile
        return value, by_along * cos - by_across * sin, by_along * sin + by_across * cos

    def along_and_across(
        self, du_px: npt.ArrayLike, dv_px: npt.ArrayLike
    ) -> tuple[Array, Array, Array, Array]:
        """Pixels' coordinates along and across a trail's chord, and the chord's cosine and sine."""
        du, dv = np.asarray(du_px, dtype=np.float64), np.asarray(dv_px, dtype=np.float64)
        cos = np.asarray(self.trail_u_px) / self.length_px
        sin = np.asarray(self.trail_v_px) / self.length_px
        return du * cos + dv * sin, dv * cos - du * sin, cos, sin


@dataclass(frozen=True)
class TrailPlaces:
    """The places of stars (n) fitted with the images of their trails.

    `covariance` (n, 3, 3) is of u, v (pixels) and light (counts), for the stated noise.
    `chi_square` (n,) is of the residuals, over their degrees of freedom. `unexplained` is the share
    of the squared light that neither the image nor noise explains: 0 for a star that fits, 1 for
    light of another shape.
    """

    u_px: Array
    v_px: Array
    flux_counts: Array
    covariance: Array
    chi_square: Array
    unexplained: Array

    @property
    def covariance_px2(self) -> Array:
        """The covariance (n, 2, 2) of trailed stars' places along u and v.

        Light that the image does not explain, such as another trail that crosses, enlarges it.
        """
        return self.covariance[:, :2, :2] * np.maximum(self.chi_square, 1.0)[:, None, None]


@dataclass(frozen=True)
class TrailPixels:
    """The pixels about trails (n, k): place on the frame, light, variance, and which to use."""

    u_px: Array
    v_px: Array
    light: Array
    variance: Array
    usable: Mask

    @classmethod
    def about(
        cls,
        image: TrailImage,
        u_px: Array,
        v_px: Array,
        light: npt.NDArray[np.floating],
        noise: npt.NDArray[np.floating] | float,
        usable: Mask | None,
    ) -> "TrailPixels":
        """The pixels near the paths of stars (n), cut from a frame's light and noise.

        The values of `image` are of the shape (n, 1).
        """
        reach = REACH_SIGMAS * image.sigma_px + MARGIN_PX
        longest = np.maximum(np.abs(image.trail_u_px), np.abs(image.trail_v_px)).max(initial=0.0)
        half = math.ceil(0.5 * longest + float(np.abs(image.bow_px).max(initial=0.0)) + reach)
        steps = np.arange(-half, half + 1)
        square = np.broadcast_to(steps[None, :], (len(steps), len(steps))).ravel()
        across_square = np.broadcast_to(steps[:, None], (len(steps), len(steps))).ravel()
        columns = np.round(u_px).astype(np.int64)[:, None] + square
        rows = np.round(v_px).astype(np.int64)[:, None] + across_square
        height, width = light.shape
        known = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
        known &= _near(image, columns - u_px[:, None], rows - v_px[:, None], reach)
        most = int(known.sum(axis=1).max(initial=1))
        first = np.argsort(~known, axis=1, kind="stable")[:, :most]
        known, rows, columns = (np.take_along_axis(e, first, 1) for e in (known, rows, columns))
        at = np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)
        if usable is not None:
            known &= usable[at]
        sigma = noise[at] if isinstance(noise, np.ndarray) else np.full(rows.shape, noise)
        return cls(
            columns.astype(np.float64),
            rows.astype(np.float64),
            light[at].astype(np.float64),
            sigma.astype(np.float64) ** 2,
            known,
        )


def _near(image: TrailImage, du_px: Array, dv_px: Array, reach_px: float) -> Mask:
    """True for pixels (n, k) within a given distance of a trail's path."""
    along, across, *_ = image.along_and_across(du_px, dv_px)
    near = np.abs(across) < reach_px + np.abs(image.bow_px)
    return np.asarray(near & (np.abs(along) < 0.5 * image.length_px + reach_px))


def fit_trails(
    pixels: TrailPixels, image: TrailImage, u_px: Array, v_px: Array, gain_e_per_count: float
) -> TrailPlaces:
    """Least-squares places and light of stars (n) from their trails, from approximate places.

    The values of `image` are of the shape (n, 1). With an infinite gain the photon noise of the
    stars is left out.
    """
    u, v = np.array(u_px, dtype=np.float64), np.array(v_px, dtype=np.float64)
    flux = np.zeros_like(u)
    reach = REACH_SIGMAS * image.sigma_px
    for number in range(ROUNDS + 1):
        du, dv = pixels.u_px - u[:, None], pixels.v_px - v[:, None]
        value, by_u, by_v = image.with_slopes(du, dv)
        used = pixels.usable & _near(image, du, dv, reach)
        if number == 0:
            flux = _light_of(pixels.light, value, used)
        model = flux[:, None] * value
        variance = pixels.variance + np.maximum(model, 0.0) / gain_e_per_count
        weight = np.where(used, 1.0 / variance, 0.0)
        slopes = np.stack([-flux[:, None] * by_u, -flux[:, None] * by_v, value], axis=1)
        weighted = slopes * weight[:, None, :]
        normal = weighted @ slopes.transpose(0, 2, 1)
        left = pixels.light - model
        covariance = _inverse(normal)
        if number == ROUNDS:
            break
        step = np.einsum("nij,njk,nk->ni", covariance, weighted, left)
        size = np.hypot(step[:, 0], step[:, 1])
        step *= np.minimum(1.0, LONGEST_STEP * image.sigma_px / np.maximum(size, 1e-12))[:, None]
        u, v = u + step[:, 0], v + step[:, 1]
        flux = np.maximum(flux + step[:, 2], 0.1 * flux)
        if size.max(initial=0.0) < CONVERGED_PX:
            break
    count = np.maximum(used.sum(axis=1), 4)
    chi_square = (weight * left**2).sum(axis=1) / (count - 3)
    squares, noise = (np.where(used, each, 0.0).sum(axis=1) for each in (pixels.light**2, variance))
    rest = np.where(used, left**2, 0.0).sum(axis=1) - noise
    unexplained = np.clip(rest / np.maximum(squares - noise, 1e-12), 0.0, 1.0)
    return TrailPlaces(u, v, flux, covariance, chi_square, unexplained)


def _light_of(light: Array, value: Array, used: Mask) -> Array:
    """The least-squares light (n,) of trails at fixed places; positive."""
    held = np.where(used, value**2, 0.0).sum(axis=1)
    seen = np.where(used, value * light, 0.0).sum(axis=1)
    return np.asarray(np.maximum(seen / np.maximum(held, 1e-30), 1e-6))


def _inverse(normal: Array) -> Array:
    """The inverses (n, 3, 3) of normal matrices; a singular matrix gives a vague covariance."""
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-300))
    unit = normal / (scale[:, :, None] * scale[:, None, :])
    unit = unit + 1e-9 * np.eye(3)
    return np.asarray(np.linalg.inv(unit) / (scale[:, :, None] * scale[:, None, :]))
