"""The position of a star on the sensor, by any of four methods that give the same record.

| method | what it is | report |
|---|---|---|
| `window` | first moment of a square | 7.2 to 7.5, over all scan lines |
| `scan` | first moments of one row and one column | 7.4, 7.21, 7.22 |
| `matched` | the best fit of the star's shape, by the noise of each pixel | III |
| `recursive` | the same from one pixel after another, re-centred | VI |

Two methods are sums: the cross-scan of the report (7.4, 7.5), and the sum over a whole window.

A sum over a square is a scan whose samples are the sums of its columns, and then
of its rows; both methods are one moment of two profiles.  The displacement comes
back with a plus sign: the report writes the image as Phi(u + a), whose star stands at
-a, and drops that minus in 7.4 to 7.6 and 7.17 to 7.22, while its section 7.6 has the
other sign.  The correction that centres the star is minus the displacement.
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from scipy.ndimage import correlate

from service.errors import BadInput, Fault
from service.features.pictures.centroids import shape_fit
from service.features.pictures.centroids.psf import Psf
from service.features.pictures.centroids.sequential import diffuse
from service.features.pictures.centroids.shape_fit import Fit, fit
from service.features.pictures.centroids.window import (
    Array,
    CentroidRecord,
    Flag,
    Region,
    Window,
    brightest_pixel,
    refusal,
    square_about,
    symmetric_square_about,
    too_faint,
)
from service.observations.scans.lines import BREAKDOWN_RATIO, ProfileMoment, moment

MOST_SHARE = 0.9
SLOPE_LEAST = 0.2
"""Least slope of a moment against the star's place: less means outside the image's core."""


def profiles(square: Array, method: str) -> tuple[Array, Array]:
    """Sums of a square's columns and of its rows, or for a scan its middle row and column."""
    if method == "scan":
        middle = square.shape[0] // 2
        return square[middle, :], square[:, middle]
    return square.sum(axis=0), square.sum(axis=1)


def by_moments(
    window: Window,
    method: str,
    psf: Psf | None,
    start: tuple[int, int],
    half_width_px: int,
    recentre: bool,
) -> CentroidRecord:
    """The centroid of a star from first moments of a square or of its middle row and column.

    See `centroid` for the arguments. Every pixel of the sum is needed: a full, masked or missing
    one refuses the star. Near the edge the square shrinks, to stay symmetric about the star.
    """
    column, row = start
    for iterations in range(1, 11):
        region = symmetric_square_about(window, column, row, half_width_px)
        if region is None:
            # Only a window cut by the edge of the frame leaves no room for a square.
            return refusal(method, "too close to the edge of the window", (Flag.EDGE,))
        flags = region.flags(half_width_px)
        along = _moments(region, method)
        needed = _needed(region, method)
        if not needed:
            full = Flag.SATURATED in flags
            why = f"a {'saturated' if full else 'masked'} pixel lies in the sum"
            return refusal(method, why, flags, iterations=iterations)
        faintest = min(along, key=lambda each: each.signal_ratio)
        if not faintest.signal_ratio >= BREAKDOWN_RATIO:
            return too_faint(method, faintest.total, math.sqrt(faintest.total_variance), flags)
        moves = [round(each.displacement) for each in along]
        # A shift of less than a pixel may be noise; the present square serves as well as the next.
        if not recentre or all(abs(each.displacement) <= 1.0 for each in along):
            return _record(region, method, psf, along, flags, iterations)
        column, row = column + moves[0], row + moves[1]
    return refusal(method, "the window follows no star", (Flag.NOT_CONVERGED,))


def _moments(region: Region, method: str) -> tuple[ProfileMoment, ProfileMoment]:
    gain = region.window.detector.gain_e_per_count
    # Photon noise from the counts themselves: a linear sum with this variance is unbiased.
    variance = region.floor_variance + region.light / gain
    lights, variances = profiles(region.light, method), profiles(variance, method)
    floors = profiles(region.floor_variance, method)
    pixels = 1 if method == "scan" else 2 * region.left + 1
    level = region.window.background_sigma_counts * pixels
    return (
        moment(lights[0], np.maximum(variances[0], floors[0]), level),
        moment(lights[1], np.maximum(variances[1], floors[1]), level),
    )


