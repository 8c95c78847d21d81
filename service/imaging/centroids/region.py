"""The pixels that a centroid is made of: where a search begins, and the square about a star."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.ndimage import correlate

from service.imaging.centroids.record import Flag
from service.imaging.centroids.window import Array, Mask, Window


@dataclass(frozen=True)
class Region:
    """A rectangle of a window about its whole pixel (column, row).

    `left`, `right`, `above`, `below` count the pixels on each side of that one.
    """

    window: Window
    column: int
    row: int
    left: int
    right: int
    above: int
    below: int

    @cached_property
    def inside(self) -> tuple[slice, slice]:
        """Where the rectangle stands in the window's arrays."""
        return (
            slice(self.row - self.above, self.row + self.below + 1),
            slice(self.column - self.left, self.column + self.right + 1),
        )

    @cached_property
    def du(self) -> Array:
        """Distance of its columns from the middle pixel, a row that broadcasts."""
        return np.arange(-self.left, self.right + 1, dtype=np.float64)[None, :]

    @cached_property
    def dv(self) -> Array:
        """Distance of its rows from the middle pixel, a column that broadcasts."""
        return np.arange(-self.above, self.below + 1, dtype=np.float64)[:, None]

    @cached_property
    def light(self) -> Array:
        """Counts above the background, zero where not usable."""
        return self.window.light_counts[self.inside]

    @cached_property
    def floor_variance(self) -> Array:
        """Variance without the star, counts²."""
        return self.window.floor_variance[self.inside]

    @cached_property
    def usable(self) -> Mask:
        """Where the pixels may be believed."""
        return self.window.usable[self.inside]

    def flags(self, wanted_half: int) -> tuple[Flag, ...]:
        """What the pixels themselves say: full, masked, cut by the edge of the frame."""
        saturated = self.window.saturated[self.inside]
        reach = min(self.left, self.right, self.above, self.below)
        named = (
            (bool(saturated.any()), Flag.SATURATED),
            (bool((~self.usable & ~saturated).any()), Flag.MASKED),
            (self.window.cut and reach < wanted_half, Flag.EDGE),
        )
        return tuple(flag for said, flag in named if said)


def square_about(window: Window, column: int, row: int, half: int) -> Region | None:
    """The square of 2 half + 1 pixels about a pixel, cut where the window ends.

    None where that pixel itself is outside.
    """
    rows, columns = window.counts.shape
    if not (0 <= column < columns and 0 <= row < rows):
        return None
    return Region(
        window,
        column,
        row,
        left=min(half, column),
        right=min(half, columns - 1 - column),
        above=min(half, row),
        below=min(half, rows - 1 - row),
    )


def symmetric_square_about(window: Window, column: int, row: int, half: int) -> Region | None:
    """The square about a pixel, shrunk on all sides to what the window holds.

    A moment needs both sides.  None where not even the neighbours are there.
    """
    cut = square_about(window, column, row, half)
    if cut is None:
        return None
    reach = min(cut.left, cut.right, cut.above, cut.below)
    return None if reach < 1 else Region(window, column, row, reach, reach, reach, reach)


def brightest_pixel(window: Window) -> tuple[int, int]:
    """(column, row) of the brightest 3 x 3 pixels, by their middle; a full pixel counts as full."""
    counts = np.minimum(window.counts, window.detector.saturation_counts) - window.background_counts
    known = np.isfinite(counts) if window.good is None else np.isfinite(counts) & window.good
    summed = correlate(np.where(known, counts, 0.0), np.ones((3, 3)), mode="constant")
    # The rim lacks a side.
    row, column = divmod(int(np.argmax(summed[1:-1, 1:-1])), summed.shape[1] - 2)
    return column + 1, row + 1
