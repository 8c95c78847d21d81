"""Stars along one axis as maxima of the sums of raster lines (report on star images, 7.8)."""

import numpy as np

from service.vectors import Vector


def line_peaks(sums: Vector, threshold: float) -> Vector:
    """Places of the maxima of `sums` above `threshold`, rising, in lines from the first one.

    A parabola through three sums refines each, to about half a line.  The first and the last
    line are the place of none.
    """
    padded = np.concatenate([[-np.inf], sums, [-np.inf]])
    before, middle, after = padded[:-2], padded[1:-1], padded[2:]
    at = np.flatnonzero((middle > threshold) & (middle > before) & (middle >= after))
    # Maxima without a valley between them are one star and its noise.
    kept: list[int] = []
    for line in at.tolist():
        if kept and sums[kept[-1] : line + 1].min() > min(sums[kept[-1]], sums[line]) - threshold:
            kept[-1] = max(kept[-1], line, key=lambda each: float(sums[each]))
        else:
            kept.append(line)
    inner = [line for line in kept if 0 < line < len(sums) - 1]
    return np.array([line + _fine(sums, line) for line in inner])


def _fine(sums: Vector, at: int) -> float:
    before, middle, after = sums[at - 1 : at + 2]
    bend = before - 2.0 * middle + after
    return float(0.5 * (before - after) / bend) if bend < 0.0 else 0.0
