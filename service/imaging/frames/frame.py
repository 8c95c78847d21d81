"""A frame: the counts of one exposure, and what its file says of itself."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadFile, Fault

AS_STORED = "as stored"
CountArray = npt.NDArray[Any]
"""(rows, columns), float32 or float64; NaN where a pixel holds no number."""

LEAST_KNOWN, MOST_FULL = 0.5, 0.5
"""Shares of a frame: of pixels with a number in them, and of full ones."""
LARGEST_COUNT = float(np.finfo(np.float32).max)
"""Detection works in single precision: there a larger count is infinite."""


@dataclass(frozen=True)
class Frame:
    """Counts with the digest of their file.

    `full_scale` is the largest count that the file's numbers can hold, infinite for
    floating ones.  `time` is the UTC of mid exposure as text and `exposure_s` the
    exposure, each None where the file does not tell; `no_time` is then the reason.
    `orientation` is how the counts were turned from the order in which the file stores
    them, and `remarks` name what else was chosen.
    """

    counts: CountArray
    file_format: str
    digest: str
    full_scale: float = math.inf
    time: str | None = None
    exposure_s: float | None = None
    no_time: str = "the file has no time of exposure"
    orientation: str = AS_STORED
    is_mirrored: bool = False
    """True if the sky fits only the mirror image, which the counts then are."""
    remarks: tuple[str, ...] = ()

    @property
    def is_turned(self) -> bool:
        """True if the counts are in another order than in the file."""
        return self.orientation != AS_STORED

    @property
    def width_px(self) -> int:
        """Columns."""
        return int(self.counts.shape[1])

    @property
    def height_px(self) -> int:
        """Rows."""
        return int(self.counts.shape[0])


@dataclass(frozen=True)
class FrameLimits:
    """What a file may unfold into: `max_pixels`, and the (rows, columns) that it must have."""

    max_pixels: int
    shape: tuple[int, int] | None = None
    whose: str = "the tracker"
    image: str | None = None
    """Which image of a file with several: `NAME`, `NUMBER`, or either with `:PLANE` of a cube."""

    def require(self, width_px: int, height_px: int) -> None:
        """Raise `BadFile` for a size that is not to be decoded; asked before anything is."""
        size = f"{width_px} x {height_px} px"
        if width_px < 1 or height_px < 1:
            raise bad_frame("has no pixels", size)
        if self.shape is not None and (height_px, width_px) != self.shape:
            rows, columns = self.shape
            raise bad_frame(f"must have the {columns} x {rows} px of {self.whose}", size)
        self.require_pixels(width_px, height_px)

    def require_pixels(self, width_px: int, height_px: int) -> None:
        """Raise `BadFile` for more pixels than are allowed, whatever the sides."""
        if width_px * height_px > self.max_pixels:
            size = f"{width_px} x {height_px} px"
            raise bad_frame(f"may have at most {self.max_pixels:,} pixels", size)

    def require_either_way(self, width_px: int, height_px: int) -> None:
        """Raise `BadFile` for a size that does not fit, even turned by a quarter."""
        is_turned = self.shape == (width_px, height_px)
        self.require(*((height_px, width_px) if is_turned else (width_px, height_px)))


def bad_frame(message: str, value: str | None = None) -> BadFile:
    """The refusal of a frame as a whole."""
    return BadFile(Fault("frame", message, value))


def require_light(frame: Frame, saturation_counts: float) -> None:
    """Raise `BadFile` for counts in which no star can be: no numbers, no contrast, all full.

    Also for a count that is too large to work with, of either sign.
    """
    known = np.isfinite(frame.counts)
    share = np.count_nonzero(known) / known.size
    if share < LEAST_KNOWN:
        raise bad_frame("has no number in most of its pixels", f"NaN in {1.0 - share:.0%}")
    numbers = frame.counts if share == 1.0 else frame.counts[known]
    least, most = float(numbers.min()), float(numbers.max())
    largest = max(least, most, key=abs)
    if abs(largest) > LARGEST_COUNT:
        message = f"holds a count beyond {LARGEST_COUNT:.4g}, the largest of single precision"
        raise bad_frame(message, f"{largest:.4g}")
    if least == most:
        raise bad_frame("has no contrast: every pixel holds the same count", f"{least:g}")
    full_counts = min(saturation_counts, frame.full_scale)
    full = np.count_nonzero(frame.counts >= full_counts) / known.size
    if full > MOST_FULL:
        raise bad_frame("is saturated", f"{full:.0%} of its pixels are full")
