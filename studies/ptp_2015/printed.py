"""The printed experiments of Zhou & Ye 2015: the tables, and the text's numbers on figures.

The figures themselves are pictures without numbers; the text gives the ends of
their lines.
"""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

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
    """All of it.  `axis` and `mean_projection` are solved for from the nine rows of Table 1."""

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
    data = json.loads(_FILE.read_text(encoding="utf-8"))
    return Printed(
        axis=tuple(data["table_1"]["axis"]),
        mean_projection=data["table_1"]["mean_projection"],
        table_1=tuple((index, value) for index, value in data["table_1"]["rows"]),
        table_1_sides=tuple(map(tuple, data["table_1"]["sides"])),
        table_3=data["table_3"],
        table_2=tuple((index, count) for index, count in data["table_2"]),
        catalog_stars=data["catalog_stars"],
        table_5=tuple(Slaves(**row) for row in data["table_5"]),
        table_6=tuple(Compared(**row) for row in data["table_6"]),
        figure_10=StarsInField(**data["figure_10"]),
        figure_12=_ends(data["figure_12"]),
        figure_13=_ends(data["figure_13"]),
    )


def _ends(rates: dict[str, Any]) -> Ends:
    return {name: (first, last) for name, (first, last) in rates.items()}
