"""Counts of a run's stars by outcome and zone, and tests of agreement between counts.

The printed run is compared with ours, and our rates with the reference's.  An experiment has many
independent zones, so that the covariance of its counts is that of one zone's counts times their
number: estimated as well from few experiments as from many.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.identify.identification import Identification, Outcome
from service.missions.mission import Identifier
from service.vectors import Matrix, Vector
from studies.paper_1994.printed import REFERENCE_EXPERIMENTS, PrintedCounts, Run, World, the_paper

AMBIGUOUS, UNMATCHED, CORRECT, MISIDENTIFIED = range(4)

Integers = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Tally:
    """Counts of a run's stars by outcome (zones, 4), over all experiments."""

    run: Run
    identifier: Identifier
    counts: Integers

    @property
    def stars(self) -> int:
        """Number of observed stars."""
        return int(self.counts.sum())

    def total(self, outcome: int) -> int:
        """Number of stars with an outcome."""
        return int(self.counts[:, outcome].sum())

    @property
    def world(self) -> World:
        """World that the run is simulated in."""
        return the_paper().worlds[self.run.world]


def counts_of(found: Identification, truth: npt.NDArray[np.intp]) -> Integers:
    """Number of stars by outcome (4,), compared with the true catalog rows."""
    counts = np.zeros(4, np.int64)
    is_right = found.star == truth
    counts[AMBIGUOUS] = np.count_nonzero(found.outcome == Outcome.AMBIGUOUS)
    counts[UNMATCHED] = np.count_nonzero(found.outcome == Outcome.UNMATCHED)
    counts[CORRECT] = np.count_nonzero(found.unique & is_right)
    counts[MISIDENTIFIED] = np.count_nonzero(found.unique & ~is_right)
    return counts


CHI_SQUARE_95 = 5.99
"""The 95 % point of chi-square with two degrees of freedom."""
ALLOWED_SIGMAS = 3.0
ALLOWED_PCT = 0.05


@dataclass(frozen=True)
class Spread:
    """Mean (2,) and covariance (2, 2) of the counts in one experiment of the paper's size.

    The two counts are the stars not identified (ambiguous or unmatched) and the misidentified ones.
    """

    experiments: float
    stars: float
    mean: Vector
    covariance: Matrix


@dataclass(frozen=True)
class Difference:
    """Our rate and the reference's, in percent, with the tolerated difference."""

    ours_pct: float
    ours_sigma_pct: float
    reference_pct: float
    allowed_pct: float

    @property
    def agrees(self) -> bool:
        """True if the rates agree within the tolerated difference."""
        return abs(self.ours_pct - self.reference_pct) <= self.allowed_pct


def unidentified_and_wrong(counts: Integers) -> Integers:
    """Numbers of unidentified (ambiguous or unmatched) and misidentified stars: (zones, 2)."""
    return np.stack([counts[:, AMBIGUOUS] + counts[:, UNMATCHED], counts[:, MISIDENTIFIED]], axis=1)


def spread(tally: Tally) -> Spread:
    """Mean and covariance of the counts in an experiment of the paper's size."""
    world = tally.world
    counts = unidentified_and_wrong(tally.counts).astype(np.float64)
    zones = len(counts)
    kind = np.arange(zones) % world.strata
    # The variation with the Sun's date is equal in all experiments, and so no part of the scatter.
    means = np.stack([counts[kind == k].mean(axis=0) for k in range(world.strata)])
    apart = counts - means[kind]
    covariance = apart.T @ apart / (zones - world.strata)
    experiments = zones / world.zones
    return Spread(
        experiments=experiments,
        stars=tally.stars / experiments,
        mean=counts.sum(axis=0) / experiments,
        covariance=covariance * world.zones,
    )


def distance_squared(printed: PrintedCounts, ours: Spread) -> float:
    """Squared distance of printed counts from ours: at most 5.99 in 95 of 100 experiments.

    d^T C^-1 d with C = (1 + 1/n) times the covariance of an experiment's counts, n being the number
    of experiments behind the mean, plus 1/2 since counts are whole numbers.
    """
    apart = np.array([printed.ambiguous, printed.misidentified]) - ours.mean
    covariance = (1.0 + 1.0 / ours.experiments) * ours.covariance + 0.5 * np.eye(2)
    return float(apart @ np.linalg.solve(covariance, apart))


def is_inside(tally: Tally) -> bool:
    """True if the printed counts are in the 95 % region of experiments of their size."""
    return distance_squared(tally.run.printed, spread(tally)) <= CHI_SQUARE_95


def differences(tally: Tally) -> tuple[Difference, Difference]:
    """Our rates of unidentified and of misidentified stars, compared with the reference's.

    The tolerance is three combined standard errors, or 0.05 percentage points.
    """
    ours, reference = spread(tally), tally.run.reference
    theirs = (
        (reference.unidentified_pct, reference.sd_unidentified_pct),
        (reference.misidentified_pct, reference.sd_misidentified_pct),
    )
    first, second = (
        _difference(
            100.0 * ours.mean[k] / ours.stars,
            100.0 * math.sqrt(ours.covariance[k, k] / ours.experiments) / ours.stars,
            rate_pct,
            sd_pct / math.sqrt(REFERENCE_EXPERIMENTS),
        )
        for k, (rate_pct, sd_pct) in enumerate(theirs)
    )
    return first, second


def _difference(ours: float, sigma: float, theirs: float, their_sigma: float) -> Difference:
    allowed = max(ALLOWED_SIGMAS * math.hypot(sigma, their_sigma), ALLOWED_PCT)
    return Difference(float(ours), float(sigma), theirs, allowed)
