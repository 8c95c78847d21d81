"""The record of a frame beside the batch that was made of it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class FrameRecord:
    """A frame as the records keep it: what was found on it, and a small picture.

    `stars` has an entry for every candidate that was measured, ready for JSON; those
    with `used` came first, are in the batch, and stand there in the same order.  The
    preview is a PNG of 8 bits in which `preview_step` pixels a side make one.
    """

    digest: str
    file_format: str
    tracker: str
    width_px: int
    height_px: int
    exposure_s: float
    centroid: str
    background_counts: float
    noise_counts: float
    candidates: int
    sharp: Sequence[tuple[float, float]]
    """The places (u, v) of hot pixels and cosmic rays that were left out."""
    stars: Sequence[Mapping[str, Any]]
    timings_us: Mapping[str, int]
    preview: bytes
    preview_step: int
    remarks: Sequence[str] = ()
    """What was fitted of a camera without calibration, or why nothing was found; which image of
    a file was taken, and how its pixels were turned."""

    def summary(self) -> dict[str, Any]:
        """The part of the answer that is about the frame."""
        used = sum(bool(star["used"]) for star in self.stars)
        plain = (
            *("tracker", "width_px", "height_px", "exposure_s", "centroid"),
            *("background_counts", "noise_counts", "candidates"),
        )
        return {
            "digest": self.digest,
            "format": self.file_format,
            **{name: getattr(self, name) for name in plain},
            "measured": len(self.stars),
            "used": used,
            "hot_or_cosmic": len(self.sharp),
            "timings_us": dict(self.timings_us),
            **({"remarks": list(self.remarks)} if self.remarks else {}),
        }


def rounded_counts(value: float, digits: int) -> float:
    """A number of counts rounded to digits behind the point, or to four of its own if small."""
    if not math.isfinite(value) or value == 0.0 or abs(value) >= 100.0 * 10.0**-digits:
        return round(value, digits)
    return round(value, 3 - math.floor(math.log10(abs(value))))
