"""Finding stars by the sums of raster lines (report, 7.8).

The sum of every row shows the v of the stars, the sum of every column their u.  Which u
belongs to which v is not told, and the pattern constant does not ask.
"""

from dataclasses import dataclass

import numpy as np

from service.imaging.centroids.window import Array
from service.observations.scans.line_peaks import line_peaks


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
    u = line_peaks(light.sum(axis=0), noise_sigma * np.sqrt(image.shape[0]) * threshold_sigmas)
    v = line_peaks(light.sum(axis=1), noise_sigma * np.sqrt(image.shape[1]) * threshold_sigmas)
    if len(u) != len(v):
        why = f"{len(u)} stars by columns, {len(v)} by rows: some stand in one line"
        return RasterStars(u, v, why)
    return RasterStars(u, v, None if len(u) else "no line stands out of the noise")
