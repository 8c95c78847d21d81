"""What a dark frame shows: the light that the sensor makes by itself, and its hot pixels."""

from dataclasses import replace

import numpy as np

from service.imaging.frames.frame import CountArray, Frame, bad_frame

HOT_SIGMAS = 8.0
"""Above the median of a dark frame: such a pixel's own noise hides what falls on it."""


def without_dark(frame: Frame, dark: Frame) -> Frame:
    """A frame less its dark frame, of the same exposure; hot pixels hold no number.

    Raises `BadFile` for a dark frame of another size.
    """
    if dark.counts.shape != frame.counts.shape:
        size = f"{dark.width_px} x {dark.height_px} px"
        wanted = f"{frame.width_px} x {frame.height_px} px"
        raise bad_frame(f"must have the size of its dark frame, {size}", wanted)
    counts = np.array(frame.counts - dark.counts)
    counts[hot_pixels(dark.counts)] = np.nan
    return replace(frame, counts=counts)


def hot_pixels(dark: CountArray) -> CountArray:
    """Whether a pixel (rows, columns) of a dark frame stands out, or holds no number."""
    middle = np.nanmedian(dark)
    # Counts are whole numbers: a quiet sensor may have a spread of none.
    spread = max(1.48 * float(np.nanmedian(np.abs(dark - middle))), 0.5)
    return np.asarray(~(dark < middle + HOT_SIGMAS * spread))
