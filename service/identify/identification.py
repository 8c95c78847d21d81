"""The result of star identification: an identity for each star of one tracker."""

from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from service.vectors import Vector, read_only

Integers = npt.NDArray[np.int64]

MAX_RIVALS = 20
"""Largest number of listed rivals of a star; identifiers find one more to detect a cut list."""


class Outcome(IntEnum):
    """The outcome of the identification of one observed star."""

    UNMATCHED = 0
    UNIQUE = 1
    AMBIGUOUS = 2

    @property
    def word(self) -> str:
        """The outcome in the lower-case spelling of the interface."""
        return self.name.lower()


_UNIQUE = int(Outcome.UNIQUE)  # numpy compares with a plain number several times as fast


class Identification(Struct, frozen=True, eq=False, gc=False):
    """The identification of one tracker's stars, row by row in the order observed.

    `star` is the row in the run catalog of the unique winner, -1 without one. `votes` and
    `runner_up` are STARID's highest and second-highest tallies, equal in a tie. `rivals` are the
    possible rows of a star without a winner: the tied ones, brightest first, or with probabilities
    all likely ones, by decreasing `rival_probability`. `probability`, NaN if the identifier gives
    none, is that of the winner, of an ambiguous star's first rival, or of an unmatched star being
    no catalog star. `rivals_cut` counts the stars with more rivals than are listed. `bounded`: the
    search ended at its work limit and may have missed rivals. `hypothesis` is the most likely row
    of each star under one attitude, -1 if unexplained, and None if the identifier weighs no
    hypotheses. `mirrored`: a mirror image of the field fits the sky better.
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
        """True for stars explained by the most likely hypothesis, or else by a unique winner."""
        return np.asarray((self.star if self.hypothesis is None else self.hypothesis) >= 0)

    @property
    def unique(self) -> npt.NDArray[np.bool_]:
        """True for the stars with a unique winner."""
        return np.asarray(self.outcome == _UNIQUE)


@lru_cache(maxsize=256)
def not_known(n: int) -> Vector:
    """A read-only array of NaN for n stars, for unknown probabilities or residuals."""
    return read_only(np.full(n, np.nan))


def nothing_known(n: int) -> Identification:
    """The identification of n stars that were not searched for: all unmatched."""
    return Identification(
        outcome=np.full(n, int(Outcome.UNMATCHED)),
        star=np.full(n, -1),
        votes=np.zeros(n, np.int64),
        runner_up=np.zeros(n, np.int64),
        rivals=((),) * n,
        probability=not_known(n),
    )


class IdentifiedColumns(NamedTuple):
    """The identifications of k sightings with m stars in all, as arrays filled by kernels.

    By star, as in `Identification`: `outcome`, `star`, `votes`, `runner_up`, `probability` and
    `hypothesis` (m,), and `rivals` and `rival_probability` (m, MAX_RIVALS + 1), whose rows end with
    -1 instead of a star. By sighting: `bounded`, `mirrored`, `rivals_cut` and `explained` (k,), the
    number of stars that the hypothesis explains. Vote counting leaves `probability`,
    `rival_probability`, `hypothesis` and `explained` unchanged.
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
        """The identification of one sighting, from the columns of many.

        `weighs` is true for an identifier by hypotheses, false for one by votes.
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
    """Empty arrays for the identifications of given numbers of sightings and stars."""
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
