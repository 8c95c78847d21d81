"""Telling stars from hot pixels and cosmic rays, and stars that either of these spoils.

Some are found again only once the pixels that were struck are taken off; others are
placed, and what stands out from their own image is then no longer believed.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.imaging.centroids.psf import GaussianPsf, Psf
from service.imaging.centroids.window import CentroidRecord, Mask, Window
from service.imaging.frames.frame import CountArray
from service.vectors import Vector

HALF_PX = 5
ROUNDS = 6
_CORE = np.arange(-1.0, 2.0)
MARGIN = 1.4
"""How much brighter than the image of a point could be over its neighbours a pixel is hot."""
LEAST_SIGMAS = 5.0
CERTAIN_SIGMAS = 12.0
"""Sigmas of what is left of a star that was struck, so that the rest of a track is none."""

HIT_SHARE = 0.1
"""The share of a star's brightest pixel: less may be a shape that is not quite as presumed."""

_ASIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))


@dataclass(frozen=True)
class Behind:
    """Stars (n,) that were hidden, and every pixel (m,) that hid them."""

    u_px: Vector
    v_px: Vector
    flux_counts: Vector
    hot_u_px: npt.NDArray[np.intp]
    hot_v_px: npt.NDArray[np.intp]


def stars_behind(
    light: CountArray, u_px: Vector, v_px: Vector, psf_sigma_px: float, noise_counts: Vector
) -> Behind:
    """The stars behind candidates (k,) that are sharper than a star, each with its own noise.

    About each, pixel by pixel, what stands out from its four neighbours more than the
    middle of a star's image can is taken off, the brightest first, until nothing does.
    Where a star is left, it was struck.
    """
    core = GaussianPsf(psf_sigma_px).pixel(_CORE[None, :], _CORE[:, None])
    patches = patches_of(light, u_px, v_px, HALF_PX)
    hot = _hot(patches, float(core[1, 1] / core[0, 1]), noise_counts[:, None, None])
    left = np.where(hot, 0.0, patches)
    row, column, ratio = _best(left, core, noise_counts)
    struck = [
        k
        for k in np.flatnonzero(ratio >= CERTAIN_SIGMAS).tolist()
        if not is_sharp(left[k], column[k : k + 1], row[k : k + 1], psf_sigma_px)[0]
    ]
    corner_u, corner_v = (np.round(each).astype(np.intp) - HALF_PX for each in (u_px, v_px))
    patch, hot_row, hot_column = np.nonzero(hot[struck])
    hot_u = corner_u[struck][patch] + hot_column
    hot_v = corner_v[struck][patch] + hot_row
    rows, columns = light.shape
    inside = (hot_u >= 0) & (hot_u < columns) & (hot_v >= 0) & (hot_v < rows)
    return Behind(
        corner_u[struck] + column[struck],
        corner_v[struck] + row[struck],
        ratio[struck] * noise_counts[struck] / np.sqrt((core**2).sum()),
        hot_u[inside],
        hot_v[inside],
    )


