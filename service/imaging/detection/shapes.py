"""Telling stars from hot pixels and cosmic rays: nothing that came through the lens is sharper
than the image of a point.

Blends and trails are wider than that image and pass; a hot pixel is narrow both ways,
a cosmic ray's track across itself.
"""

import numpy as np
import numpy.typing as npt

from service.imaging.frames.frame import CountArray
from service.vectors import Vector

HALF_PX = 3
SHARP = 0.5
"""Smallest width, as a variance, that is still a star's, in that of a point's image."""
_ROUNDS = 2


def is_sharp(
    light: CountArray, u_px: Vector, v_px: Vector, psf_sigma_px: float
) -> npt.NDArray[np.bool_]:
    """Whether (n,) candidates are narrower, along some direction, than a point's image can be.

    Second moments under a Gaussian weight as wide as that image; the smaller axis of
    each is held against what the image itself gives.
    """
    if len(u_px) == 0:
        return np.zeros(0, dtype=np.bool_)
    half = max(HALF_PX, round(3.0 * psf_sigma_px))
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
