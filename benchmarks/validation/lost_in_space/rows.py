"""Counts of a solver in one condition, and the resulting row."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from benchmarks.validation.lost_in_space.peers import LIMIT_MAG, Solver
from service.vectors import Matrix
from studies.scenes import Scene

RIGHT_BORESIGHT_DEG, RIGHT_ROTATION_DEG = 0.1, 1.0
SIX = 6


@dataclass(frozen=True)
class Row:
    """Row of one solver in one condition; milliseconds per scene, megabytes of the database.

    `six` counts the scenes with at least six detected stars in the database; `right_of_six` counts
    the right answers to these.
    """

    condition: str
    solver: str
    scenes: int
    right: int
    wrong: int
    none: int
    median_ms: float
    p99_ms: float
    max_ms: float
    six: int
    right_of_six: int
    database_mb: float


@dataclass
class Count:
    """Counts of one solver."""

    right: int = 0
    wrong: int = 0
    none: int = 0
    six: int = 0
    right_of_six: int = 0
    ns: list[int] = field(default_factory=list)

    def take(self, solver: Solver, scenes: Sequence[tuple[Scene, int]], real: bool) -> None:
        """Solve several scenes in order, each with its number of stars in the database."""
        if not scenes:
            return
        told = [solver.ready(scene) for scene, _ in scenes]
        # Not timed: it may compile, and finds the caches as another solver has left them.
        solver.solve(told[0])
        clock = time.process_time_ns
        results = []
        for each in told:
            started = clock()
            result = solver.solve(each)
            self.ns.append(clock() - started)
            results.append(result)
        for (scene, held), result in zip(scenes, results, strict=True):
            self._judge(scene, held, solver.attitude(result), real)

    def _judge(self, scene: Scene, held: int, attitude: Matrix | None, real: bool) -> None:
        is_right = attitude is not None and real and right(scene, attitude)
        self.none += attitude is None
        self.right += is_right
        self.wrong += attitude is not None and not is_right
        self.six += held >= SIX
        self.right_of_six += is_right and held >= SIX


def right(scene: Scene, attitude: Matrix) -> bool:
    """True if an attitude agrees with that of the scene."""
    boresight_deg, rotation_deg = scene.off_from(attitude)
    return boresight_deg < RIGHT_BORESIGHT_DEG and rotation_deg < RIGHT_ROTATION_DEG


def row_of(condition: str, solver: Solver, count: Count) -> Row:
    """Row from the counts of a solver."""
    ms = np.array(count.ns or [0]) / 1e6
    return Row(
        condition,
        solver.name,
        len(count.ns),
        count.right,
        count.wrong,
        count.none,
        float(np.median(ms)),
        float(np.percentile(ms, 99)),
        float(ms.max()),
        count.six,
        count.right_of_six,
        solver.database_mb,
    )


def interval(hits: int, of: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a share."""
    if of == 0:
        return 0.0, 1.0
    z = 1.959964
    share = hits / of
    middle = (share + z * z / (2 * of)) / (1 + z * z / of)
    half = z * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of)) / (1 + z * z / of)
    return max(0.0, middle - half), min(1.0, middle + half)


def more_often(one: Row, other: Row) -> float:
    """Probability that `one` is wrong so often by chance: Fisher's exact test, one-sided."""
    from scipy.stats import fisher_exact

    table = [[one.wrong, one.scenes - one.wrong], [other.wrong, other.scenes - other.wrong]]
    return float(fisher_exact(table, alternative="greater")[1])


__all__ = ["LIMIT_MAG", "Count", "Row", "interval", "more_often", "right", "row_of"]
