"""Innovations with their bounds, and the chi-square of each measurement."""

from functools import lru_cache

import numpy as np

from service.filtering.gyro import FilterSettings
from service.grades.innovations import MeasuredInnovations
from service.web.console.charts.grades.grades import bounded_chart
from service.web.console.charts.grades.panels import (
    GradeChart,
    GradePanel,
    Scale,
    TimeAxis,
    Values,
    marks_of,
)
from service.web.console.formatting import level

DEGREES = 3
INSIDE = 0.95
"""Of the measurements are between the lower two bounds, where the covariances are right."""


@lru_cache(maxsize=1)
def chi_square_bounds() -> tuple[float, float, float]:
    """The region of 95 %, and what is rejected beyond."""
    # Imported here: loading it takes longer than drawing the page.
    from scipy.special import chdtri

    tail = (1.0 - INSIDE) / 2.0
    gate = FilterSettings().gate_tail
    return tuple(float(chdtri(DEGREES, each)) for each in (1.0 - tail, tail, gate))  # type: ignore[return-value]


def innovation_charts(met: MeasuredInnovations, axis: TimeAxis) -> list[GradeChart]:
    """Innovations about the body axes, and their chi-square."""
    known = met.taken(np.isfinite(met.nis))
    if not len(known):
        return []
    sigma = known.innovation_sigma_arcsec
    return [
        bounded_chart(
            "innovation",
            "Innovations: measured minus predicted attitude",
            known,
            known.innovation_arcsec,
            sigma,
            axis,
        ),
        _chi_square(known, axis),
    ]


def _chi_square(met: MeasuredInnovations, axis: TimeAxis) -> GradeChart:
    low, high, gate = chi_square_bounds()
    used = met.is_used
    scale = Scale(low / 4.0, gate * 2.0, is_log=True)
    inside = int(np.count_nonzero((met.nis[used] >= low) & (met.nis[used] <= high)))
    count = int(np.count_nonzero(used))
    mean = float(met.nis[used].mean()) / DEGREES if count else 0.0
    panel = GradePanel(
        "χ²",
        (Values(met.tai_ns[used], met.nis[used]).trace("raw", axis, scale),),
        "",
        marks_of(met.tai_ns[~used], met.nis[~used], axis, scale),
        tuple(scale.y(np.array([low, high, gate])).tolist()),
        f"lines at {level(low)} and {level(high)} (95 %) and at {level(gate)} (gate); logarithmic",
        scale,
        "",
    )
    share = f"{100.0 * inside / count:.1f} %" if count else "–"
    row = ("χ²", level(mean), share, str(int(np.count_nonzero(~used))))
    columns = ("", "mean by degree, about 1", "inside 95 %", "not used")
    return GradeChart("chi-square", "Chi-square of each measurement", (panel,), columns, (row,))
