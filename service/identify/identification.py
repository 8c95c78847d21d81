"""The result of an identifier: an identity for each star of one tracker."""

from enum import IntEnum
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.vectors import Vector, read_only

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


_UNIQUE = int(Outcome.UNIQUE)  # numpy compares with a plain number several times as fast


class Identification(Struct, frozen=True, eq=False, gc=False):
    """The identification of one tracker's stars, row by row in the order observed.

    `star` is the row in the run catalog of the unique winner, -1 without one.
    `votes` and `runner_up` are STARID's highest and second-highest tallies,
    equal in a tie.  `rivals` are the rows that a star without a winner may be:
    the tied ones, brightest first, or where the identifier gives probabilities
    all that are likely enough, by falling `rival_probability`.  `probability`,
    NaN where the identifier gives none, is that of the winner, of an ambiguous
    star's first rival, or that an unmatched star is none of the catalog's.
    `rivals_cut` counts the stars with more rivals than are listed.
    `bounded`: the search ended at the most work allowed, and what it did not
    see may rival.  `hypothesis` is the likeliest star of each under one attitude,
    -1 where that explains none, and None where the identifier weighs no
    hypotheses.  `mirrored`: a mirror image of the field fits the sky better.
    """

    outcome: Integers
    star: Integers
    votes: Integers
    runner_up: Integers
    rivals: tuple[tuple[int, ...], ...]
    probability: Vector
    rival_probability: tuple[tuple[float, ...], ...] = ()
    rivals_cut: int = 0
    bounded: bool = False
    hypothesis: Integers | None = None
    mirrored: bool = False

    @property
    def explained(self) -> npt.NDArray[np.bool_]:
        """Mask of the stars that the likeliest hypothesis, or a unique winner, explains."""
        return np.asarray((self.star if self.hypothesis is None else self.hypothesis) >= 0)

    @property
    def unique(self) -> npt.NDArray[np.bool_]:
        """Mask of the stars with a unique winner."""
        return np.asarray(self.outcome == _UNIQUE)


@lru_cache(maxsize=256)
def not_known(n: int) -> Vector:
    """NaN for each of n stars: a probability or a residual that there is not; locked."""
    return read_only(np.full(n, np.nan))


def nothing_known(n: int) -> Identification:
    """The identification of n stars that could not be searched for: all unmatched."""
    return Identification(
        outcome=np.full(n, int(Outcome.UNMATCHED)),
        star=np.full(n, -1),
        votes=np.zeros(n, np.int64),
        runner_up=np.zeros(n, np.int64),
        rivals=((),) * n,
        probability=not_known(n),
    )
