"""Bounds that chance alone breaks less than once in 100,000 seeds.

A test that draws holds what it counts against one of these, made of the rate that the product
promises: then a right build passes with any seed, and a wrong one is beyond the bound.
"""

import numpy as np
import numpy.typing as npt
from scipy.stats import binom, chi2

TAIL = 1e-5


def at_most(tries: int, share: float) -> int:
    """The largest count of events of probability `share` among independent `tries`."""
    return int(binom.isf(TAIL, tries, share))


def at_least(tries: int, share: float) -> int:
    """The smallest count of events of probability `share` among independent `tries`."""
    return int(binom.ppf(TAIL, tries, share))


def assert_chi_square(values: npt.ArrayLike, degrees: int) -> None:
    """Hold the sum of independent values of chi-square against its distribution."""
    n = degrees * np.size(values)
    assert chi2.ppf(TAIL, n) < np.sum(values) < chi2.isf(TAIL, n)
