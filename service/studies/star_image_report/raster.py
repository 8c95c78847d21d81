"""Finding stars by the sums of raster lines (report, 7.8).

The sum of every row shows the v of the stars, the sum of every column their u.  Which u
belongs to which v is not told, and the pattern constant does not ask.
"""

from dataclasses import dataclass

import numpy as np

from service.imaging.centroids.window import Array


@dataclass(frozen=True)
class RasterStars:
    """Places of stars along either axis in pixels, rising and unpaired; why not, if refused."""

    u_px: Array
    v_px: Array
    refused: str | None = None


def find_by_rasters(
    image: Array, noise_sigma: float, threshold_sigmas: float = 6.0, background: float = 0.0
) -> RasterStars:
    """Stars of a field by row and column sums, to about a pixel.

    A line is a star's where its sum is a maximum `threshold_sigmas` above the noise of such
    a sum.  Two stars in one band of rows or columns look like one: the counts then differ
    and the field is refused; where that happens to both axes alike it goes unseen.
    """
    light = image - background
    u = _peaks(light.sum(axis=0), noise_sigma * np.sqrt(image.shape[0]) * threshold_sigmas)
    v = _peaks(light.sum(axis=1), noise_sigma * np.sqrt(image.shape[1]) * threshold_sigmas)
    if len(u) != len(v):
        why = f"{len(u)} stars by columns, {len(v)} by rows: some stand in one line"
        return RasterStars(u, v, why)
    return RasterStars(u, v, None if len(u) else "no line stands out of the noise")


def _peaks(sums: Array, threshold: float) -> Array:
    padded = np.concatenate([[-np.inf], sums, [-np.inf]])
    before, here, after = padded[:-2], padded[1:-1], padded[2:]
    at = np.flatnonzero((here > threshold) & (here > before) & (here >= after))
    # Maxima without a valley between them are one star and its noise.
    kept: list[int] = []
    for line in at.tolist():
        if kept and sums[kept[-1] : line + 1].min() > min(sums[kept[-1]], sums[line]) - threshold:
            kept[-1] = max(kept[-1], line, key=lambda each: float(sums[each]))
        else:
            kept.append(line)
    inner = [line for line in kept if 0 < line < len(sums) - 1]
    return np.array([line + _fine(sums, line) for line in inner])


def _fine(sums: Array, at: int) -> float:
    before, here, after = sums[at - 1 : at + 2]
    bend = before - 2.0 * here + after
    return float(0.5 * (before - after) / bend) if bend < 0.0 else 0.0
