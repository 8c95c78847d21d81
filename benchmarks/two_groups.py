"""Two groups of stars, mirrored fields, no star at all: what is called good must be right.

    python -m benchmarks two_groups            ghosts, slews, mirrored axes, random points
    python -m benchmarks two_groups --quick    small samples

Ghosts: every star is doubled by a reflection .05 to 1 deg away, as bright or up to 3 mag fainter,
in half of the batches with the magnitudes of the ghosts exchanged.  Slews: half of the stars were
exposed after an unreported slew of .05 to 5 deg.
"""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most
from benchmarks.record import CORE, SIMULATOR
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.acquire import Acquisition, acquire
from service.attitude.solution import AttitudeSolution
from service.missions.mission import load_missions
from service.observations.batch import ObservationBatch, QuaternionPrior
from service.simulate.two_groups import Group, Rows, Views
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.vectors import Matrix, attitude_error_arcsec

MISSIONS = ("XTE", "SWAS", "SOHO")
KINDS, STARS = ("ghosts", "slews"), (6, 10)
BATCHES, QUICK_BATCHES = 5000, 40
"""Of every mission, kind, number of stars, with and without an a priori attitude."""
MIRRORED, POINTS, TWO_POINTS, NOMINAL, QUICK = 20_000, 20_000, 50_000, 50_000, 100
POINT_COUNTS = (3, 4, 5, 6, 7, 8)
MOST_WRONG_PCT, LEAST_NAMED_RIGHT_PCT, LEAST_RIVAL_PCT = 0.1, 99.9, 99.0
MOST_MIRRORED, MOST_POINTS, MOST_TWO_POINTS, MOST_FLAGGED = 10, 3, 10, 20
SAME_ATTITUDE_DEG = 0.03
"""An attitude nearer to another than this is taken for the same: the least shift is .05 deg."""
LARGEST_ERROR = 40.0
"""e^T P^-1 e of an error that noise explains: more than this chi-square of three hardly ever is."""
SHELF_BYTES = 256 << 20


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


@dataclass(frozen=True)
class Row:
    """One row of the first table: where and how it was drawn, and what came of it."""

    mission: str
    kind: str
    stars: int
    with_prior: bool
    counted: Counted

    def bounds(self) -> list[Bound]:
        """What is asked of it; one batch is allowed for in small samples."""
        prior = "a priori" if self.with_prior else "no prior"
        name = f"{self.mission}, {self.kind}, {self.stars} stars, {prior}"
        counted = self.counted
        allowed = max(1, math.floor(counted.batches * MOST_WRONG_PCT / 100.0))
        missing = counted.smaller_good_alone - counted.of_these_with_rival
        few = math.ceil(counted.smaller_good_alone * (1.0 - LEAST_RIVAL_PCT / 100.0))
        return [
            at_most(f"{name}: good and wrong", counted.good_and_wrong, allowed),
            at_most(f"{name}: other group good alone, not named", missing, few),
        ]


@dataclass(frozen=True)
class Task:
    """What one process is given: a row of ghosts or slews, or batches of one group each."""

    seed: int
    mission: str
    kind: str
    stars: int
    with_prior: bool
    batches: int

    def run(self) -> Counted | Simple:
        """Draw and acquire its batches."""
        sky = SkyModel(load_embedded(), LruCache(SHELF_BYTES))
        drawn = [self.seed, *self.mission.encode(), *self.kind.encode(), self.stars]
        rng = np.random.default_rng([*drawn, self.with_prior])
        views = Views(load_missions()[self.mission], sky, rng)
        if self.kind in KINDS:
            return two_groups(views, self.kind, self.stars, self.with_prior, self.batches)

        def draw() -> Group:
            if self.kind == "mirrored":
                return views.mirrored(self.stars)
            if self.kind == "random":
                return views.random_points(self.stars)
            return views.field(self.stars or int(rng.integers(3, 9)))

        return simple(views, (draw() for _ in range(self.batches)), self.kind == "real")


