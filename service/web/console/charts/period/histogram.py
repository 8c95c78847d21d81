"""Residuals over their expected standard deviation as a histogram, with the unit normal."""

import math
from dataclasses import dataclass

import numpy as np

from service.storage.models.charts import TrackerStarsOfPeriod
from service.vectors import Vector

WIDTH, HEIGHT = 420.0, 210.0
FOOT = 24.0
REACH, STEP = 5.0, 0.5


def robust_spread(values: Vector) -> float:
    """The standard deviation of a normal distribution with the same median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


@dataclass(frozen=True)
class Bar:
    """One bar: its bounds, the residuals in it, and how many the unit normal would have."""

    low: float
    high: float
    count: int
    expected: float
    x: float
    y: float
    width: float
    height: float


@dataclass(frozen=True)
class Histogram:
    """Both components of every residual; `below` and `above` lie beyond the bars."""

    bars: tuple[Bar, ...]
    curve: str
    count: int
    below: int
    above: int
    median: float
    robust_spread: float
    """That of a normal distribution with the same median absolute deviation."""
    mean: float
    spread: float
    """The standard deviation; 1 where the sigmas are right."""
    ticks: tuple[tuple[float, str], ...]
    width: float = WIDTH
    height: float = HEIGHT + FOOT
    floor: float = HEIGHT


def residual_histogram(tracker: TrackerStarsOfPeriod) -> Histogram | None:
    """The histogram of a tracker; None where no star has a residual."""
    values = (tracker.residual_arcsec / tracker.expected_arcsec).ravel()
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    edges = np.arange(-REACH, REACH + STEP / 2, STEP)
    counts, _ = np.histogram(values, edges)
    expected = [len(values) * (_phi(high) - _phi(high - STEP)) for high in edges[1:].tolist()]
    top = max(int(counts.max()), len(values) * STEP * _density(0.0)) * 1.05

    def x(value: float) -> float:
        return (value + REACH) / (2 * REACH) * WIDTH

    def y(count: float) -> float:
        return HEIGHT * (1.0 - count / top)

    bars = [
        Bar(low, low + STEP, count, wanted, x(low), y(count), x(STEP) - x(0.0), HEIGHT - y(count))
        for low, count, wanted in zip(edges.tolist(), counts.tolist(), expected, strict=False)
    ]
    fine = np.arange(-REACH, REACH + 0.05, 0.1).tolist()
    points = " ".join(
        f"{x(each):.1f},{y(len(values) * STEP * _density(each)):.1f}" for each in fine
    )
    return Histogram(
        bars=tuple(bars),
        curve=points,
        count=len(values),
        below=int(np.sum(values < -REACH)),
        above=int(np.sum(values > REACH)),
        median=float(np.median(values)),
        robust_spread=robust_spread(values),
        mean=float(values.mean()),
        spread=float(values.std()),
        ticks=tuple((x(each), f"{each:+d}".replace("-", "−")) for each in (-4, -2, 2, 4)),
    )


def _density(value: float) -> float:
    return math.exp(-0.5 * value * value) / math.sqrt(2.0 * math.pi)


def _phi(value: float) -> float:
    return 0.5 * (1.0 + math.erf(value / math.sqrt(2.0)))
