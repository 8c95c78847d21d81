"""Detection of points of light in a picture from an unknown camera, by signal to noise alone.

The picture is filtered with the image of a star minus its surroundings, so that objects wider than
a star (a tree, the Moon, a cloud, the horizon) leave little signal; each place is compared with the
local noise of the filtered picture.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
import sep
from scipy import fft

from service.features.pictures.detection.clipped import FLANK_PX, ClippedStars, clipped_stars
from service.features.pictures.detection.levels import count_step, levels_of
from service.features.pictures.detection.trails import (
    CLEAR_RATIO,
    MOST_UNEXPLAINED,
    Trails,
    find_trails,
    may_trail,
    measured_trails,
    placed_trails,
    twin_distance_px,
)
from service.features.pictures.frames.frame import CountArray, Frame, bad_frame
from service.vectors import Matrix, Vector, read_only

MESH_PX = 32
GUESSED_PSF_PX = 1.2
"""Sigma of a star's image assumed in the first detection, which measures the actual width."""
LIKE_PSF = 1.35
"""Largest ratio of assumed to actual image width at which a filter loses hardly any signal."""
LEAST_PSF_PX, MOST_PSF_PX = 0.7, 5.0
SURROUND = 3.0
"""Width of the subtracted surroundings in the filter, in widths of a star's image."""
FILTER_REACH = 4.0
"""Radius at which the detection filter ends, in widths of its subtracted surroundings."""
STRIP_ROWS = 256
MAX_WORKING_PIXELS = 4_000_000
"""Largest number of pixels processed unbinned; binning makes star images narrower."""
MAX_POINTS = 300
FIRST_THRESHOLD, SECOND_THRESHOLD = 5.0, 3.5
FULL_SHARE = 0.9
"""Share of the largest count above which a peak may be clipped, so that its width is unknown."""
HOT_SHARE = 0.25
"""Least ratio of the light of the four neighbours to that of the brightest pixel for a star:
reached by images with a sigma of a third of a pixel or more.
"""
PLACE_NOISE = 1.34
"""Error of a place times the signal to noise, in widths of a star's image.

The theoretical least is the root of 2, for a filter with the image of a star alone; the subtracted
surroundings take 5 % off the signal to noise.
"""
TRAIL_PEAKS, TRAIL_WEIGHT_PX, TRAIL_ROUNDS = 30, 3.0, 2
"""Number of the clearest peaks, width of the weight, and centroid rounds, used to detect trails."""
_LEAST_SIGMA_PX = 0.01
"""Least standard deviation of a place: the pixels of a sensor are no more even than that."""


@dataclass(frozen=True)
class PointSources:
    """Candidates for stars (n) in a picture, clearest first, and the background-subtracted picture.

    Places are in pixels of the picture, the centre of its first being (0, 0);
    `covariance_px2` (n, 2, 2) is that of each place along u and v.
    `signal_ratio` is the ratio of the filtered light to the local noise. `light` is the picture
    above its background, binned by `binning` a side.
    """

    u_px: Vector
    v_px: Vector
    covariance_px2: Matrix
    signal_ratio: Vector
    flux_counts: Vector
    psf_sigma_px: float
    noise_counts: float
    background_counts: float
    clipped_share: float
    """Share of pixels at the lowest count: a large share means that the background was clipped."""
    light: CountArray
    binning: int
    width_px: int
    height_px: int
    hot_pixels: int = 0
    """The number of single bright pixels, which no star makes."""
    clipped_stars: int = 0
    """The number of stars clipped at the largest count, first among candidates; see `clipped`."""
    trail_px: float | None = None
    """The typical length of star trails in pixels; None for stars that do not trail."""
    trailed: str | None = None
    """The reason why places at mid exposure cannot be told for trailing stars; None if they can."""

    @cached_property
    def sigma_px(self) -> Vector:
        """One standard deviation (n,) per axis: the root of the mean of both variances."""
        return read_only(np.sqrt(0.5 * np.trace(self.covariance_px2, axis1=1, axis2=2)))

    @property
    def count(self) -> int:
        """The number of candidates."""
        return len(self.u_px)

    def mirrored(self, by_rows: bool) -> "PointSources":
        """The candidates on the picture with its rows, or else its columns, in reverse order."""
        covariance = read_only(self.covariance_px2 * np.array([[1.0, -1.0], [-1.0, 1.0]]))
        if by_rows:
            v_px = read_only(self.height_px - 1 - self.v_px)
            return replace(self, v_px=v_px, covariance_px2=covariance, light=self.light[::-1])
        u_px = read_only(self.width_px - 1 - self.u_px)
        return replace(self, u_px=u_px, covariance_px2=covariance, light=self.light[:, ::-1])