def hits_under(window: Window, psf: Psf, star: CentroidRecord) -> Mask:
    """Pixels (rows, columns) of a window that stand out from a placed star as no light can.

    The star is taken off at the place that it was given; a pixel was hit where more is
    left of it than of its neighbours by a factor that no image of a point reaches.
    """
    rows, columns = window.counts.shape
    du = np.arange(columns)[None, :] + window.corner_u_px - star.u_px
    dv = np.arange(rows)[:, None] + window.corner_v_px - star.v_px
    model = np.maximum(star.flux_counts * psf.pixel(du, dv), 0.0)
    variance = window.floor_variance + model / window.detector.gain_e_per_count
    left = np.where(window.usable, window.light_counts - model, 0.0)
    middle, beside, above = psf.pixel(np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    ratio = float(middle / max(beside, above))
    hot = _hot(left[None], ratio, np.sqrt(variance)[None])[0]
    return np.asarray(hot & (left > HIT_SHARE * model.max()))


def _hot(
    patches: npt.NDArray[np.float64],
    peak_over_next: float,
    noise_counts: npt.NDArray[np.float64],
) -> npt.NDArray[np.bool_]:
    """Pixels of (k, rows, columns) that stand out from their neighbours more than a star's can."""
    hot = np.zeros(patches.shape, dtype=np.bool_)
    for _ in range(ROUNDS):
        # What is hot already says nothing of its neighbours.
        known = np.pad(~hot, ((0, 0), (1, 1), (1, 1))).astype(np.float64)
        light = np.pad(np.where(hot, 0.0, patches), ((0, 0), (1, 1), (1, 1)))
        count = sum(_aside(known, *step) for step in _ASIDE)
        around = sum(_aside(light, *step) for step in _ASIDE) / np.maximum(count, 1.0)
        more = patches - MARGIN * peak_over_next * around > LEAST_SIGMAS * noise_counts
        more &= ~hot
        if not more.any():
            break
        hot |= more
    return hot


def _aside(padded: npt.NDArray[np.float64], rows: int, columns: int) -> npt.NDArray[np.float64]:
    """The inner part of padded patches, moved."""
    height, width = padded.shape[1:]
    return padded[:, 1 + rows : height - 1 + rows, 1 + columns : width - 1 + columns]


def _best(
    patches: npt.NDArray[np.float64], core: npt.NDArray[np.float64], noise_counts: Vector
) -> tuple[Vector, Vector, Vector]:
    """The place (row, column) in each patch of the most starlike light, and its ratio to noise."""
    size = patches.shape[1] - 2
    filtered = np.zeros((len(patches), size, size))
    for row in range(3):
        for column in range(3):
            moved = patches[:, row : row + size, column : column + size]
            filtered += core[row, column] * moved
    flat = filtered.reshape(len(patches), size * size)
    at = flat.argmax(axis=1)
    # The filter lacks the rim.
    row, column = (each.astype(np.float64) + 1.0 for each in np.divmod(at, size))
    best = flat[np.arange(len(flat)), at]
    return row, column, best / (np.sqrt((core**2).sum()) * noise_counts)


# Telling stars from hot pixels and cosmic rays: nothing that came through the lens is sharper
# than the image of a point.
#
# Blends and trails are wider than that image and pass; a hot pixel is narrow both ways,
# a cosmic ray's track across itself.

PATCH_HALF_PX = 3
SHARP = 0.5
"""Smallest width, as a variance, that is still a star's, in that of a point's image."""
_ROUNDS = 2


def is_sharp(
    light: CountArray, u_px: Vector, v_px: Vector, psf_sigma_px: float
) -> npt.NDArray[np.bool_]:
    """The candidates (n,) that are narrower, along some direction, than a point's image can be.

    Second moments under a Gaussian weight as wide as that image; the smaller axis of
    each is held against what the image itself gives.
    """
    if len(u_px) == 0:
        return np.zeros(0, dtype=np.bool_)
    half = max(PATCH_HALF_PX, round(3.0 * psf_sigma_px))
    patches = patches_of(light, u_px, v_px, half)
    steps = np.arange(-half, half + 1, dtype=np.float64)
    at_u, at_v = u_px - np.round(u_px), v_px - np.round(v_px)
    weighted = patches
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(_ROUNDS):
            du = steps[None, None, :] - at_u[:, None, None]
            dv = steps[None, :, None] - at_v[:, None, None]
            weighted = patches * np.exp(-(du**2 + dv**2) / (2.0 * psf_sigma_px**2))
            total = weighted.sum(axis=(1, 2))
            # A weighted moment goes half of the way to where the star stands.
            at_u = np.clip(at_u + 2.0 * (weighted * du).sum(axis=(1, 2)) / total, -1.0, 1.0)
            at_v = np.clip(at_v + 2.0 * (weighted * dv).sum(axis=(1, 2)) / total, -1.0, 1.0)
        du = steps[None, None, :] - at_u[:, None, None]
        dv = steps[None, :, None] - at_v[:, None, None]
        weighted = patches * np.exp(-(du**2 + dv**2) / (2.0 * psf_sigma_px**2))
        total = weighted.sum(axis=(1, 2))
        uu, vv, uv = (
            (weighted * each).sum(axis=(1, 2)) / total for each in (du * du, dv * dv, du * dv)
        )
    smaller = (uu + vv) / 2.0 - np.hypot((uu - vv) / 2.0, uv)
    # Two Gaussians multiplied: the image, widened by the pixel, and the weight.
    expected = 1.0 / (1.0 / (psf_sigma_px**2 + 1.0 / 12.0) + 1.0 / psf_sigma_px**2)
    return np.asarray(~(smaller >= SHARP * expected))


def patches_of(light: CountArray, u_px: Vector, v_px: Vector, half: int) -> npt.NDArray[np.float64]:
    """Squares (n, 2 half + 1, 2 half + 1) about the nearest pixels; dark beyond the frame."""
    padded = np.pad(light, half)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * half + 1, 2 * half + 1))
    row, column = (np.round(each).astype(np.intp) for each in (v_px, u_px))
    rows, columns = light.shape
    found = windows[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    return np.maximum(found.astype(np.float64), 0.0)
