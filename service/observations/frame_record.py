"""The record of a frame, stored beside the batch made from it."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class FrameRecord:
    """A processed frame as stored: its measured candidates and a small preview picture.

    `stars` has an entry for every measured candidate, ready for JSON; those with `used` come first
    and are in the batch in the same order. The preview is an 8-bit PNG whose pixels are
    `preview_step` frame pixels a side.
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
    """The places (u, v) of rejected hot pixels and cosmic rays."""
    stars: Sequence[Mapping[str, Any]]
    timings_us: Mapping[str, int]
    preview: bytes
    preview_step: int
    remarks: Sequence[str] = ()
    """Remarks on the fit of an uncalibrated camera, the chosen image, and its orientation."""

    def summary(self) -> dict[str, Any]:
        """The part of an answer that describes the frame, ready for JSON."""
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
    """A number of counts rounded to `digits` decimals, or to four significant digits if small."""
    if not math.isfinite(value) or value == 0.0 or abs(value) >= 100.0 * 10.0**-digits:
        return round(value, digits)
    return round(value, 3 - math.floor(math.log10(abs(value))))
