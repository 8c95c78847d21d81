"""A cutout of a frame about one star, its noise, and the record of a centroid in it.

The record is the result of every centroid method: a place with its errors, or the reason for having
none. Pixels are counted from 0; the centre of the frame's first pixel is (0.0, 0.0). u runs along
columns and v along rows, so that counts[row, column] = counts[v, u].
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault
from service.observations.scans.lines import BREAKDOWN_RATIO


class Flag(StrEnum):
    """A warning about the image of a star, such as saturation or a cut by the edge."""

    SATURATED = "saturated"
    EDGE = "edge"
    BLENDED = "blended"
    TOO_FAINT = "too_faint"
    OUTSIDE = "outside_hump"
    MASKED = "masked_pixels"
    TRUNCATED = "truncated"
    NOT_CONVERGED = "not_converged"


@dataclass(frozen=True)
class CentroidRecord:
    """The measured centroid of one star on the sensor, or the reason why it has none.

    `u_px`, `v_px` count along columns and rows of the frame, the centre of its first pixel at (0,
    0); `sigma_*` are predicted, one standard deviation per axis, and `correlation_uv` is their
    correlation. `signal_ratio` is the light that the method sums over the noise of that sum.
    `truncation_*_px` is the bias of a plain moment by light outside the window and by sampling,
    already corrected where the method knew the PSF. Where `refused` holds a reason, place and
    sigmas are NaN.
    """

    method: str
    u_px: float
    v_px: float
    sigma_u_px: float
    sigma_v_px: float
    correlation_uv: float
    flux_counts: float
    sigma_flux_counts: float
    signal_ratio: float
    truncation_u_px: float = 0.0
    truncation_v_px: float = 0.0
    iterations: int = 1
    flags: tuple[Flag, ...] = ()
    refused: str | None = None

    @property
    def usable(self) -> bool:
        """True if a centroid of the star was found, with flags or without."""
        return self.refused is None


def refusal(
    method: str,
    why: str,
    flags: tuple[Flag, ...],
    flux_counts: float = math.nan,
    sigma_flux_counts: float = math.nan,
    signal_ratio: float = math.nan,
    iterations: int = 1,
) -> CentroidRecord:
    """A centroid record without a place, with the reason why."""
    nan = math.nan
    return CentroidRecord(
        method, nan, nan, nan, nan, nan, flux_counts, sigma_flux_counts, signal_ratio,
        iterations=iterations, flags=flags, refused=why,
    )  # fmt: skip


def too_faint(
    method: str, flux_counts: float, sigma_flux_counts: float, flags: tuple[Flag, ...]
) -> CentroidRecord:
    """Centroid record that refuses a star whose light is below the breakdown ratio to its noise."""
    ratio = flux_counts / sigma_flux_counts if sigma_flux_counts > 0.0 else 0.0
    why = f"its light is {ratio:.2f} times the noise, below {BREAKDOWN_RATIO:g}"
    return refusal(method, why, (*flags, Flag.TOO_FAINT), flux_counts, sigma_flux_counts, ratio)


Array = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Detector:
    """A detector's gain, readout noise (including dark current) and saturation level."""

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
        """Variance of pixels (counts²) at a level of light; negative light adds no photon noise."""
        light = np.maximum(np.asarray(light_counts, dtype=np.float64), 0.0)
        gain = self.gain_e_per_count
        return np.asarray((self.read_noise_e / gain) ** 2 + light / gain)