def find_points(
    counts: CountArray, threshold: float = FIRST_THRESHOLD, keep_hot: bool = False
) -> PointSources:
    """The star candidates on a picture (rows, columns); the image width is measured first.

    Single bright pixels are hot pixels, not stars, and are left out unless `keep_hot`.
    """
    height, width = counts.shape
    binning = max(1, math.ceil(math.sqrt(counts.size / MAX_WORKING_PIXELS)))
    levels = levels_of(counts)
    working = _filled(_binned(levels.scaled(counts), binning))
    # The mean of several counts has finer steps.
    step = levels.step_counts * levels.factor / binning
    background = sep.Background(working, bw=MESH_PX, bh=MESH_PX)
    light = working
    background.subfrom(light)
    peaks = _peaks(light, GUESSED_PSF_PX, threshold, step)
    hot = _is_hot(light, *peaks[:2])
    if hot.any() and not keep_hot:
        _fill(light, peaks[0][hot], peaks[1][hot])
        peaks = _peaks(light, GUESSED_PSF_PX, threshold, step)
    noise_counts = max(float(background.globalrms), step / math.sqrt(12.0))
    trails = _trails(light, noise_counts, *peaks)
    discs: ClippedStars | None = None
    if trails is None:
        psf = _measured_psf(light, *peaks)
        if not 1.0 / LIKE_PSF < psf / GUESSED_PSF_PX < LIKE_PSF:
            peaks = _peaks(light, psf, threshold, step)
        discs = clipped_stars(light)
        if discs is not None:
            outside = discs.are_outside(*peaks[:2])
            u, v, ratio = peaks
            peaks = u[outside], v[outside], ratio[outside]
        places = _still_places(light, psf, *peaks)
        if discs is not None:
            places = _behind(discs, places, noise_counts)
    else:
        psf = trails.sigma_px
        places = _middles_of_trails(light, noise_counts, trails, threshold)
    offset, unit = 0.5 * (binning - 1), 1.0 / levels.factor
    if not levels.is_as_it_is:
        light *= np.float32(unit)
    found = PointSources(
        u_px=read_only(places.u_px * binning + offset),
        v_px=read_only(places.v_px * binning + offset),
        covariance_px2=read_only(places.covariance_px2 * binning**2),
        signal_ratio=read_only(places.signal_ratio),
        flux_counts=read_only(places.flux_counts * binning**2 * unit),
        psf_sigma_px=psf * binning,
        noise_counts=noise_counts * unit,
        background_counts=float(background.globalback) * unit + levels.zero_counts,
        clipped_share=np.count_nonzero(counts <= np.nanmin(counts)) / counts.size,
        light=light,
        binning=binning,
        width_px=width,
        height_px=height,
        hot_pixels=int(np.count_nonzero(hot)),
        clipped_stars=0 if discs is None else min(len(discs.u_px), MAX_POINTS),
        trail_px=None if trails is None else trails.length_px * binning,
        trailed=None if trails is None else trails.refused,
    )
    apart_px = twin_distance_px(found.u_px, found.v_px, found.flux_counts, max(width, height))
    if apart_px is None:
        return found
    return replace(found, trail_px=apart_px, trailed="in two images of each")


@dataclass(frozen=True)
class _Places:
    """Measured places (n) with covariances in working pixels, signal to noise, and light."""

    u_px: Vector
    v_px: Vector
    covariance_px2: Matrix
    signal_ratio: Vector
    flux_counts: Vector


def _still_places(
    light: CountArray,
    psf: float,
    u: npt.NDArray[np.int64],
    v: npt.NDArray[np.int64],
    ratio: Vector,
) -> _Places:
    """The centroids of the clearest peaks of stars that do not trail."""
    order = np.argsort(-ratio, kind="stable")[:MAX_POINTS]
    u, v, ratio = u[order], v[order], ratio[order]
    weight = max(psf, 1.0)
    shapes = image_moments(light, u, v, weight)
    # The filter may respond between two dark pixels, where there is no light.
    lit = shapes.weighted > 0.0
    ratio = ratio[lit]
    # A star between pixels is clearer than the pixel beside it shows.
    off_px2 = np.minimum((shapes.u_px - u)[lit] ** 2 + (shapes.v_px - v)[lit] ** 2, 0.5)
    own_ratio = np.maximum(ratio, 1.0) * np.exp(0.25 * off_px2 / psf**2)
    return _Places(
        shapes.u_px[lit],
        shapes.v_px[lit],
        _alike(PLACE_NOISE * psf / own_ratio),
        ratio,
        shapes.weighted[lit] * (1.0 + (psf / weight) ** 2),
    )


