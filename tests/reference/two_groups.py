"""Answers to views of two groups of stars, or of one, counted against the truth."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from service.acquire import Acquisition, acquire
from service.attitude.solution import AttitudeSolution
from service.observations.batch import ObservationBatch, QuaternionPrior
from service.vectors import Matrix, attitude_error_arcsec
from tests.reference.two_group_views import Group, Rows, Views

SAME_ATTITUDE_DEG = 0.03
"""An attitude nearer to another than this is taken for the same: the least shift is .05 deg."""
LARGEST_ERROR = 40.0
"""e^T P^-1 e of an error that noise explains: more than this chi-square of three hardly ever is."""


def acquired(views: Views, batch: ObservationBatch) -> Acquisition:
    """The answer to a batch of these views."""
    return acquire(batch, views.mission, views.sky)


def is_good(found: Acquisition) -> bool:
    """Whether the answer has an attitude that it calls good."""
    return found.solution is not None and not found.solution.suspect


def is_at(solution: AttitudeSolution, attitude: Matrix) -> bool:
    """Whether a solution is at an attitude, but for noise: few stars may fix an axis badly."""
    off_arcsec = attitude_error_arcsec(solution.matrix, attitude)
    if math.hypot(*off_arcsec) < 3600.0 * SAME_ATTITUDE_DEG:
        return True
    weighted = off_arcsec @ np.linalg.solve(solution.covariance_arcsec2, off_arcsec)
    return float(weighted) < LARGEST_ERROR


@dataclass
class Counted:
    """What came of the batches of one row."""

    batches: int = 0
    good: int = 0
    answered: int = 0
    good_and_wrong: int = 0
    named: int = 0
    named_wrong: int = 0
    smaller_good_alone: int = 0
    of_these_with_rival: int = 0

    @property
    def wrong_pct(self) -> float:
        """Good answers that are wrong, or leave out a group that would give a good one."""
        return 100.0 * self.good_and_wrong / self.batches

    @property
    def named_right_pct(self) -> float:
        """Of the stars that are named as certain, those named rightly."""
        return 100.0 * (1.0 - self.named_wrong / max(self.named, 1))

    @property
    def rival_pct(self) -> float:
        """Of the batches whose other group alone gives a good attitude, those that name it."""
        return 100.0 * self.of_these_with_rival / max(self.smaller_good_alone, 1)


def two_groups(
    views: Views,
    kind: str,
    stars: int,
    with_prior: bool,
    batches: int,
    step: Callable[[int], object] = int,
) -> Counted:
    """Batches of ghosts or slews, counted."""
    counted = Counted()
    for _ in range(batches):
        first, second = views.ghosts(stars) if kind == "ghosts" else views.slew(stars)
        prior = views.prior(first.attitude) if with_prior else None
        batch, order = views.batch(first, second, prior=prior)
        found = acquired(views, batch)
        _count(counted, views, kind, found, order, first, second, prior)
        step(1)
    return counted


def _count(
    counted: Counted,
    views: Views,
    kind: str,
    found: Acquisition,
    order: Rows,
    first: Group,
    second: Group,
    prior: QuaternionPrior | None,
) -> None:
    counted.batches += 1
    good = is_good(found)
    counted.good += good
    identification = found.trackers[0].identification
    # A reflection is no star; of a slew either group is real.
    second_star = np.full(len(second), -1) if kind == "ghosts" else second.star
    truth = np.concatenate([first.star, second_star])[order]
    certain = identification.unique
    counted.named += int(certain.sum())
    counted.named_wrong += int((certain & (identification.star != truth)).sum())
    told = [] if found.solution is None else [found.solution]
    rival = found.rival
    if rival is not None:
        told.append(rival.solution)
    named = [any(is_at(solution, each.attitude) for solution in told) for each in (first, second)]
    right = (named[0],) if kind == "ghosts" else named
    is_wrong = not any(right)
    if found.solution is not None:
        counted.answered += 1
        for group, is_named in ((first, named[0]), (second, named[1])):
            if is_at(found.solution, group.attitude):
                continue
            alone = acquired(views, views.batch(group, prior=prior)[0])
            if _is_right(alone, group.attitude):
                counted.smaller_good_alone += 1
                counted.of_these_with_rival += is_named
                is_wrong |= not is_named
    counted.good_and_wrong += good and is_wrong


def _is_right(found: Acquisition, attitude: Matrix) -> bool:
    """Whether the answer is good, and at this attitude."""
    solution = found.solution
    return solution is not None and not solution.suspect and is_at(solution, attitude)


@dataclass
class Simple:
    """What came of batches of one group: how many were good and right, good and wrong, doubted."""

    batches: int = 0
    right: int = 0
    wrong: int = 0
    doubted: int = 0
    """With a rival, or called mirrored."""


def simple(
    views: Views, drawn: Iterator[Group], with_truth: bool, step: Callable[[int], object] = int
) -> Simple:
    """Batches of one group each; without truth every good answer is a wrong one."""
    counted = Simple()
    for group in drawn:
        found = acquired(views, views.batch(group, prior=views.prior(group.attitude))[0])
        right = with_truth and _is_right(found, group.attitude)
        counted.batches += 1
        counted.right += right
        counted.wrong += is_good(found) and not right
        counted.doubted += found.rival is not None or any(
            each.identification.mirrored for each in found.trackers
        )
        step(1)
    return counted
