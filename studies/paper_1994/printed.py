"""Numbers printed in the paper: worlds, runs with their counts, times and k_g.

With each run are the results of an independent implementation of the same interpretation, from 40
experiments of the paper's size: the reference.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import msgspec

REFERENCE_EXPERIMENTS = 40
_FILE = Path(__file__).with_name("printed.json")

Angles = tuple[float, float, float]


@dataclass(frozen=True)
class World:
    """Zone positions for some tables of the paper, and the size of one experiment.

    A zone's axis is `axis_deg` (right ascension, declination), or the Sun's
    direction at one of `sun_dates`, or drawn over the sphere.
    """

    name: str
    mission: str
    off_axis_deg: float  # RCVIEW
    zones: int
    views: int
    axis_deg: tuple[float, float] | None = None
    sun_dates: tuple[str, ...] = ()

    @property
    def strata(self) -> int:
        """Number of kinds of zones that alternate, one per date of the Sun."""
        return max(1, len(self.sun_dates))


@dataclass(frozen=True)
class PrintedCounts:
    """Printed counts of a run: stars, ambiguous (or unmatched), correct and misidentified ones."""

    stars: int
    ambiguous: int
    correct: int
    misidentified: int


@dataclass(frozen=True)
class Reference:
    """Reference rates in percent; `sd` is the deviation of one experiment of the paper's size."""

    stars: int
    ambiguous_pct: float
    unmatched_pct: float
    misidentified_pct: float
    sd_unidentified_pct: float
    sd_misidentified_pct: float

    @property
    def unidentified_pct(self) -> float:
        """Percentage of stars that are ambiguous or unmatched."""
        return self.ambiguous_pct + self.unmatched_pct


@dataclass(frozen=True)
class Run:
    """A run of the paper: simulated errors, use of geometry tests, and printed counts.

    `rotation_arcsec` is the error of the attitude: phi, theta, psi.
    """

    table: str
    run: str
    world: str
    rotation_arcsec: Angles
    sigma_arcsec: float  # SIGOBS
    sigma_mag: float  # SIGMAG
    bound_mag: float  # RCMAG
    geometry: bool
    printed: PrintedCounts
    reference: Reference

    @property
    def number(self) -> int:
        """Number of the run's table: 9 for both 9D and 9F."""
        return int(self.table.rstrip("DF"))


@dataclass(frozen=True)
class Times:
    """A printed row of Tables 11 and 12: least and greatest times in seconds, NCAP and NTOT."""

    table: str
    world: str
    zones: int
    case: str
    total_s: float
    generate_s: tuple[float, float]
    first_s: tuple[float, float]
    later_s: tuple[float, float]
    stars: tuple[int, int]
    pairs: tuple[int, int]


@dataclass(frozen=True)
class Proportion:
    """A printed row of Tables 13 and 14: k_g from areas, and from NCAP and NTOT."""

    table: str
    stars: int
    pairs: int
    apparent: float
    geometric: float


@dataclass(frozen=True)
class Paper:
    """All numbers printed in the 1994 paper."""

    worlds: dict[str, World]
    runs: tuple[Run, ...]
    times: tuple[Times, ...]
    proportions: tuple[Proportion, ...]

    def runs_of(self, tables: Sequence[int]) -> tuple[Run, ...]:
        """Runs of the given tables, in the paper's order."""
        return tuple(run for run in self.runs if run.number in tables)


@cache
def the_paper() -> Paper:
    """Numbers printed in the 1994 paper, read once from a file."""
    data = msgspec.json.decode(_FILE.read_bytes())
    worlds = {name: {"name": name, **world} for name, world in data["worlds"].items()}
    return msgspec.convert({**data, "worlds": worlds}, Paper)
