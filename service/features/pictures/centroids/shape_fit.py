"""The matched centroid: the zero of the derivative of the correlation with the star's shape.

The report locates by the peak of a correlation, or by the zero of the correlation with the
derivative (part III). Weighted by the noise of each pixel, the second is the condition of maximum
likelihood, and its slope is the Fisher information: the predicted sigmas are the Cramér-Rao bound.
Gauss-Newton steps solve for the zero; the square of pixels moves with the star.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from service.features.pictures.centroids.psf import ColouredPsf, Psf
from service.features.pictures.centroids.window import Array, Mask, Region, Window, square_about

MOST_STEPS = 30
ENOUGH_SIGMAS = 0.01
"""Convergence limit: largest last step of a fit, in sigmas of its place."""
LONGEST_STEP_PX = 0.7
MOVE_BEYOND_PX = 0.75
"""Distance of a star from the middle of its square at which the square moves; above half a pixel,
so that a star between two pixels does not move the square to and fro.
"""
FARTHEST_IN_HALF_WIDTHS = 2.0


@dataclass(frozen=True)
class Fit:
    """The best-fitting place (pixels of the window) and light of a star's shape, with covariance.

    `covariance` is of (u, v, light) and includes the error of the background level.
    """

    u_px: float
    v_px: float
    flux_counts: float
    covariance: Array
    region: Region
    steps: int
    converged: bool

    @property
    def signal_ratio(self) -> float:
        """The ratio of the star's fitted light to its own sigma."""
        return self.flux_counts / math.sqrt(self.covariance[2, 2])


@dataclass(frozen=True)
class Linearised:
    """A star's image linearised about a presumed place and light, on the pixels of a square.

    `good` are the pixels used; `rows` (n, 3) are the changes with u, v and light; `left` is the
    residual light; `variance` per pixel is computed from the model, since the noisy counts would
    favour pixels that happened to be low.
    """

    good: Mask
    rows: Array
    left: Array
    variance: Array

    def sigmas_of(self, step: Array) -> float:
        """The length of a fit's step in its own standard deviations."""
        return math.sqrt(float(((self.rows @ step) ** 2 / self.variance).sum()))


def linearised(region: Region, psf: Psf, u_px: float, v_px: float, flux: float) -> Linearised:
    """The image of a star linearised about a presumed place (u, v) in pixels of the window."""
    du, dv = region.du - (u_px - region.column), region.dv - (v_px - region.row)
    image = psf.pixel(du, dv)
    u_slope, v_slope = psf.slopes(du, dv)
    model = flux * image
    variance = region.floor_variance + (
        np.maximum(model, 0.0) / region.window.detector.gain_e_per_count
    )
    good = region.usable & (variance > 0.0)
    rows = np.stack([-flux * u_slope[good], -flux * v_slope[good], image[good]], axis=1)
    return Linearised(good, rows, (region.light - model)[good], variance[good])


def first_flux(region: Region, psf: Psf, u_px: float, v_px: float) -> float:
    """The first estimate of a star's light at a presumed place, from the sum of the usable pixels.

    Where that sum is not positive, the estimate is its noise; the first step then finds the light.
    """
    image = psf.pixel(region.du - (u_px - region.column), region.dv - (v_px - region.row))
    held = float(image[region.usable].sum())
    light = float(region.light.sum())
    noise = math.sqrt(float(region.floor_variance.sum())) or 1.0
    return light / held if held > 0.0 and light > 0.0 else noise


def fit(
    window: Window, psf: Psf, start: tuple[float, float], half_width_px: int, recentre: bool = True
) -> Fit | None:
    """The fit of a star's place and light by Gauss-Newton from a start; None if it fails."""
    u, v = start
    region = square_about(window, round(u), round(v), half_width_px)
    if region is None:
        return None
    flux = first_flux(region, psf, u, v)
    taken, converged = 0, False
    while not converged and taken < MOST_STEPS:
        taken += 1
        seen = linearised(region, psf, u, v, flux)
        step = _solve(seen)
        if step is None:
            return None
        converged = seen.sigmas_of(step) < ENOUGH_SIGMAS
        u, v, flux = stepped(u, v, flux, step)
        moved = region_after_step(window, region, (u, v), start, half_width_px, recentre)
        if moved is None:
            return None
        region = moved
    seen = linearised(region, psf, u, v, flux)
    covariance = _covariance(seen, window.background_sigma_counts)
    if covariance is None:
        return None
    return Fit(u, v, flux, covariance, region, taken, converged)


