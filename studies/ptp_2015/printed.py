"""Numbers printed by Zhou & Ye 2015: tables, and values in the text about figures.

The figures themselves are pictures without numbers; the text gives the end points of their lines.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import msgspec

_FILE = Path(__file__).with_name("printed.json")

Ends = dict[str, tuple[float, float]]


@dataclass(frozen=True)
class Slaves:
    """A row of Table 5: guide database with a number of slave stars, without noise."""

    slaves: int
    memory_mb: float
    rate_pct: float
    time_ms: float


@dataclass(frozen=True)
class Compared:
    """A row of Table 6: results of an algorithm at one pixel and half a magnitude of noise."""

    algorithm: str
    rate_pct: float
    time_ms: float
    memory_mb: float


@dataclass(frozen=True)
class StarsInField:
    """Printed values of Figure 10: stars in the field of view over 10,000 attitudes."""

    least: int
    most: int
    mean: float
    more_than_8_pct: float


@dataclass(frozen=True)
class Printed:
    """Numbers printed in the paper.  `axis` and `mean_projection` are solved for from Table 1."""

    axis: tuple[float, ...]
    mean_projection: float
    table_1: tuple[tuple[int, float], ...]
    """Index and projection in the nine printed rows of Table 1."""
    table_1_sides: tuple[tuple[float, ...], ...]
    """Three sides of each triangle printed in Table 1."""
    table_3: dict[str, Any]
    """Table 3: four triangles as stars of the field and SAO numbers, and the identified stars."""
    table_2: tuple[tuple[int, int], ...]
    """Rows of Table 2: limit index and k-vector."""
    catalog_stars: int
    table_5: tuple[Slaves, ...]
    table_6: tuple[Compared, ...]
    figure_10: StarsInField
    figure_12: Ends
    """Rates in percent without noise of position, and at two pixels."""
    figure_13: Ends
    """Rates in percent without noise of magnitude, and at half a magnitude."""


@cache
def the_ptp_paper() -> Printed:
    """Numbers printed in the PTP paper, read once from a file."""
    data = msgspec.json.decode(_FILE.read_bytes())
    table_1 = data["table_1"]
    of_table_1 = {
        "axis": table_1["axis"],
        "mean_projection": table_1["mean_projection"],
        "table_1": table_1["rows"],
        "table_1_sides": table_1["sides"],
    }
    return msgspec.convert(data | of_table_1, Printed)
