"""The printed experiments of Zhou & Ye 2015: the tables, and the text's numbers on figures.

The figures themselves are pictures without numbers; the text gives the ends of
their lines.
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
    """A row of Table 5: the guide database with so many slaves, at no noise."""

    slaves: int
    memory_mb: float
    rate_pct: float
    time_ms: float


@dataclass(frozen=True)
class Compared:
    """A row of Table 6: an algorithm at one pixel and half a magnitude of noise."""

    algorithm: str
    rate_pct: float
    time_ms: float
    memory_mb: float


@dataclass(frozen=True)
class StarsInField:
    """The text's numbers on Figure 10: stars in the field of view over 10,000 attitudes."""

    least: int
    most: int
    mean: float
    more_than_8_pct: float


@dataclass(frozen=True)
class Printed:
    """Figures printed in the paper.  `axis` and `mean_projection` are solved for from Table 1."""

    axis: tuple[float, ...]
    mean_projection: float
    table_1: tuple[tuple[int, float], ...]
    """Index and projection of the nine rows that are printed."""
    table_1_sides: tuple[tuple[float, ...], ...]
    """The three sides of each of these rows."""
    table_3: dict[str, Any]
    """Four triangles: stars of the field and their SAO numbers; the stars that are identified."""
    table_2: tuple[tuple[int, int], ...]
    """Limit index and k-vector."""
    catalog_stars: int
    table_5: tuple[Slaves, ...]
    table_6: tuple[Compared, ...]
    figure_10: StarsInField
    figure_12: Ends
    """Rates in percent at no noise of position and at two pixels."""
    figure_13: Ends
    """Rates in percent at no noise of magnitude and at half a magnitude."""


@cache
def the_ptp_paper() -> Printed:
    """The printed numbers, read once."""
    data = msgspec.json.decode(_FILE.read_bytes())
    table_1 = data["table_1"]
    of_table_1 = {
        "axis": table_1["axis"],
        "mean_projection": table_1["mean_projection"],
        "table_1": table_1["rows"],
        "table_1_sides": table_1["sides"],
    }
    return msgspec.convert(data | of_table_1, Printed)
