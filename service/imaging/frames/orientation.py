"""Pictures turned to the way that a viewer shows them, by the orientation tag of EXIF and TIFF."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from service.imaging.frames.frame import AS_STORED, CountArray, Frame

TAG = 274
_TURNS: Mapping[int, str] = {
    2: "left and right exchanged",
    3: "turned by 180 deg",
    4: "top and bottom exchanged",
    5: "rows and columns exchanged",
    6: "turned by 90 deg clockwise",
    7: "rows and columns exchanged, then turned by 180 deg",
    8: "turned by 90 deg counterclockwise",
}
"""From the order of the stored pixels to the picture that is shown (EXIF 2.32, 4.6.4)."""
QUARTER_TURNS = (5, 6, 7, 8)
"""Tags that exchange width and height."""


def as_shown(counts: CountArray, tag: object) -> tuple[CountArray, str]:
    """Stored counts (rows, columns) as they are shown, and what was done, in words.

    A tag that is none of the eight counts as 1, as in viewers.
    """
    if not isinstance(tag, int) or tag not in _TURNS:
        return counts, AS_STORED
    shown = counts.T if tag in (5, 7) else counts
    if tag in (3, 7):
        shown = shown[::-1, ::-1]
    elif tag in (2, 4):
        shown = shown[:, ::-1] if tag == 2 else shown[::-1]
    elif tag in (6, 8):
        shown = np.rot90(shown, -1 if tag == 6 else 1)
    return np.ascontiguousarray(shown), f"as shown: {_TURNS[tag]} (orientation tag {tag})"


def is_by_rows(frame: Frame) -> bool:
    """True if the mirror image of a frame has its rows in reverse order, not its columns.

    FITS files whose first row is the lowest one are mirrored by a reader that begins at the top.
    """
    return frame.file_format == "FITS"


def mirrored(frame: Frame) -> Frame:
    """The mirror image of a frame, which says so."""
    by_rows = is_by_rows(frame)
    counts = frame.counts[::-1] if by_rows else frame.counts[:, ::-1]
    how = "top and bottom" if by_rows else "left and right"
    before = f"{frame.orientation}; " if frame.is_turned else ""
    return replace(
        frame,
        counts=np.ascontiguousarray(counts),
        orientation=f"{before}mirrored: {how} exchanged, because the sky fits only so",
        is_mirrored=True,
    )
