"""Panels of one axis of a chart: traces, a band and marks on a linear or logarithmic scale."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta

import numpy as np
import numpy.typing as npt

from service.attitude.definitive import Integers
from service.times import DAY_S, Utc
from service.vectors import Vector

Mask = npt.NDArray[np.bool_]
WIDTH, HEIGHT = 1280, 176
"""Width and height of a panel in units, two per pixel."""
PAD = 10
FINE_HEIGHT = 10 * HEIGHT
"""Height of panels whose values can be read to a thousandth of their range."""
TIME_STEPS_S = (
    *(1, 2, 5, 10, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 3 * 3600, 6 * 3600, 12 * 3600),
    *(days * DAY_S for days in (1, 2, 7, 14, 28, 56, 91, 182)),
)
MOST_TICKS = 4
EDGE_PERCENT = 5.0
ROOM = 0.04
"""Space above the greatest and below the least value, as a part of the height."""


@dataclass(frozen=True)
class Trace:
    """SVG paths of one kind of values: `line` joins neighbours, `dots` marks lone values."""

    kind: str
    line: str
    dots: str


@dataclass(frozen=True)
class TimeAxis:
    """Time axis of a chart: its period."""

    start: Utc
    end: Utc

    def x(self, time_ns: Integers) -> Integers:
        """Horizontal positions (n,) of times, in units from the left edge of the chart."""
        length = max(self.end.tai_ns - self.start.tai_ns, 1)
        along = np.clip((time_ns - self.start.tai_ns) / length, 0.0, 1.0)
        return np.asarray(np.rint(PAD + along * (WIDTH - 2 * PAD)).astype(np.int64))

    def ticks(self) -> list[tuple[float, str]]:
        """Tick marks at round times of the period: percent from the left, and text in UTC."""
        length_s = (self.end.tai_ns - self.start.tai_ns) * 1e-9
        step_s = next((step for step in TIME_STEPS_S if length_s <= MOST_TICKS * step), None)
        if step_s is None or length_s <= 0.0:
            return []
        begin = datetime.fromisoformat(self.start.text.replace("Z", "+00:00").replace(":60", ":59"))
        first_s = math.ceil(begin.timestamp() / step_s) * step_s - begin.timestamp()
        form = "%H:%M:%S" if step_s < 60 else "%H:%M" if step_s < DAY_S else "%m-%d"
        found = []
        for after_s in np.arange(first_s, length_s, step_s).tolist():
            part = (PAD + after_s / length_s * (WIDTH - 2 * PAD)) / WIDTH
            moment = begin + timedelta(seconds=after_s)
            found.append((round(100.0 * part, 1), moment.strftime(form)))
        return [each for each in found if EDGE_PERCENT < each[0] < 100.0 - EDGE_PERCENT]


@dataclass(frozen=True)
class Scale:
    """Scale from values to heights, logarithmic or linear, between `low` and `high`."""

    low: float
    high: float
    is_log: bool = False
    height: int = HEIGHT

    def ticks(self) -> list[float]:
        """Two to five round values of the scale; for a logarithmic one, powers of ten."""
        low, high = self.low, self.high
        if self.is_log:
            powers = range(math.ceil(math.log10(low)), math.floor(math.log10(high)) + 1)
            return [10.0**power for power in powers] or [low, high]
        if not high > low:
            return [low]
        step = 10.0 ** math.floor(math.log10((high - low) / 2.0))
        step *= max(part for part in (1.0, 2.0, 5.0) if part * step <= (high - low) / 2.0)
        first = math.ceil(low / step)
        return [k * step for k in range(first, math.floor(high / step) + 1)]

    @property
    def range_with_room(self) -> float:
        """Range of values between the upper and the lower edge of a linear scale."""
        return self.high - self.low + 2.0 * (ROOM * (self.high - self.low) or 1.0)

    def y(self, value: Vector) -> Integers:
        """Vertical positions (n,) of values, in units from the top; beyond an edge, at the edge."""
        low, high = self.low, self.high
        if self.is_log:
            value, low, high = np.log(np.maximum(value, low)), np.log(low), np.log(high)
        room = ROOM * (high - low) or 1.0
        part = (value - low + room) / (high - low + 2.0 * room)
        units = self.height * (1.0 - np.clip(part, 0.0, 1.0))
        return np.asarray(np.rint(units).astype(np.int64))


@dataclass(frozen=True, eq=False)
class Values:
    """Values of one axis with times; `joins` (n,) marks those joined with the previous one."""

    time_ns: Integers
    value: Vector
    joins: Mask = field(default_factory=lambda: np.zeros(0, dtype=bool))

    def trace(self, kind: str, axis: TimeAxis, scale: Scale) -> Trace:
        """SVG paths of the values; unknown ones are left out."""
        known = np.isfinite(self.value)
        joins = self.joins if len(self.joins) else np.zeros(len(known), dtype=bool)
        # A value after an unknown one begins a new part.
        joins = (joins & np.append(False, known[:-1])[: len(known)])[known]
        x, y = axis.x(self.time_ns[known]), scale.y(self.value[known])
        parts = parts_of(joins)
        return Trace(
            kind,
            "".join(line_path(x[part], y[part]) for part in parts if len(part) > 1),
            "".join(line_path(x[part], y[part]) + "h0" for part in parts if len(part) == 1),
        )


def line_path(x: Integers, y: Integers) -> str:
    """SVG path in whole units, each step relative to the previous point."""
    steps = zip(np.diff(x).tolist(), np.diff(y).tolist(), strict=True)
    return f"M{x[0]} {y[0]}" + "".join(f"l{a} {b}" for a, b in steps)


def band_path(x: Integers, upper: Integers, lower: Integers, parts: Sequence[Integers]) -> str:
    """SVG path of the area between two lines; a bar for a part of one point."""
    text = []
    for part in parts:
        if len(part) == 1:
            k = int(part[0])
            text.append(f"M{x[k] - 1} {upper[k]}h2V{lower[k]}h-2z")
            continue
        forward = line_path(x[part], upper[part])
        back = line_path(x[part][::-1], lower[part][::-1])
        text.append(f"{forward}L{back[1:]}z")
    return "".join(text)


def parts_of(joins: Mask) -> list[Integers]:
    """Indices of the values in each run of joined ones."""
    if not len(joins):
        return []
    return np.split(np.arange(len(joins)), np.flatnonzero(~joins[1:]) + 1)


def band_of(
    time_ns: Integers, low: Vector, high: Vector, joins: Mask, axis: TimeAxis, scale: Scale
) -> str:
    """SVG path of the area between two lines where both are known."""
    known = np.isfinite(low) & np.isfinite(high)
    joins = (joins & np.append(False, known[:-1])[: len(known)])[known]
    if not len(joins):
        return ""
    x = axis.x(time_ns[known])
    return band_path(x, scale.y(high[known]), scale.y(low[known]), parts_of(joins))
