"""Separation of stars from hot pixels and cosmic rays, and recovery of the stars that these hit.

Some hit stars are detected again after the hit pixels are removed; others are located first, and
pixels that stand out from the fitted image are then masked.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.features.pictures.centroids.psf import GaussianPsf, Psf
from service.features.pictures.centroids.window import CentroidRecord, Mask, Window
from service.features.pictures.frames.frame import CountArray
from service.vectors import Vector

HALF_PX = 5
ROUNDS = 6
_CORE = np.arange(-1.0, 2.0)
MARGIN = 1.4
"""Least sharpness of a hot pixel: its ratio to its neighbours over that of a star's image."""
LEAST_SIGMAS = 5.0
CERTAIN_SIGMAS = 12.0
"""Least signal to noise of a star that remains behind removed hot pixels, so that the remnant of a
cosmic-ray track is not taken for a star.
"""

HIT_SHARE = 0.1
"""Least residual of a cosmic-ray hit, as a share of the brightest pixel of the star's model.

Smaller ones may be errors of the PSF.
"""

_ASIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))


@dataclass(frozen=True)
class Behind:
    """Stars (n,) recovered behind hot pixels, and every hot pixel (m,) that covered them."""

    u_px: Vector
    v_px: Vector
    flux_counts: Vector
    hot_u_px: npt.NDArray[np.intp]
    hot_v_px: npt.NDArray[np.intp]


def stars_behind(
    light: CountArray, u_px: Vector, v_px: Vector, psf_sigma_px: float, noise_counts: Vector
) -> Behind:
    """The stars recovered behind candidates (k,) that are sharper than a star's image.

    Each candidate has its own noise. Pixels that exceed their four neighbours by more than a star's
    image can are removed, brightest first, until none is left. If a star remains, it was hit.
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
    """True for pixels (rows, columns) of a window hit by a cosmic ray, found beside a fitted star.

    The star's model is subtracted; a pixel was hit where its residual exceeds those of its
    neighbours by a factor that no point image reaches.
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
    """True for pixels of (k, rows, columns) that exceed their neighbours more than a star's can."""
    hot = np.zeros(patches.shape, dtype=np.bool_)
    for _ in range(ROUNDS):
        # A pixel known to be hot tells nothing about its neighbours.
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
    """Padded patches without their padding, shifted by whole rows and columns."""
    height, width = padded.shape[1:]
    return padded[:, 1 + rows : height - 1 + rows, 1 + columns : width - 1 + columns]


def _best(
    patches: npt.NDArray[np.float64], core: npt.NDArray[np.float64], noise_counts: Vector
) -> tuple[Vector, Vector, Vector]:
    """The best match (row, column) with a star's core in each patch, and its signal to noise."""
    size = patches.shape[1] - 2
    filtered = np.zeros((len(patches), size, size))
    for row in range(3):
        for column in range(3):
            moved = patches[:, row : row + size, column : column + size]
            filtered += core[row, column] * moved
    flat = filtered.reshape(len(patches), size * size)
    at = flat.argmax(axis=1)
    # The filter has no values on the rim.
    row, column = (each.astype(np.float64) + 1.0 for each in np.divmod(at, size))
    best = flat[np.arange(len(flat)), at]
    return row, column, best / (np.sqrt((core**2).sum()) * noise_counts)


# Separation of stars from hot pixels and cosmic rays: light through the lens is never sharper than
# the image of a point. Blends and trails are wider than that image and pass; a hot pixel is narrow
# in both directions, a cosmic ray's track across its length.

PATCH_HALF_PX = 3
SHARP = 0.5
"""Least variance of a star's image in any direction, as a share of a point image's."""
_ROUNDS = 2


def is_sharp(
    light: CountArray, u_px: Vector, v_px: Vector, psf_sigma_px: float
) -> npt.NDArray[np.bool_]:
    """True for candidates (n,) that are narrower, along some direction, than the image of a point.

    Computed from second moments under a Gaussian weight as wide as that image; the smaller axis is
    compared with that of a point's image.
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
            # A weighted moment gives half of the star's offset.
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
    # Product of two Gaussians: the image, widened by the pixel, and the weight.
    expected = 1.0 / (1.0 / (psf_sigma_px**2 + 1.0 / 12.0) + 1.0 / psf_sigma_px**2)
    return np.asarray(~(smaller >= SHARP * expected))


def patches_of(light: CountArray, u_px: Vector, v_px: Vector, half: int) -> npt.NDArray[np.float64]:
    """Squares (n, 2 half + 1, 2 half + 1) of light about given places; zero beyond the frame."""
    padded = np.pad(light, half)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (2 * half + 1, 2 * half + 1))
    row, column = (np.round(each).astype(np.intp) for each in (v_px, u_px))
    rows, columns = light.shape
    found = windows[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)]
    return np.maximum(found.astype(np.float64), 0.0)