@dataclass(frozen=True)
class Window:
    """A cutout of a frame about one star: counts (rows, columns) that still include the background.

    `background_counts` is the level below the star, a number or an array of the same shape; its
    photon noise is included. `good` is False for unusable pixels. `cut` is true if the frame's edge
    made the window smaller.
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
        """True for pixels that hold a finite, unmasked count below saturation."""
        finite = np.isfinite(self.counts) & (self.counts < self.detector.saturation_counts)
        return finite if self.good is None else finite & self.good

    @cached_property
    def saturated(self) -> Mask:
        """True for saturated pixels."""
        return np.asarray(self.counts >= self.detector.saturation_counts)

    @cached_property
    def light_counts(self) -> Array:
        """Counts above the background; zero for unusable pixels."""
        return np.where(self.usable, self.counts - self.background_counts, 0.0)

    @cached_property
    def floor_variance(self) -> Array:
        """The variance (counts²) of every pixel without the star's photon noise."""
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
    """The window of 2 half_width + 1 pixels a side about (u, v), clipped at the frame's edge.

    `background_counts` and `good` may be arrays of the frame's shape. Raises `BadInput` where fewer
    than three rows or columns of the window lie in the frame.
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


@dataclass(frozen=True)
class Region:
    """A rectangle of pixels in a window about one of its pixels (column, row).

    `left`, `right`, `above`, `below` count the pixels on each side of that pixel.
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
        """The index slices that cut a rectangle out of the arrays of its window."""
        return (
            slice(self.row - self.above, self.row + self.below + 1),
            slice(self.column - self.left, self.column + self.right + 1),
        )

    @cached_property
    def du(self) -> Array:
        """Distances of the rectangle's columns from its middle pixel, as a row that broadcasts."""
        return np.arange(-self.left, self.right + 1, dtype=np.float64)[None, :]

    @cached_property
    def dv(self) -> Array:
        """Distances of the rectangle's rows from its middle pixel, as a column that broadcasts."""
        return np.arange(-self.above, self.below + 1, dtype=np.float64)[:, None]

    @cached_property
    def light(self) -> Array:
        """Counts above the background in the rectangle; zero for unusable pixels."""
        return self.window.light_counts[self.inside]

    @cached_property
    def floor_variance(self) -> Array:
        """The variance (counts²) of the rectangle's pixels without the star's photon noise."""
        return self.window.floor_variance[self.inside]

    @cached_property
    def usable(self) -> Mask:
        """True for the rectangle's pixels that hold a finite, unmasked count below saturation."""
        return self.window.usable[self.inside]

    def flags(self, wanted_half: int) -> tuple[Flag, ...]:
        """Warnings about a rectangle's pixels: saturated, masked, or cut by the frame's edge."""
        saturated = self.window.saturated[self.inside]
        reach = min(self.left, self.right, self.above, self.below)
        named = (
            (bool(saturated.any()), Flag.SATURATED),
            (bool((~self.usable & ~saturated).any()), Flag.MASKED),
            (self.window.cut and reach < wanted_half, Flag.EDGE),
        )
        return tuple(flag for is_set, flag in named if is_set)


def square_about(window: Window, column: int, row: int, half: int) -> Region | None:
    """The square of 2 half + 1 pixels a side about a pixel, clipped at the edge of the window.

    None where that pixel is outside the window.
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
    """Largest square, of at most 2 half + 1 pixels a side, centred on a pixel within the window.

    A moment needs both sides. None where not even the neighbours of the pixel are inside.
    """
    cut = square_about(window, column, row, half)
    if cut is None:
        return None
    reach = min(cut.left, cut.right, cut.above, cut.below)
    return None if reach < 1 else Region(window, column, row, reach, reach, reach, reach)


def brightest_pixel(window: Window) -> tuple[int, int]:
    """(column, row) of the middle of a window's brightest 3 x 3 pixels, cut off at saturation."""
    # This module is imported at the service's start, which avoids scipy.
    from scipy.ndimage import correlate

    counts = np.minimum(window.counts, window.detector.saturation_counts) - window.background_counts
    known = np.isfinite(counts) if window.good is None else np.isfinite(counts) & window.good
    summed = correlate(np.where(known, counts, 0.0), np.ones((3, 3)), mode="constant")
    # The rim of the window has no full 3 x 3 neighbourhood.
    row, column = divmod(int(np.argmax(summed[1:-1, 1:-1])), summed.shape[1] - 2)
    return column + 1, row + 1
