"""The quantisation of a picture's counts: the step between levels, and scaling to single precision.

Counts may be integers, integers divided by 65535, rates in electrons per second, or sums of several
frames. No result may depend on their unit or their zero.
"""

import math
from dataclasses import dataclass

import numpy as np

from service.features.pictures.frames.frame import CountArray

_SAMPLES = 1 << 16
_FEW_LEVELS = 4
_ROUNDING_BITS = 20
"""Bits below the largest count at which single-precision transforms have rounding errors."""
_LEAST_RANGE, _MOST_RANGE = 2.0**-10, 2.0**40
_WHOLE_BITS = 16


@dataclass(frozen=True)
class CountLevels:
    """The step between levels of counts, and a linear scaling of counts to single precision.

    Scaled counts are (counts - `zero_counts`) times `factor`, a power of two.
    """

    step_counts: float
    zero_counts: float
    factor: float

    @property
    def is_as_it_is(self) -> bool:
        """True if counts need no scaling for single precision."""
        return self.zero_counts == 0.0 and self.factor == 1.0

    def scaled(self, counts: CountArray) -> CountArray:
        """Counts less the zero level, times the factor, in single precision."""
        if self.is_as_it_is:
            return np.array(counts, dtype=np.float32)
        with np.errstate(invalid="ignore"):
            scaled = (counts.astype(np.float64) - self.zero_counts) * self.factor
        return np.asarray(scaled, dtype=np.float32)


def count_step(counts: CountArray) -> float:
    """The least difference between levels of counts (rows, columns); 0 where all counts are equal.

    A picture of fewer than four levels gets the step of 8 bits over its range. The step is at least
    the rounding error of single precision at the largest difference.
    """
    return _step(*_sampled(counts))


def levels_of(counts: CountArray) -> CountLevels:
    """The step and single-precision scaling of counts (rows, columns), not-finite ones ignored."""
    levels, least, most = _sampled(counts)
    step, span = _step(levels, least, most), most - least
    zero, factor = 0.0, 1.0
    with np.errstate(over="ignore"):
        is_exact = np.array_equal(levels.astype(np.float32), levels)
    if counts.dtype.itemsize > 4 and not is_exact:
        zero = float(levels[len(levels) // 2])
    if math.isfinite(span) and span > 0.0 and not _LEAST_RANGE <= span <= _MOST_RANGE:
        factor = 2.0 ** (_WHOLE_BITS - math.frexp(span)[1])
    return CountLevels(step, zero, factor)


def _sampled(counts: CountArray) -> tuple[CountArray, float, float]:
    """Distinct levels of a sample of counts, rising, and the least and largest of all counts."""
    flat = counts.ravel()
    # An odd stride samples all columns.
    sample = flat[:: max(flat.size // _SAMPLES, 1) | 1]
    levels = np.unique(sample[np.isfinite(sample)]).astype(np.float64)
    least, most = float(np.min(flat)), float(np.max(flat))
    if not (math.isfinite(least) and math.isfinite(most)):
        known = flat[np.isfinite(flat)]
        least, most = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    return levels, least, most


def _step(levels: CountArray, least: float, most: float) -> float:
    span = most - least
    if len(levels) < _FEW_LEVELS:
        return span / 255.0
    return max(float(np.diff(levels).min()), span * 2.0**-_ROUNDING_BITS)