TYPICAL_RED_SHARE, RED_SHARE_SIGMA = 0.5, 0.4
"""Mean and sigma of star colours down to V 9, as the red image's share in a mixture."""
LEAST_RED_SHARE, MOST_RED_SHARE = -0.2, 1.3
"""Least and largest colours of single stars, as red shares: bluer or redder light is blended."""


def fit_in_its_colour(
    window: Window, psf: Psf, start: tuple[float, float], half_width_px: int
) -> tuple[Fit | None, Psf]:
    """The best fit of a star, or None, with a PSF of the star's own measured colour, and that PSF.

    The known distribution of star colours is used as a prior. Images of all colours are even and
    their slopes odd, so that an error of the colour hardly moves the star.
    """
    found = fit(window, psf, start, half_width_px)
    if found is None or not isinstance(psf, ColouredPsf):
        return found, psf
    region, flux = found.region, found.flux_counts
    seen = linearised(region, psf, found.u_px, found.v_px, flux)
    du, dv = region.du - (found.u_px - region.column), region.dv - (found.v_px - region.row)
    redder = psf.red.pixel(du, dv) - psf.blue.pixel(du, dv)
    rows = np.column_stack([seen.rows, flux * redder[seen.good]])
    weighted = rows / seen.variance[:, None]
    normal, right = weighted.T @ rows, weighted.T @ seen.left
    normal[3, 3] += RED_SHARE_SIGMA**-2
    right[3] += (TYPICAL_RED_SHARE - psf.red_share) * RED_SHARE_SIGMA**-2
    try:
        share = psf.red_share + float(np.linalg.solve(normal, right)[3])
    except np.linalg.LinAlgError:
        return found, psf
    own = replace(psf, red_share=min(max(share, LEAST_RED_SHARE), MOST_RED_SHARE))
    return fit(window, own, (found.u_px, found.v_px), half_width_px), own


def region_after_step(
    window: Window,
    region: Region,
    place: tuple[float, float],
    start: tuple[float, float],
    half_width_px: int,
    recentre: bool,
) -> Region | None:
    """The square of pixels for a fit's next step: moved where the star is far from the middle.

    None where the place is too far from the start, or its square is outside the window.
    """
    u, v = place
    if math.hypot(u - start[0], v - start[1]) > FARTHEST_IN_HALF_WIDTHS * half_width_px:
        return None
    if recentre and max(abs(u - region.column), abs(v - region.row)) > MOVE_BEYOND_PX:
        return square_about(window, round(u), round(v), half_width_px)
    return region


def stepped(u: float, v: float, flux: float, step: Array) -> tuple[float, float, float]:
    """The star's place and light after one step of a fit, shortened to stay in the linear range."""
    length = math.hypot(step[0], step[1])
    shorten = min(1.0, LONGEST_STEP_PX / length) if length > 0.0 else 1.0
    # Light cannot be negative; a star that fades during the steps is refused as too faint at the
    # end.
    flux = max(flux + shorten * float(step[2]), 0.1 * flux)
    return u + shorten * float(step[0]), v + shorten * float(step[1]), flux


def _solve(seen: Linearised) -> Array | None:
    weighted = seen.rows / seen.variance[:, None]
    normal: Array = weighted.T @ seen.rows
    try:
        return np.asarray(np.linalg.solve(normal, weighted.T @ seen.left))
    except np.linalg.LinAlgError:
        return None


def _covariance(seen: Linearised, level_sigma: float) -> Array | None:
    weighted = seen.rows / seen.variance[:, None]
    try:
        covariance: Array = np.asarray(np.linalg.inv(weighted.T @ seen.rows), dtype=np.float64)
    except np.linalg.LinAlgError:
        return None
    return with_level_error(covariance, seen, level_sigma)


def with_level_error(covariance: Array, seen: Linearised, level_sigma: float) -> Array:
    """Covariance of a fit, enlarged by an error of the background level common to all pixels."""
    response = covariance @ (seen.rows / seen.variance[:, None]).sum(axis=0)
    return np.asarray(covariance + level_sigma**2 * np.outer(response, response))
