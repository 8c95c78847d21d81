"""Where a star stands on the sensor, by any of four methods that give the same record.

| method | what it is | report |
|---|---|---|
| `window` | first moment of a square | 7.2 to 7.5, over all scan lines |
| `scan` | first moments of one row and one column | 7.4, 7.21, 7.22 |
| `matched` | the best fit of the star's shape, by the noise of each pixel | III |
| `recursive` | the same from one pixel after another, re-centred | VI |
"""

import math
from collections.abc import Sequence
from typing import Literal

from service.errors import BadInput, Fault
from service.imaging.centroids import record, shape_fit
from service.imaging.centroids.moments import by_moments, is_blended
from service.imaging.centroids.psf import Psf
from service.imaging.centroids.sequential import diffuse
from service.imaging.centroids.window import Window, brightest_pixel, square_about
from service.observations.scans.lines import BREAKDOWN_RATIO

Method = Literal["window", "scan", "matched", "recursive"]
METHODS: Sequence[Method] = ("window", "scan", "matched", "recursive")
DEFAULT_HALF_WIDTH_PX = 4


def centroid(
    window: Window,
    method: Method = "matched",
    psf: Psf | None = None,
    start: tuple[float, float] | None = None,
    half_width_px: int = DEFAULT_HALF_WIDTH_PX,
    recentre: bool = True,
) -> record.CentroidRecord:
    """The place of the star in a window, with predicted sigmas and flags.

    `start` is (u, v) in pixels of the frame, by default the brightest 3 x 3 pixels.
    `half_width_px` bounds the square that is summed about the star; it moves with the
    star unless `recentre` is false.  `matched` and `recursive` need the `psf`; given to the
    other two, it corrects their moments for what lies outside the square, and flags the
    light of another star.  Saturated and masked pixels refuse a moment and are left out of
    a fit.

    Light that allows no place gives a record that says why.  Raises `BadInput` for
    arguments that make no sense.
    """
    if method not in METHODS:
        raise BadInput(Fault("method", f"must be one of {', '.join(METHODS)}", repr(method)))
    if half_width_px < 1:
        raise BadInput(Fault("half_width_px", "must be at least 1", str(half_width_px)))
    column, row = _start(window, start)
    if method in ("window", "scan"):
        middle = round(column), round(row)
        return by_moments(window, method, psf, middle, half_width_px, recentre)
    if psf is None:
        raise BadInput(Fault("psf", f"is needed by the method {method}"))
    way = shape_fit.fit if method == "matched" else recursive_fit
    found = way(window, psf, (column, row), half_width_px, recentre)
    return record_of(method, found, psf, half_width_px, window)


def _start(window: Window, start: tuple[float, float] | None) -> tuple[float, float]:
    if start is None:
        return brightest_pixel(window)
    if not all(map(math.isfinite, start)):
        raise BadInput(Fault("start", "must be finite", str(start)))
    return start[0] - window.corner_u_px, start[1] - window.corner_v_px


def record_of(
    method: str, found: shape_fit.Fit | None, psf: Psf, half_width_px: int, window: Window
) -> record.CentroidRecord:
    """The record of a fit, or its refusal in words."""
    if found is None:
        return record.refusal(
            method, "the shape fits no light of this window", (record.Flag.OUTSIDE,)
        )
    flags = found.region.flags(half_width_px)
    flux, sigma = found.flux_counts, math.sqrt(found.covariance[2, 2])
    if not found.signal_ratio >= BREAKDOWN_RATIO:
        return record.too_faint(method, flux, sigma, flags)
    if not found.converged:
        flags = (*flags, record.Flag.NOT_CONVERGED)
    if is_blended(found, psf):
        flags = (*flags, record.Flag.BLENDED)
    sigma_u, sigma_v = math.sqrt(found.covariance[0, 0]), math.sqrt(found.covariance[1, 1])
    return record.CentroidRecord(
        method=method,
        u_px=window.corner_u_px + found.u_px,
        v_px=window.corner_v_px + found.v_px,
        sigma_u_px=sigma_u,
        sigma_v_px=sigma_v,
        correlation_uv=float(found.covariance[0, 1]) / (sigma_u * sigma_v),
        flux_counts=flux,
        sigma_flux_counts=sigma,
        signal_ratio=found.signal_ratio,
        iterations=found.steps,
        flags=flags,
    )


MOST_PASSES = 30
VAGUE = 100.0
"""The start is this many times vaguer than a window's width and its light."""


def recursive_fit(
    window: Window, psf: Psf, start: tuple[float, float], half_width_px: int, recentre: bool = True
) -> shape_fit.Fit | None:
    """Passes over the pixels, each one point at a time, until the place stays; None without light.

    With `recentre` false there is one pass: the report's own form.
    """
    u, v = start
    region = square_about(window, round(u), round(v), half_width_px)
    if region is None:
        return None
    flux = shape_fit.first_flux(region, psf, u, v)
    passes, converged = 0, False
    while not converged and passes < MOST_PASSES:
        passes += 1
        seen = shape_fit.linearised(region, psf, u, v, flux)
        vague = VAGUE * half_width_px
        start_of_pass = diffuse((vague, vague, VAGUE * flux))
        estimate = start_of_pass.replayed(seen.rows, seen.left, seen.variance)
        converged = not recentre or seen.sigmas_of(estimate.state) < shape_fit.ENOUGH_SIGMAS
        u, v, flux = shape_fit.stepped(u, v, flux, estimate.state)
        moved = shape_fit.region_after_step(window, region, (u, v), start, half_width_px, recentre)
        if moved is None:
            return None
        region = moved
    covariance = shape_fit.with_level_error(
        estimate.covariance, seen, window.background_sigma_counts
    )
    return shape_fit.Fit(u, v, flux, covariance, region, passes, converged)
