"""Observed against catalog magnitude: how many stars each small square of the plane has."""

from dataclasses import dataclass

import numpy as np

from service.storage.models.charts import TrackerStarsOfPeriod
from service.vectors import Vector
from service.web.console.charts.period.histogram import robust_spread

SIZE = 300.0
LEFT, FOOT = 28.0, 24.0
CELLS = 40
SHADES = (1, 2, 4, 8, 16)
"""Stars in a cell, from which on it has the next shade."""


@dataclass(frozen=True)
class MagnitudeRow:
    """Stars of one catalog magnitude: their mean offset, observed minus catalog, and spread."""

    low_mag: float
    stars: int
    offset_mag: float
    spread_mag: float | None


@dataclass(frozen=True)
class MagnitudeChart:
    """The chart; `shades` are paths of cells, from few stars to many."""

    shades: tuple[str, ...]
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
    height: float = SIZE + FOOT + 6.0


def magnitude_chart(tracker: TrackerStarsOfPeriod) -> MagnitudeChart | None:
    """The chart of a tracker; None where no unique star came with a magnitude."""
    known = np.isfinite(tracker.observed_mag)
    observed, catalog = tracker.observed_mag[known], tracker.catalog_mag[known]
    if not len(observed):
        return None
    both = np.concatenate([observed, catalog])
    low, high = float(np.floor(both.min() * 2) / 2), float(np.ceil(both.max() * 2) / 2)
    high = max(high, low + 1.0)
    side = SIZE / CELLS

    def place(mag: Vector | float) -> Vector:
        return np.asarray((mag - low) / (high - low) * SIZE)

    # Brighter stars, of lower magnitude, to the left and at the foot.
    column = np.clip(place(catalog) // side, 0, CELLS - 1).astype(int)
    row = np.clip(place(observed) // side, 0, CELLS - 1).astype(int)
    counts = np.zeros((CELLS, CELLS), dtype=int)
    np.add.at(counts, (row, column), 1)
    shades = [
        "".join(
            f"M{LEFT + j * side:g} {6 + SIZE - (i + 1) * side:g}h{side:g}v{side:g}h{-side:g}z"
            for i, j in np.argwhere((counts >= least) & (counts < most)).tolist()
        )
        for least, most in zip(SHADES, (*SHADES[1:], np.inf), strict=True)
    ]
    marks = [float(each) for each in np.arange(np.ceil(low), high + 0.01) if high - low <= 12]
    offset = observed - catalog
    return MagnitudeChart(
        shades=tuple(shades),
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