def _needed(region: Region, method: str) -> bool:
    usable = region.usable
    if method == "scan":
        return bool(usable[region.above, :].all() and usable[:, region.left].all())
    return bool(usable.all())


def _record(
    region: Region,
    method: str,
    psf: Psf | None,
    along: tuple[ProfileMoment, ProfileMoment],
    flags: tuple[Flag, ...],
    iterations: int,
) -> CentroidRecord:
    measured = along[0].displacement, along[1].displacement
    sigmas = [math.sqrt(each.variance) for each in along]
    flux = float(region.light.sum())
    gain = region.window.detector.gain_e_per_count
    flux_variance = float(region.floor_variance.sum()) + max(flux, 0.0) / gain
    flux_variance += (region.window.background_sigma_counts * region.light.size) ** 2
    if psf is None:
        place = measured
        shares = [_share_beyond(profile) for profile in profiles(region.light, method)]
        bias = [-d * share / (1.0 - share) for share, d in zip(shares, measured, strict=True)]
        if any(abs(b) > s for b, s in zip(bias, sigmas, strict=True)):
            flags = (*flags, Flag.TRUNCATED)
        held = 1.0
    else:
        found = star_behind(region, method, psf, measured)
        if found is None:
            why = "the star stands outside the hump that the window sees"
            return refusal(method, why, (*flags, Flag.OUTSIDE), iterations=iterations)
        place, slopes, held = found
        bias = [d - p for d, p in zip(measured, place, strict=True)]
        sigmas = [sigma / slope for sigma, slope in zip(sigmas, slopes, strict=True)]
        # The star is subtracted at its corrected place: at a less precise one the residual would
        # look like another star.
        at = region.column + place[0], region.row + place[1]
        best = fit(region.window, psf, at, region.left)
        if best is not None and is_blended(best, psf):
            flags = (*flags, Flag.BLENDED)
    return CentroidRecord(
        method=method,
        u_px=region.window.corner_u_px + region.column + place[0],
        v_px=region.window.corner_v_px + region.row + place[1],
        sigma_u_px=sigmas[0],
        sigma_v_px=sigmas[1],
        correlation_uv=0.0,
        flux_counts=flux / held,
        sigma_flux_counts=math.sqrt(flux_variance) / held,
        signal_ratio=min(each.signal_ratio for each in along),
        truncation_u_px=bias[0],
        truncation_v_px=bias[1],
        iterations=iterations,
        flags=flags,
    )


def _share_beyond(profile: Array) -> float:
    """Relative error of a displacement by a scan that is cut off, from the light at its ends.

    The samples cover -V ... V, where V lies half a step beyond the last sample.
    """
    ends = 1.5 * float(profile[0] + profile[-1]) - 0.5 * float(profile[1] + profile[-2])
    return min(max(len(profile) * ends / 2.0 / float(profile.sum()), 0.0), MOST_SHARE)


def star_behind(
    region: Region, method: str, psf: Psf, measured: tuple[float, float]
) -> tuple[tuple[float, float], tuple[float, float], float] | None:
    """The place (u, v) whose modelled image has the measured moments, the slopes of the moments,
    and the share of light in the square.

    This corrects a moment for truncation and sampling. None where the moments hardly depend on the
    place: the star is outside the image's core.
    """
    place, steps = measured, region.du[0]
    for _ in range(8):
        du, dv = region.du - place[0], region.dv - place[1]
        image = psf.pixel(du, dv)
        u_slope, v_slope = psf.slopes(du, dv)
        expected, slopes = [], []
        for axis, changes in enumerate((u_slope, v_slope)):
            samples, change = profiles(image, method)[axis], profiles(changes, method)[axis]
            total = float(samples.sum())
            if not total > 0.0:
                return None
            mean = float(steps @ samples) / total
            expected.append(mean)
            # The derivative with respect to the star's place is minus the derivative with respect
            # to the pixel's.
            slopes.append((mean * float(change.sum()) - float(steps @ change)) / total)
        if min(slopes) < SLOPE_LEAST:
            return None
        step = [(m - e) / s for m, e, s in zip(measured, expected, slopes, strict=True)]
        place = place[0] + step[0], place[1] + step[1]
        if max(abs(place[0]), abs(place[1])) > region.left:
            return None
        if max(map(abs, step)) < 1e-6:
            break
    return place, (slopes[0], slopes[1]), float(image.sum())