def measured(quick: bool, seed: int) -> tuple[list[Row], dict[str, Simple]]:
    """Every row, and by label what came of single groups."""
    batches = QUICK_BATCHES if quick else BATCHES
    rows = [
        Task(seed, mission, kind, stars, with_prior, batches)
        for mission in MISSIONS
        for kind in KINDS
        for stars in STARS
        for with_prior in (True, False)
    ]
    many = [QUICK if quick else count for count in (MIRRORED, POINTS, TWO_POINTS, NOMINAL)]
    labels = {f"mirrored, {stars} stars": ("mirrored", stars, many[0]) for stars in (5, 10)}
    labels |= {f"{points} random points": ("random", points, many[1]) for points in POINT_COUNTS}
    labels["2 random points"] = "random", 2, many[2]
    labels["2 real stars"] = "real", 2, many[1]
    labels["3 to 8 real stars"] = "real", 0, many[3]
    single = [Task(seed, "XTE", kind, stars, True, n) for kind, stars, n in labels.values()]
    tasks = rows + single
    total = sum(task.batches for task in tasks)
    with (
        ProcessPoolExecutor(os.cpu_count(), get_context("spawn")) as pool,
        tqdm(total=total, desc="two groups", unit="batch", unit_scale=True) as bar,
    ):
        found = {}
        waiting = {pool.submit(task.run): task for task in tasks}
        for done in as_completed(waiting):
            task = waiting[done]
            found[task] = done.result()
            bar.update(task.batches)
    counted = {task: each for task, each in found.items() if isinstance(each, Counted)}
    simples = {task: each for task, each in found.items() if isinstance(each, Simple)}
    return (
        [Row(t.mission, t.kind, t.stars, t.with_prior, counted[t]) for t in rows],
        {label: simples[task] for label, task in zip(labels, single, strict=True)},
    )


def bounds_of(rows: list[Row], others: dict[str, Simple]) -> list[Bound]:
    """All that is asked."""
    bounds = [bound for row in rows for bound in row.bounds()]
    named = sum(row.counted.named for row in rows)
    wrong = sum(row.counted.named_wrong for row in rows)
    right_pct = 100.0 * (1.0 - wrong / max(named, 1))
    bounds.append(
        at_least("names of probability .999: right", right_pct, LEAST_NAMED_RIGHT_PCT, "%")
    )
    for label, counted in others.items():
        if "real" not in label:
            most = MOST_MIRRORED if "mirrored" in label else MOST_POINTS
            most = MOST_TWO_POINTS if label == "2 random points" else most
            bounds.append(at_most(f"{label}: good", counted.wrong, most))
        else:
            bounds.append(at_most(f"{label}: good and wrong", counted.wrong, 1))
            bounds.append(at_most(f"{label}: doubted", counted.doubted, MOST_FLAGGED))
    return bounds


def run(quick: bool, seed: int) -> Report:
    """The benchmark: every row."""
    rows, others = measured(quick, seed)
    figures = {
        f"{row.mission}, {row.kind}, {row.stars}, {'a priori' if row.with_prior else 'no prior'}": (
            f"wrong {row.counted.good_and_wrong} of {row.counted.batches}, rival named in "
            f"{row.counted.rival_pct:.2f} % of {row.counted.smaller_good_alone}"
        )
        for row in rows
    }
    figures |= {
        label: f"good and right {each.right}, wrong {each.wrong}, doubted {each.doubted} of "
        f"{each.batches}"
        for label, each in others.items()
    }
    return Report("two_groups", figures, bounds_of(rows, others))


def write(quick: bool, seed: int) -> Written:
    """The section of the verification."""
    rows, others = measured(quick, seed)
    groups = table(
        (
            "mission", "view", "stars", "a priori", "answered", "good", "good and wrong",
            "names at .999", "right %", "other good alone", "of these named %",
        ),
        [
            (
                row.mission, row.kind, row.stars, "yes" if row.with_prior else "none",
                row.counted.answered, row.counted.good, row.counted.good_and_wrong,
                row.counted.named, f"{row.counted.named_right_pct:.2f}",
                row.counted.smaller_good_alone, f"{row.counted.rival_pct:.2f}",
            )
            for row in rows
        ],
        numbers=7,
    )  # fmt: skip
    single = table(
        ("batches of", "batches", "good and right", "good and wrong", "doubted"),
        [
            (label, each.batches, each.right, each.wrong, each.doubted)
            for label, each in others.items()
        ],
        numbers=4,
    )
    text = f"""
An attitude may be wrong although chance does not explain it: a view may hold a second group of
stars that agree with one another. *Ghosts*: every star is doubled by a reflection 0.05 to 1 deg
away, as bright or up to 3 mag fainter, in half of the batches with magnitudes exchanged; true is
the attitude of the stars. *Slews*: half of the stars were exposed after an unreported slew of 0.05
to 5 deg; either attitude is true, if both are named. {rows[0].counted.batches:,} batches a row,
half of their stars in each group; the a priori attitude is off by up to 3 deg about each axis, the
pole of SOHO by up to 0.1 deg.

*Good and wrong* counts `good` answers that are wrong, and those that do not name the attitude of
the other group although its stars alone give a `good` one. The last two columns say in how many
answers the other group alone gives a `good` attitude, and in how many of these it is named as the
rival. Without a prior, six stars in two groups of three are mostly refused: there is no answer.

{groups}

Below, XTE: fields of a tracker with one axis of the wrong sign, points that are no stars at all,
and real stars. *Doubted* are answers with a rival or with the warning `mirrored_field`.

{single}
"""
    return Written(text, bounds_of(rows, others))


SECTION = Section("Two groups of stars", write, (*CORE, *SIMULATOR))
