"""A cutout of a frame about one star, and what is known of its noise.

Pixels are counted from 0; the centre of the frame's first pixel is (0.0, 0.0).
u runs along columns and v along rows, so that counts[row, column] = counts[v, u].
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault

Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Detector:
    """What turns light into counts: gain, the noise of reading (and of dark current), full well."""

    gain_e_per_count: float = 1.0
    read_noise_e: float = 0.0
    saturation_counts: float = math.inf

    def __post_init__(self) -> None:
        for name, value, least in (
            ("gain_e_per_count", self.gain_e_per_count, math.ulp(0.0)),
            ("read_noise_e", self.read_noise_e, 0.0),
        ):
            if not (math.isfinite(value) and value >= least):
                word = "at least" if least == 0.0 else "above"
                raise BadInput(Fault(f"detector.{name}", f"must be {word} zero", str(value)))
        if not self.saturation_counts > 0.0:
            raise BadInput(
                Fault(
                    "detector.saturation_counts", "must be above zero", str(self.saturation_counts)
                )
            )

    def variance(self, light_counts: npt.ArrayLike) -> Array:
        """The variance of a pixel (counts²) at a level of light; negative light has no noise."""
        light = np.maximum(np.asarray(light_counts, dtype=np.float64), 0.0)
        gain = self.gain_e_per_count
        return np.asarray((self.read_noise_e / gain) ** 2 + light / gain)


@dataclass(frozen=True)
class Window:
    """A cutout, (rows, columns) of counts with the background in them.

    `background_counts` is the level below the star, a number or an array of the
    same shape; its photon noise is counted.  `good` is False where a pixel is not
    to be believed.  `cut` says that the frame's edge cut the window that was wanted.
    """

    counts: Array
    detector: Detector = Detector()
    background_counts: float | Array = 0.0
    background_sigma_counts: float = 0.0
    corner_u_px: int = 0
    corner_v_px: int = 0
    good: Mask | None = None
    cut: bool = False

    def __post_init__(self) -> None:
        if self.counts.ndim != 2 or min(self.counts.shape) < 3:
            shape = str(self.counts.shape)
            raise BadInput(Fault("window.counts", "must have at least 3 rows and 3 columns", shape))
        if self.good is not None and self.good.shape != self.counts.shape:
            raise BadInput(
                Fault("window.good", f"must be {self.counts.shape}", str(self.good.shape))
            )
        if np.shape(self.background_counts) not in ((), self.counts.shape):
            raise BadInput(
                Fault(
                    "window.background_counts",
                    f"must be one number or {self.counts.shape}",
                    str(np.shape(self.background_counts)),
                )
            )

    @cached_property
    def usable(self) -> Mask:
        """Where a pixel holds a believable number below saturation."""
        finite = np.isfinite(self.counts) & (self.counts < self.detector.saturation_counts)
        return finite if self.good is None else finite & self.good

    @cached_property
    def saturated(self) -> Mask:
        """Where a pixel is full."""
        return np.asarray(self.counts >= self.detector.saturation_counts)

    @cached_property
    def light_counts(self) -> Array:
        """Counts above the background; zero where a pixel is not usable."""
        return np.where(self.usable, self.counts - self.background_counts, 0.0)

    @cached_property
    def floor_variance(self) -> Array:
        """The variance of every pixel (counts²) without the star."""
        level = np.broadcast_to(self.background_counts, self.counts.shape)
        return self.detector.variance(level)


def cutout(
    frame: Array,
    u_px: float,
    v_px: float,
    half_width_px: int,
    detector: Detector,
    background_counts: float | Array,
    background_sigma_counts: float = 0.0,
    good: Mask | None = None,
) -> Window:
    """The window of 2 half_width + 1 pixels about (u, v), clipped at the frame's edge.

    `background_counts` and `good` may be arrays of the frame's shape.  Raises
    `BadInput` where fewer than three rows or columns of it lie in the frame.
    """
    if not (math.isfinite(u_px) and math.isfinite(v_px)):
        raise BadInput(Fault("u_px, v_px", "must be finite", f"{u_px}, {v_px}"))
    rows, columns = frame.shape
    left, top = round(u_px) - half_width_px, round(v_px) - half_width_px
    right, bottom = round(u_px) + half_width_px + 1, round(v_px) + half_width_px + 1
    inside = slice(max(top, 0), max(bottom, 0)), slice(max(left, 0), max(right, 0))
    return Window(
        counts=np.asarray(frame[inside], dtype=np.float64),
        detector=detector,
        background_counts=(
            background_counts
            if np.ndim(background_counts) == 0
            else np.asarray(background_counts)[inside]
        ),
        background_sigma_counts=background_sigma_counts,
        corner_u_px=inside[1].start,
        corner_v_px=inside[0].start,
        good=None if good is None else good[inside],
        cut=left < 0 or top < 0 or right > columns or bottom > rows,
    )
