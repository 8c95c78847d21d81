"""Pictures of square pixels, made of pictures whose pixels have unequal sides."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from service.errors import BadInput, Fault, shown_value
from service.features.pictures.frames.frame import CountArray, Frame

MOST_RATIO = 8.0
"""Largest ratio of the sides of a pixel."""


def averaged(frame: Frame) -> Iterator[tuple[Frame, str]]:
    """Versions of a picture with pixels averaged in pairs, each with a remark on the change."""
    height, width = frame.counts.shape
    for name, counts in (
        ("columns", frame.counts[:, : width // 2 * 2].reshape(height, -1, 2).mean(axis=2)),
        ("rows", frame.counts[: height // 2 * 2].reshape(-1, 2, width).mean(axis=1)),
    ):
        remark = (
            f"unequal_pixels: the pixels fit the sky once pairs of {name} are averaged, as after "
            "binning 1 x 2; places and focal length are in pixels of the averaged picture"
        )
        yield replace(frame, counts=counts), remark


def require_ratio(ratio: float, field: str) -> float:
    """The ratio of the sides of a pixel; raises `BadInput` naming `field` for an impossible one."""
    if not 1.0 / MOST_RATIO <= ratio <= MOST_RATIO:
        message = f"must be from {1.0 / MOST_RATIO:g} to {MOST_RATIO:g}: width over height"
        raise BadInput(Fault(field, message, shown_value(ratio)))
    return ratio


def with_square_pixels(frame: Frame) -> tuple[Frame, str, float]:
    """A picture averaged along the shorter side of its pixels, with a remark on the change.

    The last value is the ratio of a focal length in pixels of the new picture to one in pixels of
    the longer side of the old one.
    """
    ratio = frame.pixel_ratio or 1.0
    # Wide pixels have rows that are too dense.
    axis, count = (0, ratio) if ratio > 1.0 else (1, 1.0 / ratio)
    name = ("rows", "columns")[axis]
    remark = (
        f"unequal_pixels: pixels {ratio:.6g} times as wide as high were made square: {count:.6g} "
        f"{name} were averaged to one; places and focal length are in pixels of that picture"
    )
    longer = int(np.argmax(frame.counts.shape))
    square = replace(frame, counts=_resampled(frame.counts, axis, count), pixel_ratio=None)
    return square, remark, 1.0 / count if longer == axis else 1.0


def _resampled(counts: CountArray, axis: int, count: float) -> CountArray:
    """Means over `count` pixels along an axis, with shares of the pixels at both ends."""
    along: npt.NDArray[np.float64] = np.moveaxis(counts, axis, 0).astype(np.float64)
    edges = np.arange(int(len(along) / count + 1e-9) + 1) * count
    sums = np.concatenate([np.zeros((1, *along.shape[1:])), np.cumsum(along, axis=0)])
    whole = np.minimum(edges.astype(np.int64), len(along) - 1)
    below = sums[whole] + (edges - whole)[:, None] * along[whole]
    return np.ascontiguousarray(np.moveaxis(np.diff(below, axis=0) / count, 0, axis))
