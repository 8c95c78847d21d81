"""Two groups of stars, mirrored fields, and random points: good attitudes must be right.

    python -m benchmarks two_groups            ghosts, slews, mirrored axes, random points
    python -m benchmarks two_groups --quick    small samples

Ghosts: every star is doubled by a reflection .05 to 1 deg away, as bright or up to 3 mag fainter,
in half of the batches with the magnitudes of the ghosts exchanged.  Slews: half of the stars were
exposed after an unreported slew of .05 to 5 deg.
"""

import math
import os
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from multiprocessing import get_context

import numpy as np
from tqdm import tqdm

from benchmarks.bounds import Bound, at_least, at_most, every
from benchmarks.record import CORE, SIMULATOR
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.missions.mission import load_missions
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from tests.reference.two_group_views import Group, Views
from tests.reference.two_groups import Counted, Simple, simple, two_groups

MISSIONS = ("XTE", "SWAS", "SOHO")
KINDS, STARS = ("ghosts", "slews"), (6, 10)
BATCHES, QUICK_BATCHES = 5000, 40
"""Batches per mission, kind and number of stars, with and without an a priori attitude."""
MIRRORED, POINTS, TWO_POINTS, NOMINAL, QUICK = 20_000, 20_000, 50_000, 50_000, 100
POINT_COUNTS = (3, 4, 5, 6, 7, 8)
MOST_WRONG_PCT, LEAST_NAMED_RIGHT_PCT, LEAST_RIVAL_PCT = 0.1, 99.9, 99.0
MOST_MIRRORED, MOST_POINTS, MOST_TWO_POINTS, MOST_FLAGGED = 10, 3, 10, 20
SHELF_BYTES = 256 << 20


@dataclass(frozen=True)
class Row:
    """Row of the first table: mission, kind and stars of its batches, and their results."""

    mission: str
    kind: str
    stars: int
    with_prior: bool
    counted: Counted

    def bounds(self) -> tuple[Bound, Bound]:
        """Bounds of wrong answers and of unnamed rivals; small samples may have one batch more."""
        prior = "a priori" if self.with_prior else "no prior"
        name = f"{self.mission}, {self.kind}, {self.stars} stars, {prior}"
        counted = self.counted
        allowed = max(1, math.floor(counted.batches * MOST_WRONG_PCT / 100.0))
        missing = counted.smaller_good_alone - counted.of_these_with_rival
        few = math.ceil(counted.smaller_good_alone * (1.0 - LEAST_RIVAL_PCT / 100.0))
        return (
            at_most(f"{name}: good and wrong", counted.good_and_wrong, allowed),
            at_most(f"{name}: other group good alone, not named", missing, few),
        )


@dataclass(frozen=True)
class Task:
    """Work of one process: a row of ghosts or slews, or batches of one group each."""

    seed: int
    mission: str
    kind: str
    stars: int
    with_prior: bool
    batches: int

    def run(self) -> Counted | Simple:
        """Draw and process the batches."""
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
    """All rows, and the results of single groups by label."""
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
    """Bounds of rows and single groups."""
    by_row = [row.bounds() for row in rows]
    bounds = [wrong for wrong, _ in by_row]
    about = "good attitudes of the other group alone, named as rivals in 99 %"
    bounds += every(about, [unnamed for _, unnamed in by_row])
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
    """Benchmark of all rows."""
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


def _each(rows: list[Row], name: str) -> str:
    """Text of a value of every mission, in the order of `MISSIONS`."""
    values = [getattr(row.counted, name) for row in rows]
    return " / ".join(f"{value:.2f}" if name.endswith("pct") else f"{value:,}" for value in values)


def write(quick: bool, seed: int) -> Written:
    """Section of the verification about two groups of stars."""
    rows, others = measured(quick, seed)
    kinds = dict.fromkeys((row.kind, row.stars, row.with_prior) for row in rows)
    alike = [[r for r in rows if (r.kind, r.stars, r.with_prior) == kind] for kind in kinds]
    groups = table(
        (
            "view", "stars", "a priori", "answered", "good", "good and wrong",
            "names at .999", "right %", "other good alone", "of these named %",
        ),
        [
            (
                of_kind[0].kind, of_kind[0].stars, "yes" if of_kind[0].with_prior else "none",
                *(_each(of_kind, name) for name in ("answered", "good", "good_and_wrong", "named")),
                _each(of_kind, "named_right_pct"),
                _each(of_kind, "smaller_good_alone"), _each(of_kind, "rival_pct"),
            )
            for of_kind in alike
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
to 5 deg; either attitude is true, if both are named. A row has {rows[0].counted.batches:,} batches
of each of {", ".join(MISSIONS)}, in this order, half of their stars in each group; the a priori
attitude is off by up to 3 deg about each axis, the
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
