"""Map of a tracker's residuals over its focal plane in a period."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from service.storage.queries.period import TrackerStarsOfPeriod
from service.vectors import Vector

SIZE = 420.0
CELLS = 8
"""Number of cells along each side of the square about the field of view."""
LEAST_STARS = 5
"""Least number of stars in a cell whose mean residual gets an arrow."""
LONGEST = 1.1
"""Length of the longest arrow of a residual map, in cells."""
CLEAR = 3.3
"""Least clear mean residual in standard errors; without distortion one cell in 300 has it."""
STEPS = (1.25, 1.5, 2.0, 3.0)
"""Ratios of spread to expected spread at which a cell gets the next shade."""
ROUND = (1.0, 2.0, 5.0)
OUTLIER = 3.0
"""Length in medians beyond which an arrow is cut: a single wrong star leaves the others visible."""


def longest_drawn(lengths: Sequence[float]) -> float:
    """Residual of the longest arrow of a picture; longer ones are cut to it, see `cut`."""
    longest = max(lengths, default=0.0)
    return min(longest, OUTLIER * float(np.median(lengths)) or longest) if longest else 0.0


def cut(along: float, down: float, most_px: float) -> tuple[float, float, bool]:
    """Arrow in pixels of at most a length, in its own direction; true if it was longer."""
    length = math.hypot(along, down)
    if length <= most_px * 1.000001:
        return along, down, False
    return along * most_px / length, down * most_px / length, True


@dataclass(frozen=True)
class Cell:
    """Cell of the map: centre, stars, mean residual, and ratio of the spread to the expected one.

    `is_clear` is true if the mean is certainly not from noise alone.
    """

    h_deg: float
    v_deg: float
    stars: int
    mean_arcsec: tuple[float, float]
    spread: float
    is_clear: bool
    x: float
    y: float
    shade: int
    arrow: str
    """SVG path of the arrow for the mean residual; empty with too few stars."""
    is_cut: bool
    """True if the mean residual is longer than its arrow."""


@dataclass(frozen=True)
class FocalPlaneMap:
    """Map of residuals; `key_px` is the length of an arrow of `key_arcsec`."""

    tracker: str
    cells: tuple[Cell, ...]
    stars: int
    spread: float
    radius_deg: float
    key_arcsec: float
    key_px: float
    side: float = SIZE / CELLS
    size: float = SIZE
    steps: tuple[float, ...] = STEPS

    @property
    def cut_arcsec(self) -> list[float]:
        """Mean residuals that are longer than their arrows, the longest first."""
        lengths = [math.hypot(*each.mean_arcsec) for each in self.cells if each.is_cut]
        return sorted(lengths, reverse=True)


def focal_plane_map(tracker: TrackerStarsOfPeriod) -> FocalPlaneMap | None:
    """Map of a tracker's residuals; None if no star has a residual."""
    known = np.isfinite(tracker.residual_arcsec[:, 0]) & np.isfinite(tracker.expected_arcsec).all(
        axis=1
    )
    place, residual = tracker.place_deg[known], tracker.residual_arcsec[known]
    expected, radius_deg = tracker.expected_arcsec[known], tracker.field_of_view_radius_deg
    if not len(place):
        return None
    step_deg = 2.0 * radius_deg / CELLS
    # Stars beyond the field of view belong to the cells at its edge.
    number = np.clip(np.floor((place + radius_deg) / step_deg), 0, CELLS - 1).astype(int)
    cell = number[:, 1] * CELLS + number[:, 0]
    found = [_of_cell(residual[cell == k], expected[cell == k]) for k in np.unique(cell)]
    lengths = [math.hypot(*mean) for count, mean, *_ in found if count >= LEAST_STARS]
    longest = longest_drawn(lengths)
    px_per_arcsec = LONGEST * SIZE / CELLS / longest if longest else 0.0
    cells = [
        _drawn(int(k), each, radius_deg, px_per_arcsec)
        for k, each in zip(np.unique(cell), found, strict=True)
    ]
    key_arcsec = round_below(longest)
    return FocalPlaneMap(
        tracker=tracker.tracker,
        cells=tuple(cells),
        stars=len(place),
        spread=_spread(residual, expected),
        radius_deg=radius_deg,
        key_arcsec=key_arcsec,
        key_px=key_arcsec * px_per_arcsec,
    )


_Found = tuple[int, tuple[float, float], float, bool]


def _of_cell(residual: Vector, expected: Vector) -> _Found:
    """Stars of a cell, mean residual, spread over expected, and whether the mean is clear."""
    mean = residual.mean(axis=0)
    error = np.sqrt(np.mean(expected**2, axis=0) / len(residual))
    spread = _spread(residual, expected)
    # Noisier stars than expected have a less certain mean.
    far = float(np.max(np.abs(mean) / error)) / max(spread, 1.0)
    is_clear = len(residual) >= LEAST_STARS and far > CLEAR
    return len(residual), (float(mean[0]), float(mean[1])), spread, is_clear


def _spread(residual: Vector, expected: Vector) -> float:
    """Root mean square of residuals divided by their expected sigmas; normally 1."""
    return float(np.sqrt(np.mean((residual / expected) ** 2)))


def _drawn(number: int, found: _Found, radius_deg: float, px_per_arcsec: float) -> Cell:
    row, column = divmod(number, CELLS)
    stars, mean, spread, is_clear = found
    side, step_deg = SIZE / CELLS, 2.0 * radius_deg / CELLS
    x, y = (column + 0.5) * side, SIZE - (row + 0.5) * side
    along, down, is_cut = cut(mean[0] * px_per_arcsec, -mean[1] * px_per_arcsec, LONGEST * side)
    return Cell(
        h_deg=(column + 0.5) * step_deg - radius_deg,
        v_deg=(row + 0.5) * step_deg - radius_deg,
        stars=stars,
        mean_arcsec=mean,
        spread=spread,
        is_clear=is_clear,
        x=x,
        y=y,
        shade=sum(spread >= step for step in STEPS),
        arrow=arrow(x - along / 2, y - down / 2, along, down) if stars >= LEAST_STARS else "",
        is_cut=is_cut and stars >= LEAST_STARS,
    )


def arrow(x: float, y: float, along: float, down: float) -> str:
    """SVG path of an arrow with its head."""
    length = math.hypot(along, down)
    if length < 1.0:
        return f"M{x:.1f} {y:.1f}h0"
    u, v = along / length, down / length
    back, wide = min(6.0, length * 0.5), min(3.0, length * 0.3)
    head_x, head_y = x + along - u * back, y + down - v * back
    return (
        f"M{x:.1f} {y:.1f}l{along:.1f} {down:.1f}"
        f"M{head_x - v * wide:.1f} {head_y + u * wide:.1f}L{x + along:.1f} {y + down:.1f}"
        f"L{head_x + v * wide:.1f} {head_y - u * wide:.1f}"
    )


def round_below(longest: float) -> float:
    """Greatest of 1, 2 and 5 times a power of ten up to `longest`; 0 if that is not positive."""
    if longest <= 0.0:
        return 0.0
    power = 10.0 ** math.floor(math.log10(longest))
    return max(factor * power for factor in ROUND if factor * power <= longest * 1.000001)