def _alike(sigma_px: Vector) -> Matrix:
    """Covariances (n, 2, 2) of places whose errors (n) are alike along both axes."""
    return np.maximum(sigma_px, _LEAST_SIGMA_PX)[:, None, None] ** 2 * np.eye(2)


def _behind(discs: ClippedStars, places: _Places, noise_counts: float) -> _Places:
    """Clipped stars followed by the other places, since clipped stars are the brightest."""

    def joined(first: Vector, second: Vector) -> Vector:
        return np.concatenate([first, second])[:MAX_POINTS]

    noise = noise_counts * np.sqrt(math.pi) * (discs.radius_px + FLANK_PX)
    return _Places(
        joined(discs.u_px, places.u_px),
        joined(discs.v_px, places.v_px),
        joined(_alike(discs.sigma_px), places.covariance_px2),
        joined(discs.light / noise, places.signal_ratio),
        joined(discs.light, places.flux_counts),
    )


def _trails(
    light: CountArray,
    noise_counts: float,
    u: npt.NDArray[np.int64],
    v: npt.NDArray[np.int64],
    ratio: Vector,
) -> Trails | None:
    """The star trails, if the clearest peaks are elongated alike and fit one motion; else None."""
    clear = np.argsort(-ratio, kind="stable")[:TRAIL_PEAKS]
    clear = clear[ratio[clear] > 2.0 * FIRST_THRESHOLD]
    u, v = u[clear], v[clear]
    shapes = image_moments(light, u, v, TRAIL_WEIGHT_PX, TRAIL_ROUNDS)
    if not may_trail(shapes.u_px, shapes.v_px, shapes.drawn_out, max(light.shape)):
        return None
    return measured_trails(light, noise_counts, _below_full(light))


def _below_full(light: CountArray) -> npt.NDArray[np.bool_]:
    """True for pixels (rows, columns) that are not clipped at the largest count."""
    return np.asarray(light < FULL_SHARE * light.max(initial=0.0))


def _middles_of_trails(
    light: CountArray, noise_counts: float, trails: Trails, threshold: float
) -> _Places:
    """The middles of the clearest star trails, without objects of another shape."""
    u, v, ratio = find_trails(light, noise_counts, trails, threshold, MAX_POINTS)
    placed = placed_trails(light, noise_counts, _below_full(light), trails, u, v)
    alike = (placed.unexplained < MOST_UNEXPLAINED) | (ratio < CLEAR_RATIO)
    return _Places(
        placed.u_px[alike],
        placed.v_px[alike],
        placed.covariance_px2[alike] + _LEAST_SIGMA_PX**2 * np.eye(2),
        ratio[alike],
        placed.flux_counts[alike],
    )


@dataclass(frozen=True)
class ImageShapes:
    """Shapes of star images as arrays (n,): places, widths, ellipticities (0 to 1), light.

    `drawn_out` is complex: its size is the ellipticity, its angle twice the direction of the longer
    axis from u towards v.
    """

    u_px: Vector
    v_px: Vector
    sigma_px: Vector
    ellipticity: Vector
    weighted: Vector
    drawn_out: npt.NDArray[np.complex128]


