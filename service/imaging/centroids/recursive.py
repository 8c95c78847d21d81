"""The recursive centroid: the sequential estimator of part VI on the pixels of a window.

The report expands the image to second order about the presumed place, which biases
any offset that is not small against the hump.  Here each pass uses the slopes of the
true shape at the place that the pass before found, so that what the expansion
neglects goes to zero with the offset.
"""

import math

from service.imaging.centroids.psf import Psf
from service.imaging.centroids.region import square_about
from service.imaging.centroids.sequential import diffuse
from service.imaging.centroids.shape_fit import (
    ENOUGH_SIGMAS,
    FARTHEST_IN_HALF_WIDTHS,
    MOVE_BEYOND_PX,
    Fit,
    first_flux,
    linearised,
    stepped,
    with_level_error,
)
from service.imaging.centroids.window import Window

MOST_PASSES = 30
VAGUE = 100.0
"""The start is this many times vaguer than a window's width and its light."""


def recursive_fit(
    window: Window, psf: Psf, start: tuple[float, float], half_width_px: int, recentre: bool = True
) -> Fit | None:
    """Passes over the pixels, each one point at a time, until the place stays; None without light.

    With `recentre` false there is one pass: the report's own form.
    """
    u, v = start
    region = square_about(window, round(u), round(v), half_width_px)
    if region is None:
        return None
    flux = first_flux(region, psf, u, v)
    passes, converged = 0, False
    while not converged and passes < MOST_PASSES:
        passes += 1
        seen = linearised(region, psf, u, v, flux)
        vague = VAGUE * half_width_px
        start_of_pass = diffuse((vague, vague, VAGUE * flux))
        estimate = start_of_pass.replayed(seen.rows, seen.left, seen.variance)
        converged = not recentre or seen.sigmas_of(estimate.state) < ENOUGH_SIGMAS
        u, v, flux = stepped(u, v, flux, estimate.state)
        if math.hypot(u - start[0], v - start[1]) > FARTHEST_IN_HALF_WIDTHS * half_width_px:
            return None
        if recentre and max(abs(u - region.column), abs(v - region.row)) > MOVE_BEYOND_PX:
            moved = square_about(window, round(u), round(v), half_width_px)
            if moved is None:
                return None
            region = moved
    covariance = with_level_error(estimate.covariance, seen, window.background_sigma_counts)
    return Fit(u, v, flux, covariance, region, passes, converged)
