"""What an identifier says of the stars of one tracker."""

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt

from service.vectors import Vector

Integers = npt.NDArray[np.int64]


class Outcome(IntEnum):
    """What became of one observed star."""

    UNMATCHED = 0
    UNIQUE = 1
    AMBIGUOUS = 2

    @property
    def word(self) -> str:
        """The outcome as the interface writes it."""
        return self.name.lower()


@dataclass(frozen=True)
class Identification:
    """The identification of one tracker's stars, row by row in the order observed.

    `star` is the row in the run catalog of the unique winner, -1 without one.
    `votes` and `runner_up` are STARID's highest and second-highest tallies,
    equal in a tie.  `rivals` are the tied rows of an ambiguous star, brightest
    first.  `probability` is NaN where the identifier gives none.  `bounded`: the
    search ended at the most work allowed, and what it did not see may rival.
    """

    outcome: Integers
    star: Integers
    votes: Integers
    runner_up: Integers
    rivals: tuple[tuple[int, ...], ...]
    probability: Vector
    bounded: bool = False

    @cached_property
    def unique(self) -> npt.NDArray[np.bool_]:
        """Mask of the stars with a unique winner."""
        return np.asarray(self.outcome == Outcome.UNIQUE)
