"""Shares over time: geometry of a sparkline, and bytes of a heat map that the browser draws."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from service.vectors import Matrix, Vector

WIDTH, HEIGHT = 152, 38
PAD = 2
TOPS = (0.05, 0.1, 0.25, 0.5, 1.0)
"""Possible top values of a sparkline, so that few stars do not look like many."""


@dataclass(frozen=True)
class SparklineDrawing:
    """SVG path for each quantity; a lone cell is a dot, drawn as a line of zero length."""

    paths: Mapping[str, str]
    width: int
    height: int


def common_top(greatest: float) -> float:
    """Share at the top of every sparkline of a page."""
    return next(top for top in TOPS if greatest <= top or top == TOPS[-1])


def sparkline(
    shares: Mapping[str, Vector], top: float, width: int = WIDTH, height: int = HEIGHT
) -> SparklineDrawing:
    """Sparkline of shares in cells of equal width; NaN marks a cell without a batch."""
    paths = {name: _path(values, top, width, height) for name, values in shares.items()}
    return SparklineDrawing(paths, width, height)


def _path(values: Vector, top: float, width: int, height: int) -> str:
    """SVG path in whole, relative pixels: a fleet's page has thousands of points."""
    known = np.isfinite(values)
    step = (width - 2 * PAD) / max(len(values) - 1, 1)
    xs = np.rint(PAD + step * np.arange(len(values))).astype(int).tolist()
    part = np.minimum(np.where(known, values, 0.0) / top, 1.0)
    ys = np.rint(height - PAD - part * (height - 2 * PAD)).astype(int).tolist()
    text: list[str] = []
    before, level = None, 0
    for x, y, is_known in zip(xs, ys, known.tolist(), strict=True):
        if before is not None and is_known and y == before[1]:
            level += x - before[0]
        else:
            if before is not None:
                text += _level(level, is_end=not is_known, text=text)
            level = 0
            if is_known:
                text.append(f"l{x - before[0]} {y - before[1]}" if before else f"M{x} {y}")
        before = (x, y) if is_known else None
    return "".join(text + _level(level, is_end=True, text=text))


def _level(length: int, is_end: bool, text: list[str]) -> list[str]:
    """Horizontal step of a length: none of zero length, except the dot of a lone point."""
    is_lone = is_end and bool(text) and text[-1].startswith("M")
    return [f"h{length}"] if length or is_lone else []


LEVELS = 254
"""Number of levels of a share; level 0 means no batch, level 1 the share 0."""


def packed(shares: Matrix) -> str:
    """Shares as one byte per cell, row by row, in base64; NaN marks a cell without a batch."""
    known = np.isfinite(shares)
    levels = 1 + np.rint(np.clip(np.where(known, shares, 0.0), 0.0, 1.0) * LEVELS)
    return base64.b64encode(np.where(known, levels, 0).astype(np.uint8).tobytes()).decode()
