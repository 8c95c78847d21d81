"""Experiments of the paper's size: each view goes through the pipeline, on all cores.

The zones, views and errors of an experiment depend on the seed, the world and the experiment's
number alone, not on the distribution of the work.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from tqdm import tqdm

from service.acquire import BatchColumns, acquire_many
from service.missions.mission import Identifier
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from studies.paper_1994.printed import Run, World, the_paper
from studies.paper_1994.tally import Integers, Tally, counts_of
from studies.paper_1994.views import EPOCH, batch_of, draw_zone, paper_mission
from studies.workers import mapping

SHELF_BYTES = 64 << 20


@dataclass(frozen=True)
class Task:
    """One experiment: its world and number, and the runs and identifiers that share its views."""

    world: str
    seed: int
    number: int
    runs: tuple[Run, ...]
    identifiers: tuple[Identifier, ...]


def run_experiments(
    runs: Sequence[Run],
    stars: int,
    seeds: Sequence[int],
    identifiers: Sequence[Identifier] = ("starid",),
    processes: int | None = None,
) -> list[Tally]:
    """Simulate every run with each identifier, and count outcomes.

    Whole experiments are repeated until each run has `stars` stars for each seed. `processes` is
    the number of workers, all cores if None; 1 works in this process.
    """
    by_world = defaultdict(list)
    for run in runs:
        by_world[run.world].append(run)
    done: dict[tuple[str, int], list[Integers]] = defaultdict(list)
    paper = the_paper()
    with mapping(processes) as mapped, tqdm(unit="star", unit_scale=True, disable=None) as bar:
        while True:
            tasks = [
                Task(world, seed, number, tuple(its_runs), tuple(identifiers))
                for world, its_runs in by_world.items()
                for seed in seeds
                for number in _missing(done[world, seed], stars, paper.worlds[world])
            ]
            if not tasks:
                break
            bar.total = bar.n + sum(_stars_expected(task) for task in tasks)
            # In order, so that a result belongs to its task.
            for task, counts in zip(tasks, mapped(_perform, tasks), strict=True):
                done[task.world, task.seed].append(counts)
                bar.update(int(counts.sum()))
    tallies = {
        (run, identifier): np.concatenate(
            [counts[i, j] for seed in seeds for counts in done[world, seed]]
        )
        for world, its_runs in by_world.items()
        for j, run in enumerate(its_runs)
        for i, identifier in enumerate(identifiers)
    }
    return [Tally(run, each, tallies[run, each]) for each in identifiers for run in runs]


def _missing(done: list[Integers], stars: int, world: World) -> range:
    """Numbers of the experiments that are still needed for the requested stars."""
    # Every run of a world sees the same stars: the first tells for all.
    seen = sum(int(counts[0, 0].sum()) for counts in done)
    most = world.zones * world.views * 5
    return range(len(done), len(done) + -(-max(0, stars - seen) // most))


def _stars_expected(task: Task) -> int:
    world = the_paper().worlds[task.world]
    return world.zones * world.views * 5 * len(task.runs) * len(task.identifiers)


def _perform(task: Task) -> Integers:
    """Counts of stars by outcome (identifiers, runs, zones, 4) in one experiment."""
    sky, world = _sky(), the_paper().worlds[task.world]
    worlds = list(the_paper().worlds)
    rng = np.random.default_rng([task.seed, worlds.index(task.world), task.number])
    mission = paper_mission(world.mission)
    catalog = sky.run_catalog(mission, EPOCH)
    counts = np.zeros((len(task.identifiers), len(task.runs), world.zones, 4), np.int64)
    for zone in range(world.zones):
        number = task.number * world.zones + zone
        drawn = draw_zone(world, number, mission, catalog, rng)
        views = [view for view in drawn if len(view.star)]
        for i, identifier in enumerate(task.identifiers):
            for j, run in enumerate(task.runs):
                batches = [batch_of(view, run, mission, identifier) for view in views]
                columns = acquire_many(BatchColumns.of(batches), mission, sky)
                for row, view in enumerate(views):
                    found = columns.acquisition(row).trackers[0].identification
                    counts[i, j, zone] += counts_of(found, view.star)
    return counts


def open_sky() -> SkyModel:
    """Sky model of the embedded catalog with a small cache, since zones are used only briefly."""
    return SkyModel(load_embedded(), LruCache(SHELF_BYTES))


@cache
def _sky() -> SkyModel:
    return open_sky()
