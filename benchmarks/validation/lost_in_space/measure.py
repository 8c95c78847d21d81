"""Rows of lost in space: all solvers with the same scenes in rotation, all answers checked."""

from collections.abc import Sequence

from tqdm import tqdm

from benchmarks.report import Report
from benchmarks.sections import Section, Written
from benchmarks.validation.lost_in_space.conditions import (
    CONDITIONS,
    QUICK_SHARE,
    Condition,
    solvers_of,
)
from benchmarks.validation.lost_in_space.document import SOURCES, bounds_of, section_text
from benchmarks.validation.lost_in_space.rows import Count, Row, row_of

SLOW_SCENES = 100
"""Number of scenes for solvers that take milliseconds."""
TURN = 200
"""Number of scenes for one solver before the next one continues."""
OWN_SCENES, OWN_QUICK_SCENES = 8000, 400


def measured(
    names: Sequence[str], scenes: int, seed: int, with_peers: bool = True, quiet: bool = False
) -> list[Row]:
    """Rows of several conditions, by solver."""
    rows: list[Row] = []
    for name in names:
        condition = CONDITIONS[name]
        count = max(int(scenes * condition.share), 20)
        with tqdm(total=count, desc=name, unit=" scenes", disable=quiet or None) as bar:
            rows += _one(name, condition, count, seed, with_peers, bar)
    return rows


def _one(
    name: str, condition: Condition, count: int, seed: int, with_peers: bool, bar: "tqdm[None]"
) -> list[Row]:
    solvers = solvers_of(condition, with_peers)
    counts = {each.name: Count() for each in solvers}
    for turn, first in enumerate(range(0, count, TURN)):
        drawn = condition.draw(min(TURN, count - first), seed, first)
        leader = turn % len(solvers)
        for solver in solvers[leader:] + solvers[:leader]:
            taken = drawn[: max(SLOW_SCENES - first, 0)] if solver.slow else drawn
            counts[solver.name].take(solver, taken, condition.real)
        bar.update(len(drawn))
    return [row_of(name, each, counts[each.name]) for each in solvers]


def run(quick: bool, seed: int) -> Report:
    """Benchmark of the service's own solver in all conditions, without peers and times."""
    scenes = OWN_QUICK_SCENES if quick else OWN_SCENES
    rows = measured(list(CONDITIONS), scenes, seed, with_peers=False)
    bounds = bounds_of(rows)
    figures = {
        f"{row.condition}: right, wrong, none of {row.scenes:,}": (
            f"{row.right:,}, {row.wrong:,}, {row.none:,}"
        )
        for row in rows
    }
    return Report("lost_in_space", figures, bounds)


def _write(quick: bool, seed: int) -> Written:
    scenes = int(OWN_SCENES * QUICK_SHARE) if quick else OWN_SCENES
    rows = measured(list(CONDITIONS), scenes, seed, with_peers=False)
    return Written(section_text(rows), bounds_of(rows))


SECTION = Section("Lost in space", _write, SOURCES)
