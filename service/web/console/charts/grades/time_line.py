"""Stretches and status of a period as strips along the time axis."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from service.filtering.state import Status
from service.storage.grades.period import GradesOfPeriod
from service.web.console.charts.grades.panels import TimeAxis
from service.web.console.charts.period.attitude import WIDTH

HEIGHT = 24
WORDS = {
    Status.GOOD: "good",
    Status.STARTING: "suspect",
    Status.DOUBTFUL: "suspect",
    Status.LOST: "none",
    Status.NONE: "none",
}


@dataclass(frozen=True)
class Strip:
    """Bars by their kind as one path each; kinds differ in height, so that colour only helps."""

    id: str
    title: str
    bars: dict[str, str]
    width: int = WIDTH
    height: int = HEIGHT


def strips(found: GradesOfPeriod, axis: TimeAxis) -> list[Strip]:
    """Which model the filter had, and what both grades are worth."""
    drawn = [
        Strip(
            "model",
            "Model",
            _bars(
                [model for model, _, _ in found.stretches],
                axis.x(np.array([start for _, start, _ in found.stretches])),
                axis.x(np.array([end for _, _, end in found.stretches])),
                {"gyro": 4, "constant_rate": 14},
            ),
        )
    ]
    for grade, samples in found.samples.items():
        x = axis.x(samples.tai_ns)
        words = [WORDS[Status(code)] for code in samples.status.tolist()]
        drawn.append(
            Strip(grade, grade, _bars(words, x, x, {"good": 4, "suspect": 14, "none": 20}))
        )
    return drawn


def _bars(
    kinds: Sequence[str],
    left: npt.NDArray[np.int64],
    right: npt.NDArray[np.int64],
    tops: dict[str, int],
) -> dict[str, str]:
    """A path for each kind; bars of a kind that touch are one."""
    paths = dict.fromkeys(tops, "")
    begin = end = None
    before = ""
    for kind, a, b in zip(kinds, left.tolist(), right.tolist(), strict=True):
        if begin is not None and end is not None and (kind != before or a - end > 6):
            paths[before] += _bar(begin, end, tops[before])
            begin = None
        begin = a if begin is None else begin
        end, before = max(b, a + 2), kind
    if begin is not None and end is not None:
        paths[before] += _bar(begin, end, tops[before])
    return {kind: path for kind, path in paths.items() if path}


def _bar(begin: int, end: int, top: int) -> str:
    return f"M{begin} {HEIGHT}V{top}H{end}V{HEIGHT}z"
