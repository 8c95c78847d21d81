"""The result of an identifier: an identity for each star of one tracker."""

from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.vectors import Vector, read_only

Integers = npt.NDArray[np.int64]

MAX_RIVALS = 20
"""The most rivals listed for a star; the identifiers look for one more, to tell a cut list."""


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


class IdentifiedColumns(NamedTuple):
    """The identifications of k sightings with m stars in all, as kernels write them.

    Of each star, as in `Identification`: `outcome`, `star`, `votes`, `runner_up`, `probability`
    and `hypothesis` (m,), and `rivals` and `rival_probability` (m, MAX_RIVALS + 1), whose rows
    end with -1 in the place of a star.  Of each sighting: `bounded`, `mirrored`, `rivals_cut` and
    `explained` (k,), how many stars the hypothesis explains.  Votes alone leave `probability`,
    `rival_probability`, `hypothesis` and `explained` as they were.
    """

    outcome: Any
    star: Any
    votes: Any
    runner_up: Any
    probability: Any
    hypothesis: Any
    rivals: Any
    rival_probability: Any
    bounded: Any
    mirrored: Any
    rivals_cut: Any
    explained: Any

    def of_sighting(self, s: int, first: int, last: int, weighs: bool) -> Identification:
        """The identification of a sighting, whose stars are rows from `first` to before `last`.

        `weighs`: by hypotheses, not by votes.
        """
        n = last - first
        rivals = _none(n)
        likely: tuple[tuple[float, ...], ...] = _none(n) if weighs else ()
        listed = self.rivals[first:last]
        if (listed[:, 0] >= 0).any():
            listed = listed[:, :MAX_RIVALS].tolist()
            rivals = tuple(tuple(row for row in names if row >= 0) for names in listed)
            if weighs:
                chances = self.rival_probability[first:last].tolist()
                likely = tuple(
                    tuple(each[: len(names)]) for each, names in zip(chances, rivals, strict=True)
                )
        return Identification(
            outcome=self.outcome[first:last],
            star=self.star[first:last],
            votes=self.votes[first:last],
            runner_up=self.runner_up[first:last],
            rivals=rivals,
            probability=self.probability[first:last] if weighs else not_known(n),
            rival_probability=likely,
            rivals_cut=int(self.rivals_cut[s]),
            bounded=bool(self.bounded[s]),
            hypothesis=self.hypothesis[first:last] if weighs else None,
            mirrored=bool(self.mirrored[s]),
        )


def room_for_identities(sightings: int, stars: int) -> IdentifiedColumns:
    """Columns for so many sightings and stars."""
    integers, counts = np.empty((5, stars), np.int64), np.zeros((2, sightings), np.int64)
    outcome, star, votes, runner_up, hypothesis = integers
    return IdentifiedColumns(
        *(outcome, star, votes, runner_up, np.empty(stars), hypothesis),
        *(np.empty((stars, MAX_RIVALS + 1), np.int64), np.empty((stars, MAX_RIVALS + 1))),
        *(*np.zeros((2, sightings), np.bool_), *counts),
    )


@lru_cache(maxsize=256)
def _none(n: int) -> tuple[tuple[Any, ...], ...]:
    return ((),) * n