BLEND_SIGMAS = 4.0
BLEND_SHARE = 0.01
"""Signal to noise, and share of the star's light, above which a second star is reported."""


def is_blended(found: Fit, psf: Psf) -> bool:
    """True if pixels hold light beside the star that its shape does not explain.

    The model of the star at its best place is subtracted; then each pixel is tried as the place
    of a second star of the same shape.
    """
    region = found.region
    du, dv = region.du - (found.u_px - region.column), region.dv - (found.v_px - region.row)
    model = found.flux_counts * psf.pixel(du, dv)
    gain = region.window.detector.gain_e_per_count
    variance = region.floor_variance + np.maximum(model, 0.0) / gain
    weight = np.zeros_like(variance)
    np.divide(1.0, variance, out=weight, where=region.usable & (variance > 0.0))
    near = np.arange(-2.0, 3.0)
    kernel = psf.pixel(near[None, :], near[:, None])
    summed = correlate((region.light - model) * weight, kernel, mode="constant")
    against = correlate(weight, kernel**2, mode="constant")
    weighted = against > 0.0
    second = summed[weighted] / against[weighted]
    above = summed[weighted] / np.sqrt(against[weighted])
    shown = (above > BLEND_SIGMAS) & (second > BLEND_SHARE * found.flux_counts)
    return bool(np.any(shown))


Method = Literal["window", "scan", "matched", "recursive"]
METHODS: Sequence[Method] = ("window", "scan", "matched", "recursive")


def centroid(
    window: Window,
    method: Method = "matched",
    psf: Psf | None = None,
    start: tuple[float, float] | None = None,
    half_width_px: int = 4,
    recentre: bool = True,
) -> CentroidRecord:
    """The position of the star in a window by one of four methods, with predicted sigmas and flags.

    `start` is (u, v) in pixels of the frame, by default the brightest 3 x 3 pixels. `half_width_px`
    bounds the square that is summed about the star; it moves with the star unless `recentre` is
    false. `matched` and `recursive` need the `psf`; for the other two methods it corrects their
    moments for what lies outside the square, and flags the light of another star. Saturated and
    masked pixels refuse a moment and are left out of a fit.

    A star that cannot be located gives a record with the reason in `refused`. Raises `BadInput` for
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
) -> CentroidRecord:
    """The centroid record of a fitted star, or of a failed fit with the reason in words."""
    if found is None:
        return refusal(method, "the shape fits no light of this window", (Flag.OUTSIDE,))
    flags = found.region.flags(half_width_px)
    flux, sigma = found.flux_counts, math.sqrt(found.covariance[2, 2])
    if not found.signal_ratio >= BREAKDOWN_RATIO:
        return too_faint(method, flux, sigma, flags)
    if not found.converged:
        flags = (*flags, Flag.NOT_CONVERGED)
    if is_blended(found, psf):
        flags = (*flags, Flag.BLENDED)
    sigma_u, sigma_v = math.sqrt(found.covariance[0, 0]), math.sqrt(found.covariance[1, 1])
    return CentroidRecord(
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
"""Initial sigmas of the recursive fit, in multiples of the window's width and of its light."""


def recursive_fit(
    window: Window, psf: Psf, start: tuple[float, float], half_width_px: int, recentre: bool = True
) -> shape_fit.Fit | None:
    """A star fitted pixel by pixel, in passes until its place converges; None if it is lost.

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
