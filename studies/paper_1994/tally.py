"""The outcome of a run's stars, zone by zone."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.identify.identification import Identification, Outcome
from service.missions.mission import Identifier
from studies.paper_1994.printed import Run, World, the_paper

AMBIGUOUS, UNMATCHED, CORRECT, MISIDENTIFIED = range(4)

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Tally:
    """The outcome of a run's stars: counts (zones, 4), zone by zone, over all experiments."""

    run: Run
    identifier: Identifier
    counts: Integers

    @property
    def stars(self) -> int:
        """The number of stars observed."""
        return int(self.counts.sum())

    def total(self, outcome: int) -> int:
        """The number of stars of one outcome."""
        return int(self.counts[:, outcome].sum())

    @property
    def world(self) -> World:
        """The run's world."""
        return the_paper().worlds[self.run.world]


def counts_of(found: Identification, truth: npt.NDArray[np.intp]) -> Integers:
    """The stars by outcome (4,), given the catalog rows that are the truth."""
    counts = np.zeros(4, np.int64)
    is_right = found.star == truth
    counts[AMBIGUOUS] = np.count_nonzero(found.outcome == Outcome.AMBIGUOUS)
    counts[UNMATCHED] = np.count_nonzero(found.outcome == Outcome.UNMATCHED)
    counts[CORRECT] = np.count_nonzero(found.unique & is_right)
    counts[MISIDENTIFIED] = np.count_nonzero(found.unique & ~is_right)
    return counts
