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
from service.imaging.centroids.fit_result import record_of
from service.imaging.centroids.moments import by_moments
from service.imaging.centroids.psf import Psf
from service.imaging.centroids.record import CentroidRecord
from service.imaging.centroids.recursive import recursive_fit
from service.imaging.centroids.region import brightest_pixel
from service.imaging.centroids.shape_fit import fit
from service.imaging.centroids.window import Window

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
) -> CentroidRecord:
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
    way = fit if method == "matched" else recursive_fit
    found = way(window, psf, (column, row), half_width_px, recentre)
    return record_of(method, found, psf, half_width_px, window)


def _start(window: Window, start: tuple[float, float] | None) -> tuple[float, float]:
    if start is None:
        return brightest_pixel(window)
    if not all(map(math.isfinite, start)):
        raise BadInput(Fault("start", "must be finite", str(start)))
    return start[0] - window.corner_u_px, start[1] - window.corner_v_px