def _binned(counts: CountArray, binning: int) -> CountArray:
    """Counts averaged over blocks of pixels; incomplete blocks at the edge are left out."""
    if binning == 1:
        return counts
    rows, columns = (side // binning for side in counts.shape)
    blocks = counts[: rows * binning, : columns * binning]
    shape = (rows, binning, columns, binning)
    return np.asarray(blocks.reshape(shape).mean(axis=(1, 3)), dtype=np.float32)


def _filled(counts: CountArray) -> CountArray:
    """Counts with pixels that hold no number replaced by the median of the others, in place."""
    unknown = ~np.isfinite(counts)
    if unknown.any():
        counts[unknown] = np.median(counts[~unknown]) if not unknown.all() else 0.0
    return counts


def _is_hot(
    light: CountArray, u: npt.NDArray[np.int64], v: npt.NDArray[np.int64]
) -> npt.NDArray[np.bool_]:
    """True for peaks (n,) of a single bright pixel, whose four neighbours hold hardly any light."""
    beside = sum(_beside(light, u, v))
    brightest = np.maximum.reduce([light[v, u], *_beside(light, u, v)])
    return np.asarray((light[v, u] == brightest) & (beside < HOT_SHARE * brightest))


def _fill(light: CountArray, u: npt.NDArray[np.int64], v: npt.NDArray[np.int64]) -> None:
    """Replace pixels by the median of their four neighbours, in place."""
    light[v, u] = np.median(_beside(light, u, v), axis=0)


def _beside(
    light: CountArray, u: npt.NDArray[np.int64], v: npt.NDArray[np.int64]
) -> list[CountArray]:
    """The light of the four neighbours, each (n,), of pixels that are not on the edge."""
    return [light[v + down, u + across] for down, across in ((-1, 0), (1, 0), (0, -1), (0, 1))]


def _measured_psf(
    light: CountArray, u: npt.NDArray[np.int64], v: npt.NDArray[np.int64], ratio: Vector
) -> float:
    """One standard deviation of a star's image: the median over clear, round, unclipped stars."""
    order = np.argsort(-ratio)[:60]
    u, v, ratio = u[order], v[order], ratio[order]
    shapes = image_moments(light, u, v, GUESSED_PSF_PX)
    round_ = (shapes.ellipticity < 0.3) & (shapes.sigma_px < MOST_PSF_PX)
    whole = light[v, u] < FULL_SHARE * light.max(initial=0.0)
    clear = ratio > FIRST_THRESHOLD + 1.0
    for good in (round_ & whole & (ratio > 10.0), round_ & whole & clear, round_ & clear):
        if np.count_nonzero(good) >= 3:
            width = float(np.median(shapes.sigma_px[good]))
            return min(max(width, LEAST_PSF_PX), MOST_PSF_PX)
    return GUESSED_PSF_PX


def _filtered(light: CountArray, psf: float) -> CountArray:
    """The light filtered with the image of a star minus its surroundings.

    By Fourier transforms, six times as fast as two Gaussian filters, in strips of rows whose
    spectra fit into the processor's cache.
    """
    height, width = light.shape
    reach = math.ceil(FILTER_REACH * SURROUND * psf)
    strips = math.ceil(height / (STRIP_ROWS - 2 * reach))
    rows = math.ceil(height / strips)
    # Padding keeps light at one edge from wrapping around to the other.
    down = fft.next_fast_len(rows + 2 * reach, real=True)
    across = fft.next_fast_len(width + reach, real=True)
    response = _star_less_surround(fft.fftfreq(down), fft.rfftfreq(across), psf)
    filtered = np.empty_like(light)
    for top in range(0, height, rows):
        first, end = max(top - reach, 0), min(top + rows, height)
        spectrum = fft.rfft2(light[first : end + reach], (down, across))
        spectrum *= response
        strip = fft.irfft2(spectrum, (down, across), overwrite_x=True)
        filtered[top:end] = strip[top - first : end - first, :width]
    return filtered


def _star_less_surround(down: Vector, across: Vector, psf: float) -> CountArray:
    """Filter's frequency response (rows, columns), cycles per pixel: star minus surroundings."""

    def gaussian(frequency: Vector, width: float) -> CountArray:
        return np.exp(-2.0 * (math.pi * width * frequency) ** 2).astype(np.float32)

    narrow, wide = (
        np.outer(gaussian(down, width), gaussian(across, width)) for width in (psf, SURROUND * psf)
    )
    return np.asarray(narrow - wide)


def _peaks(
    light: CountArray, psf: float, threshold: float, step: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], Vector]:
    """Columns and rows of local maxima of the filtered light, and their signal to noise."""
    filtered = _filtered(light, psf)
    # Filtered noise is correlated between neighbours: every other pixel suffices.
    coarse = np.ascontiguousarray(filtered[::2, ::2])
    noise = sep.Background(coarse, bw=MESH_PX // 2, bh=MESH_PX // 2).rms(dtype=np.float32)
    # Rounding of counts alone makes this much noise, however flat the counts look.
    np.maximum(noise, 0.7 * step / (2.0 * math.sqrt(math.pi) * psf), out=noise)
    height, width = filtered.shape
    limit = np.repeat(threshold * noise, 2, axis=1)[:, :width]
    above = np.empty(filtered.shape, dtype=bool)
    np.greater(filtered[::2], limit, out=above[::2])
    np.greater(filtered[1::2], limit[: height // 2], out=above[1::2])
    v, u = np.divmod(np.flatnonzero(above), width)
    edge = int(2.0 * psf) + 1
    inside = (v >= edge) & (v < height - edge) & (u >= edge) & (u < width - edge)
    v, u = v[inside], u[inside]
    # Few pixels are that bright, so each is compared with its neighbours one by one.
    value, highest = filtered[v, u], np.ones(len(u), dtype=bool)
    reach = min(math.ceil(1.5 * psf), edge)
    for down in range(-reach, reach + 1):
        for across in range(-reach, reach + 1):
            highest &= value >= filtered[v + down, u + across]
    u, v = u[highest], v[highest]
    return u, v, np.asarray(filtered[v, u] / noise[v // 2, u // 2], dtype=np.float64)


def image_moments(
    light: CountArray,
    u: npt.NDArray[np.int64],
    v: npt.NDArray[np.int64],
    weight_px: float,
    rounds: int = 6,
) -> ImageShapes:
    """Centroids and second moments of images under a Gaussian weight that follows each image."""
    half = max(3, math.ceil(3.0 * weight_px))
    steps = np.arange(-half, half + 1)
    rows = np.clip(v[:, None] + steps, 0, light.shape[0] - 1)
    columns = np.clip(u[:, None] + steps, 0, light.shape[1] - 1)
    window = light[rows[:, :, None], columns[:, None, :]].astype(np.float64)
    x, y = np.zeros(len(u)), np.zeros(len(u))
    reach = 1.5 * weight_px
    for _ in range(rounds):
        along_u, along_v = steps - x[:, None], steps - y[:, None]
        weight_u = np.exp(-0.5 * (along_u / weight_px) ** 2)
        weight_v = np.exp(-0.5 * (along_v / weight_px) ** 2)
        weighted = window * weight_v[:, :, None] * weight_u[:, None, :]
        total = weighted.sum(axis=(1, 2))
        safe = np.where(total > 0.0, total, np.inf)
        over_v, over_u = weighted.sum(axis=2), weighted.sum(axis=1)
        mean_u = (over_u * along_u).sum(axis=1) / safe
        mean_v = (over_v * along_v).sum(axis=1) / safe
        # The weight shortens the centroid's shift: by half where it is as wide as the image.
        x = np.clip(x + 1.5 * mean_u, -reach, reach)
        y = np.clip(y + 1.5 * mean_v, -reach, reach)
    uu = (over_u * along_u**2).sum(axis=1) / safe - mean_u**2
    vv = (over_v * along_v**2).sum(axis=1) / safe - mean_v**2
    both = weighted * along_v[:, :, None] * along_u[:, None, :]
    uv = both.sum(axis=(1, 2)) / safe - mean_u * mean_v
    size = np.maximum(0.5 * (uu + vv), 0.04)
    # The width without the narrowing by the weight.
    sigma = np.sqrt(1.0 / np.clip(1.0 / size - 1.0 / weight_px**2, 0.01, 25.0))
    stretch = np.hypot(uu - vv, 2.0 * uv) / (2.0 * size)
    drawn_out = (uu - vv + 2j * uv) / (2.0 * size)
    return ImageShapes(u + x, v + y, sigma, stretch, np.maximum(total, 0.0), drawn_out)


HOT_SIGMAS = 8.0
"""Least height of a hot pixel above the median of a dark frame, in sigmas."""


def without_dark(frame: Frame, dark: Frame) -> Frame:
    """A frame minus its dark frame of the same exposure; hot pixels become NaN.

    Raises `BadFile` for a dark frame of another size.
    """
    if dark.counts.shape != frame.counts.shape:
        size = f"{dark.width_px} x {dark.height_px} px"
        wanted = f"{frame.width_px} x {frame.height_px} px"
        raise bad_frame(f"must have the size of its dark frame, {size}", wanted)
    counts = np.array(frame.counts - dark.counts)
    counts[hot_pixels(dark.counts)] = np.nan
    return replace(frame, counts=counts, remarks=(*frame.remarks, DARK_REMARK))


DARK_REMARK = "dark_frame: it was taken off, and its hot pixels are ignored"


def has_dark(frame: Frame) -> bool:
    """True for a frame from which a dark frame was subtracted."""
    return DARK_REMARK in frame.remarks


def hot_pixels(dark: CountArray) -> CountArray:
    """True for pixels (rows, columns) of a dark frame that are hot or hold no number."""
    middle = np.nanmedian(dark)
    # The spread of a quiet sensor may be zero; its counts differ by whole steps.
    spread = max(1.48 * float(np.nanmedian(np.abs(dark - middle))), 0.5 * count_step(dark))
    # If all counts are equal, none is hot.
    spread = spread or 1.0
    return np.asarray(~(dark < middle + HOT_SIGMAS * spread))
