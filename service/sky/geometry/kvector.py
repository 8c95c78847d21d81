"""The k-vector: range look-up in a sorted column without a search.

A straight line approximates the sorted values, and for each of its points the number of values
below is stored. A range of values then takes two look-ups, whatever the length of the column,
instead of a bisection (Mortari & Neta, "k-vector range searching techniques", 2000).
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.compiled.jit import njit
from service.vectors import Vector, read_only


@dataclass(frozen=True)
class KVector:
    """A sorted column of numbers with its k-vector.

    `value` (N,) ascends.  The line is z(j) = slope * j + intercept for j = 1 to
    the length of `below`, and `below[j - 1]` the number of values not above
    z(j): none at its first point, all at its last.
    """

    value: Vector
    below: npt.NDArray[np.int32]  # K
    slope: float  # m
    intercept: float  # q

    @property
    def nbytes(self) -> int:
        """The size of the column and its k-vector in memory, in bytes."""
        return self.value.nbytes + self.below.nbytes


def build_kvector(value: Vector) -> KVector:
    """The k-vector of finite values in ascending order, which may be empty."""
    value = np.ascontiguousarray(value, dtype=np.float64)
    if len(value) == 0:
        return KVector(read_only(value), read_only(np.zeros(1, np.int32)), 1.0, 0.0)
    least, most = float(value[0]), float(value[-1])
    # The line begins below the least value and ends above the greatest.
    largest = max(abs(least), abs(most))
    margin = max(np.finfo(np.float64).eps * largest, np.finfo(np.float64).tiny)  # xi
    points = max(2, len(value))
    slope = (most - least + 2.0 * margin) / (points - 1)
    intercept = least - slope - margin
    line = slope * np.arange(1, points + 1) + intercept
    below = np.searchsorted(value, line, "right").astype(np.int32)
    below[0], below[-1] = 0, len(value)
    return KVector(read_only(value), read_only(below), slope, intercept)


@njit(nogil=True)
def bracket(below, slope, intercept, low, high):  # type: ignore[no-untyped-def]
    """The first row, and the one past the last, between which a k-vector places a range of values.

    They include every value between `low` and `high`, except for rounding of the line, and on
    average one more row in total.
    """
    last = len(below)
    first_point = (low - intercept) / slope
    last_point = (high - intercept) / slope
    # Also beyond the line's ends, and where an integer could not hold the quotient.
    jb = 1 if not first_point > 1.0 else last if first_point >= last else math.floor(first_point)
    jt = 1 if not last_point > 1.0 else last if last_point >= last else math.ceil(last_point)
    return below[int(jb) - 1], below[int(jt) - 1]


@njit(nogil=True)
def rows_within(value, below, slope, intercept, low, high):  # type: ignore[no-untyped-def]
    """The first row, and the one past the last, of exactly the values with low <= value <= high.

    The bracket is trimmed at its ends, and widened where rounding of the line excluded a value. An
    empty range gives two equal rows.
    """
    first, end = bracket(below, slope, intercept, low, high)
    while first > 0 and value[first - 1] >= low:
        first -= 1
    while first < len(value) and value[first] < low:
        first += 1
    end = max(first, end)
    while end < len(value) and value[end] <= high:
        end += 1
    while end > first and value[end - 1] > high:
        end -= 1
    return first, end
