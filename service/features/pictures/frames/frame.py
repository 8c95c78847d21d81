"""A frame of a star camera: the counts of one exposure, with the data stated by its file."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.errors import BadFile, Fault

AS_STORED = "as stored"
CountArray = npt.NDArray[Any]
"""An image of counts (rows, columns), float32 or float64; NaN where a pixel holds no number."""

LEAST_KNOWN, MOST_FULL = 0.5, 0.5
"""Least share of pixels with a number, and largest share of saturated pixels, in a frame."""
LARGEST_COUNT = float(np.finfo(np.float32).max)
"""Largest count that detection, in single precision, can represent."""


@dataclass(frozen=True)
class Frame:
    """The counts of one exposure (rows, columns), with the digest, time and exposure of their file.

    `full_scale` is the largest count that the file's number type can hold, infinite for floating
    point. `time` is the UTC of mid exposure as text and `exposure_s` the exposure, each None where
    the file does not state it; `no_time` is then the reason. `orientation` states how the counts
    were turned from the file's order, and `remarks` name other choices.
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
    """True if only the mirrored image matches the sky; `counts` are mirrored then."""
    remarks: tuple[str, ...] = ()
    pixel_ratio: float | None = None
    """The width of a pixel over its height, if the file or its sender states it."""

    @property
    def is_turned(self) -> bool:
        """True if the counts are in another pixel order than in the file."""
        return self.orientation != AS_STORED

    @property
    def width_px(self) -> int:
        """The width of the frame: its number of columns."""
        return int(self.counts.shape[1])

    @property
    def height_px(self) -> int:
        """The height of the frame: its number of rows."""
        return int(self.counts.shape[0])


@dataclass(frozen=True)
class FrameLimits:
    """Limits for a decoded file: `max_pixels`, and the (rows, columns) that it must have."""

    max_pixels: int
    shape: tuple[int, int] | None = None
    whose: str = "the tracker"
    image: str | None = None
    """The chosen image in a file of several: `NAME`, `NUMBER`, or with `:PLANE` of a cube."""

    def require(self, width_px: int, height_px: int) -> None:
        """Raise `BadFile` for a picture size beyond the limits; called before any decoding."""
        size = f"{width_px} x {height_px} px"
        if width_px < 1 or height_px < 1:
            raise bad_frame("has no pixels", size)
        if self.shape is not None and (height_px, width_px) != self.shape:
            rows, columns = self.shape
            raise bad_frame(f"must have the {columns} x {rows} px of {self.whose}", size)
        self.require_pixels(width_px, height_px)

    def require_pixels(self, width_px: int, height_px: int) -> None:
        """Raise `BadFile` for a picture with more pixels than allowed, whatever its sides."""
        if width_px * height_px > self.max_pixels:
            size = f"{width_px} x {height_px} px"
            raise bad_frame(f"may have at most {self.max_pixels:,} pixels", size)

    def require_either_way(self, width_px: int, height_px: int) -> None:
        """Raise `BadFile` for a picture size that does not fit, even if rotated by 90 degrees."""
        is_turned = self.shape == (width_px, height_px)
        self.require(*((height_px, width_px) if is_turned else (width_px, height_px)))


def bad_frame(message: str, value: str | None = None) -> BadFile:
    """An error that refuses a whole frame, with the message and the offending value."""
    return BadFile(Fault("frame", message, value))


def require_light(frame: Frame, saturation_counts: float) -> None:
    """Raise `BadFile` for counts without visible stars: no numbers, no contrast, or all saturated.

    Also for counts of either sign that are too large for single precision.
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
        message = f"is saturated, or in another unit: a pixel is full at {full_counts:g} counts"
        raise bad_frame(message, f"{full:.0%} of its pixels are full")
