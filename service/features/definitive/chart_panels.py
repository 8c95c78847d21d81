"""Chart panels of filtered and smoothed attitudes, with rejected values and status strips."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from service.attitude.definitive import Integers, Status
from service.features.definitive.period import DefinitivePeriod
from service.vectors import Vector
from service.web.console.charts.panels import HEIGHT, WIDTH, Mask, Scale, TimeAxis, Trace


@dataclass(frozen=True)
class ChartPanel:
    """Panel of a chart for one axis; `marks` show rejected values, clipped to the edge."""

    axis: str
    traces: tuple[Trace, ...]
    band: str
    marks: str
    bounds: tuple[int, ...]
    """Vertical positions of the horizontal lines that mark bounds."""
    note: str
    """Caption of the panel: the range of values and remarks."""
    scale: "Scale"
    unit: str

    @property
    def ticks(self) -> list[tuple[float, str]]:
        """Tick marks of the vertical axis: percent from the top, and text."""
        values = self.scale.ticks()
        heights = 100.0 * self.scale.y(np.array(values)) / self.scale.height
        texts = [f"{value:.6g}".replace("-", "−") + self.unit for value in values]
        return list(zip(np.round(heights, 1).tolist(), texts, strict=True))


@dataclass(frozen=True)
class Chart:
    """Chart with a panel per axis in one unit; `rows` hold the same data as a table."""

    id: str
    title: str
    panels: tuple[ChartPanel, ...]
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    width: int = WIDTH
    height: int = HEIGHT


def marks_of(time_ns: Integers, value: Vector, axis: TimeAxis, scale: Scale) -> str:
    """SVG path with a cross at every finite value."""
    known = np.isfinite(value)
    x, y = axis.x(time_ns[known]), np.clip(scale.y(value[known]), 8, HEIGHT - 8)
    places = zip(x.tolist(), y.tolist(), strict=True)
    return "".join(f"M{a - 7} {b - 7}l14 14m0 -14l-14 14" for a, b in places)


def joined_moments(time_ns: Integers, axis: TimeAxis, parts: int, same: Mask) -> Mask:
    """Mask (n,) of moments that a chart joins to the moment before.

    Moments are not joined if they are farther apart than both three parts of the period and three
    times the usual step, or if `same` (n,) is False because they are of different intervals.
    """
    step = np.diff(time_ns, prepend=time_ns[:1])
    part = (axis.end.tai_ns - axis.start.tai_ns) / parts
    usual = float(np.median(step[1:])) if len(step) > 1 else 0.0
    return np.asarray((step <= 3.0 * max(part, usual)) & same)


def scale_of(values: Mapping[str, Vector], *, is_log: bool = False) -> Scale | None:
    """Vertical scale of all finite (logarithmic: positive) values; None without any."""
    found = np.concatenate([each[np.isfinite(each)] for each in values.values()])
    if is_log:
        found = found[found > 0.0]
    if not len(found):
        return None
    low, high = float(found.min()), float(found.max())
    if is_log and high < 1.2 * low:
        low, high = low / 1.2, high * 1.2
    return Scale(low, high, is_log)


STRIP_HEIGHT = 24
WORDS = {
    Status.GOOD: "good",
    Status.STARTING: "suspect",
    Status.DOUBTFUL: "suspect",
    Status.LOST: "none",
    Status.NONE: "none",
}


@dataclass(frozen=True)
class Strip:
    """Strip of bars along time, one SVG path per kind; kinds differ in height and colour."""

    id: str
    title: str
    bars: dict[str, str]
    width: int = WIDTH
    height: int = STRIP_HEIGHT


def strips(found: DefinitivePeriod, axis: TimeAxis) -> list[Strip]:
    """Status strips: motion model of the filter, and status of filtered and smoothed attitudes."""
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
    kinds: Sequence[str], left: Integers, right: Integers, tops: dict[str, int]
) -> dict[str, str]:
    """SVG path for each kind of bar; touching bars of a kind are merged."""
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
    return f"M{begin} {STRIP_HEIGHT}V{top}H{end}V{STRIP_HEIGHT}z"
