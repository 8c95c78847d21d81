"""Histograms of star residuals over expected sigma, and of observed against catalog magnitude."""

import math
from dataclasses import dataclass

import numpy as np

from service.storage.queries.period import TrackerStarsOfPeriod
from service.vectors import Vector

WIDTH, HEIGHT = 420.0, 210.0
FOOT = 24.0
REACH, STEP = 5.0, 0.5


def robust_spread(values: Vector) -> float:
    """Standard deviation of a normal distribution with the same median absolute deviation."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


@dataclass(frozen=True)
class Bar:
    """Bar of a histogram: bounds, count of residuals, and expected count of the unit normal."""

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
    """Histogram of both components of all residuals; `below` and `above` lie beyond the bars."""

    bars: tuple[Bar, ...]
    curve: str
    count: int
    below: int
    above: int
    farthest: float
    """Residual over sigma that is farthest from zero."""
    median: float
    robust_spread: float
    """Sigma of a normal distribution with the same median absolute deviation."""
    mean: float
    spread: float
    """Standard deviation of the residuals over sigma; 1 with correct sigmas."""
    ticks: tuple[tuple[float, str], ...]
    width: float = WIDTH
    height: float = HEIGHT + FOOT
    floor: float = HEIGHT


def residual_histogram(tracker: TrackerStarsOfPeriod) -> Histogram | None:
    """Histogram of a tracker's residuals; None if no star has a residual."""
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
        farthest=float(values[np.argmax(np.abs(values))]),
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


SIZE = 300.0
LEFT, PLANE_FOOT = 28.0, 24.0
CELLS = 40
MOST_SPREADS, LEAST_SPREAD_MAG = 8.0, 0.1
"""Offsets of magnitude in robust spreads beyond which the axes do not reach for a star."""
SHADES = (1, 2, 4, 8, 16)
"""Numbers of stars at which a cell gets the next shade."""


@dataclass(frozen=True)
class MagnitudeRow:
    """Stars of one catalog magnitude: mean offset, observed minus catalog, and spread."""

    low_mag: float
    stars: int
    offset_mag: float
    spread_mag: float | None


@dataclass(frozen=True)
class MagnitudeChart:
    """Chart of observed against catalog magnitude; `shades` are paths, from few stars to many."""

    shades: tuple[str, ...]
    beyond: str
    """SVG path with a triangle at the edge for each star observed beyond it."""
    beyond_mag: tuple[float, ...]
    """Observed magnitudes beyond the edges, the faintest first."""
    equal: str
    ticks: tuple[tuple[float, float, str], ...]
    rows: tuple[MagnitudeRow, ...]
    stars: int
    median_mag: float
    robust_spread_mag: float
    offset_mag: float
    spread_mag: float
    left: float = LEFT
    size: float = SIZE
    width: float = LEFT + SIZE + 6.0
    height: float = SIZE + PLANE_FOOT + 6.0


def magnitude_chart(tracker: TrackerStarsOfPeriod) -> MagnitudeChart | None:
    """Magnitude chart of a tracker; None if no unique star has an observed magnitude."""
    known = np.isfinite(tracker.observed_mag)
    observed, catalog = tracker.observed_mag[known], tracker.catalog_mag[known]
    if not len(observed):
        return None
    offset = observed - catalog
    usual = np.median(offset) + MOST_SPREADS * max(
        robust_spread(offset), LEAST_SPREAD_MAG
    ) * np.array([-1, 1])
    inside = observed[(offset >= usual[0]) & (offset <= usual[1])]
    both = np.concatenate([inside, catalog])
    low, high = float(np.floor(both.min() * 2) / 2), float(np.ceil(both.max() * 2) / 2)
    high = max(high, low + 1.0)
    is_beyond = (observed < low) | (observed > high)
    side = SIZE / CELLS

    def place(mag: Vector | float) -> Vector:
        return np.asarray((mag - low) / (high - low) * SIZE)

    # Brighter stars, of lower magnitude, to the left and at the foot.
    column = np.clip(place(catalog) // side, 0, CELLS - 1).astype(int)
    row = np.clip(place(observed) // side, 0, CELLS - 1).astype(int)
    counts = np.zeros((CELLS, CELLS), dtype=int)
    np.add.at(counts, (row[~is_beyond], column[~is_beyond]), 1)
    shades = [
        "".join(
            f"M{LEFT + j * side:g} {6 + SIZE - (i + 1) * side:g}h{side:g}v{side:g}h{-side:g}z"
            for i, j in np.argwhere((counts >= least) & (counts < most)).tolist()
        )
        for least, most in zip(SHADES, (*SHADES[1:], np.inf), strict=True)
    ]
    marks = [float(each) for each in np.arange(np.ceil(low), high + 0.01) if high - low <= 12]
    return MagnitudeChart(
        shades=tuple(shades),
        beyond="".join(
            f"M{LEFT + float(place(mag)):.0f} " + ("6l4 8h-8z" if up else f"{6 + SIZE:g}l4 -8h-8z")
            for mag, up in zip(
                catalog[is_beyond].tolist(), (observed[is_beyond] > high).tolist(), strict=True
            )
        ),
        beyond_mag=tuple(np.sort(observed[is_beyond])[::-1].tolist()),
        equal=f"M{LEFT} {6 + SIZE}L{LEFT + SIZE} 6",
        ticks=tuple(
            (
                LEFT + float(place(each)),
                6 + SIZE - float(place(each)),
                f"{each:g}".replace("-", "−"),
            )
            for each in marks
        ),
        rows=tuple(_rows(catalog, offset)),
        stars=len(observed),
        median_mag=float(np.median(offset)),
        robust_spread_mag=robust_spread(offset),
        offset_mag=float(offset.mean()),
        spread_mag=float(offset.std()),
    )


def _rows(catalog: Vector, offset: Vector) -> list[MagnitudeRow]:
    whole = np.floor(catalog)
    return [
        MagnitudeRow(
            low_mag=float(low),
            stars=int(np.sum(whole == low)),
            offset_mag=float(offset[whole == low].mean()),
            spread_mag=float(offset[whole == low].std()) if np.sum(whole == low) > 1 else None,
        )
        for low in np.unique(whole)
    ]
