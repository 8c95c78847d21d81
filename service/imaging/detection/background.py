"""The level of a frame's background, and the noise about it, pixel by pixel.

The level is a mesh of clipped modes, by SEP.  Where stray light leaves more than that mesh can
follow (a limb, a bright corner), medians of finer meshes are taken off too, between which the
level is linear, so that it does not swing beside a step.  The noise is measured on what is left:
a slope within a mesh is no noise, the photons of stray light are.
"""

import math
import warnings

import numpy as np
import numpy.typing as npt
import sep
from scipy.ndimage import median_filter

from service.imaging.frames.frame import CountArray

MESH_PX = 64
FINE_MESH_PX = 16
FINE_MESH_SIGMAS = 12.0
"""The least side of a fine mesh, in widths of a star's image: a star fills little of it."""
MOST_FINE_MESH_PX = 32
FINE_ROUNDS = 2
UNEVEN, UNEVEN_SHARE = 0.5, 0.005
"""In sigmas of noise, the level that stray light leaves in a coarse mesh, and the least share of
such meshes.  On even frames a few have 0.3 sigmas."""
SURE_SIGMAS = 6.0
"""A multiple of the error of a fine mesh's level."""
MEDIAN_ERROR = 1.25
"""The error of a median over that of a mean."""
MAD_SIGMAS = 1.48
CLIP_SIGMAS = 3.0
CROSSED = 1.5
"""The spread of a square over that of its neighbours from which a limb crosses it."""
CLIPPED_SHARE = 0.987
"""The standard deviation of Gaussian noise that is cut at three sigmas."""

Mask = npt.NDArray[np.bool_]


def take_background_off(
    light: CountArray, mask: Mask | None, psf_sigma_px: float
) -> tuple[CountArray, CountArray]:
    """Subtract the level from light (rows, columns) in place; returns level and noise.

    `mask` is True where a pixel holds no number.  Images of stars that are too wide for a fine
    mesh keep the coarse one.
    """
    level = sep.Background(light, mask=mask, bw=MESH_PX, bh=MESH_PX).back(dtype=light.dtype)
    light -= level
    left, noise, typical = _left(light, mask)
    uneven = np.abs(left) > UNEVEN * typical
    fine = max(FINE_MESH_PX, 8 * math.ceil(FINE_MESH_SIGMAS * psf_sigma_px / 8.0))
    fits = fine <= MOST_FINE_MESH_PX and min(light.shape) >= MESH_PX
    if fits and np.count_nonzero(uneven) > UNEVEN_SHARE * uneven.size:
        for _ in range(FINE_ROUNDS):
            level += _take_fine_off(light, mask, fine)
        noise = _noise_by_blocks(light, mask, fine)
    # Where most pixels are equal, as in a frame cut off at its background, a count is the least
    # step.
    noise[~(noise > 0.0)] = 1.0
    return level, noise


def _left(light: CountArray, mask: Mask | None) -> tuple[CountArray, CountArray, float]:
    """The level that is left in each mesh, the noise of each pixel, and that of the whole.

    Every other pixel shows them.
    """
    coarse = np.ascontiguousarray(light[::2, ::2])
    hidden = None if mask is None else np.ascontiguousarray(mask[::2, ::2])
    half = MESH_PX // 2
    found = sep.Background(coarse, mask=hidden, bw=half, bh=half)
    left = found.back(dtype=light.dtype)[half // 2 :: half, half // 2 :: half]
    noise = np.repeat(np.repeat(found.rms(dtype=light.dtype), 2, axis=0), 2, axis=1)
    rows, columns = light.shape
    return left, np.ascontiguousarray(noise[:rows, :columns]), float(found.globalrms)


def _take_fine_off(light: CountArray, mask: Mask | None, side: int) -> CountArray:
    """Subtract the level of fine meshes where it is more than their noise; returns it."""
    blocks = _blocks(light, mask, side)
    middle = _median(blocks)
    spread = MAD_SIGMAS * _median(np.abs(blocks - middle[:, :, None]))
    # A mesh that a limb crosses has a great spread, unlike those beside it.
    noise = np.minimum(spread, median_filter(spread, 3, mode="nearest"))
    sure = np.abs(middle) > SURE_SIGMAS * MEDIAN_ERROR * noise / side
    level = _between(np.where(sure, middle, 0.0), side, light.shape).astype(light.dtype)
    light -= level
    return level


def _noise_by_blocks(light: CountArray, mask: Mask | None, side: int) -> CountArray:
    """One standard deviation of each pixel, from squares without what stands out in them.

    Of a square that a limb crosses the light of the limb is noise, so that no star is seen in it.
    """
    blocks = _blocks(light, mask, side)
    away = np.abs(blocks - _median(blocks)[:, :, None])
    sigma = np.maximum(MAD_SIGMAS * _median(away), 0.5)
    squares = away**2
    for _ in range(2):
        kept = away < CLIP_SIGMAS * sigma[:, :, None]
        total = np.sum(squares, axis=2, where=kept)
        mean = total / np.maximum(np.count_nonzero(kept, axis=2), 1)
        sigma = np.maximum(np.sqrt(mean) / CLIPPED_SHARE, 0.3)
    smooth = median_filter(sigma, 3, mode="nearest")
    crossed = sigma > CROSSED * smooth
    return _between(np.where(crossed, sigma, smooth), side, light.shape).astype(light.dtype)


def _blocks(light: CountArray, mask: Mask | None, side: int) -> CountArray:
    """Squares (down, across, pixels); the last ones of an uneven frame reach back into it."""
    rows, columns = light.shape
    tops, lefts = _starts(rows, side), _starts(columns, side)
    if mask is not None:
        light = np.where(mask, np.nan, light)
    windows = np.lib.stride_tricks.sliding_window_view(light, (side, side))
    return np.asarray(windows[np.ix_(tops, lefts)].reshape(len(tops), len(lefts), side * side))


def _median(blocks: CountArray) -> CountArray:
    """The median of each square (down, across), of numbers alone; zero where there is none."""
    if np.isfinite(blocks[:, :, 0]).all() and not np.isnan(blocks.sum(dtype=np.float64)):
        return np.asarray(np.median(blocks, axis=2))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return np.asarray(np.nan_to_num(np.nanmedian(blocks, axis=2)))


def _starts(length: int, side: int) -> npt.NDArray[np.intp]:
    starts = np.arange(0, length - side + 1, side)
    return np.append(starts, length - side) if length % side else starts


def _between(values: CountArray, side: int, shape: tuple[int, ...]) -> CountArray:
    """Values at the middles of squares, linear between them and beyond the outer ones."""
    down, across = (_weights(length, side) for length in shape)
    return np.asarray(down @ values @ across.T, dtype=np.float32)


def _weights(length: int, side: int) -> CountArray:
    """How much of each square's value a pixel has (pixels, squares)."""
    middles = _starts(length, side) + 0.5 * (side - 1)
    at = np.arange(length, dtype=np.float64)
    place = np.clip(np.searchsorted(middles, at) - 1, 0, max(len(middles) - 2, 0))
    weights = np.zeros((length, len(middles)))
    if len(middles) == 1:
        weights[:, 0] = 1.0
        return weights
    share = (at - middles[place]) / (middles[place + 1] - middles[place])
    rows = np.arange(length)
    weights[rows, place] = 1.0 - share
    weights[rows, place + 1] = share
    return weights
