"""Stars and pairs of the paper's own zones, from the shipped catalog, beside the paper's."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from benchmarks.bounds import Bound, at_most
from benchmarks.record import CORE
from benchmarks.report import Report
from benchmarks.sections import Section, Written, table
from service.missions.mission import Band, Cap, Mission, load_missions
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.ephemeris import sun_direction
from service.sky.model import SkyModel
from service.sky.zones import SearchRegion
from service.times import Utc, parse_utc
from service.vectors import Vector, from_ra_dec

PAPER = Path(__file__).parent.parent / "tests" / "studies" / "against_paper" / "zone_counts.json"


@dataclass(frozen=True)
class Count:
    """One quantity of one zone, the paper's and ours; `within` is the bound on their ratio."""

    zone: str
    quantity: str
    paper: int
    here: int
    within: float

    @property
    def off(self) -> float:
        return self.here / self.paper - 1.0

    @property
    def passed(self) -> bool:
        return abs(self.off) <= self.within


def counted(sky: SkyModel, mission: Mission, axis: Vector, time: Utc) -> tuple[int, int]:
    """Stars and pairs of the exact zone about an axis."""
    zone = mission.zone
    if isinstance(zone, Cap):
        region = SearchRegion("cap", axis, 0.0, zone.radius_deg)
    else:
        assert isinstance(zone, Band)
        middle, half = zone.coelevation_deg, zone.half_width_deg
        region = SearchRegion("band", axis, middle - half, middle + half)
    limit = mission.tolerances.pair_separation_max_deg
    found, _ = sky.zone(mission, sky.run_catalog(mission, time), region, limit, 0.0)
    return len(found.star), found.pairs.count


def counts(sky: SkyModel) -> Iterator[Count]:
    """Every count that the paper prints, beside what is found here."""
    paper = json.loads(PAPER.read_text(encoding="utf-8"))
    missions = load_missions()
    time = parse_utc(paper["time"])
    for zone in paper["zones"]:
        axis = from_ra_dec(zone["ra_deg"], zone["dec_deg"])
        found = counted(sky, missions[zone["mission"]], axis, time)
        for quantity, here in zip(("stars", "pairs"), found, strict=True):
            yield Count(zone["name"], quantity, zone[quantity], here, paper["within"][quantity])
    bands = paper["sun_bands"]
    mission = missions[bands["mission"]]
    months = [
        counted(sky, mission, sun_direction(time, None), time)
        for time in map(parse_utc, bands["times"])
    ]
    for extreme, pick in (("fewest", min), ("most", max)):
        for k, quantity in enumerate(("stars", "pairs")):
            yield Count(
                f"{bands['name']}, {extreme}",
                quantity,
                bands[extreme][quantity],
                pick(month[k] for month in months),
                paper["within"][quantity],
            )


def run(quick: bool, seed: int) -> Report:
    """The benchmark's form of it; neither the size nor the seed matters."""
    found = list(counts(SkyModel(load_embedded(), LruCache(256 << 20))))
    figures = {
        f"{c.zone}, {c.quantity}": f"{c.here:,} (paper {c.paper:,}, {c.off:+.1%})" for c in found
    }
    return Report("zone_counts", figures, bounds_of(found))


def bounds_of(found: list[Count]) -> list[Bound]:
    """The largest difference of each quantity, stars and pairs."""
    return [
        at_most(
            f"largest difference of {quantity}, as a share",
            max(abs(c.off) for c in found if c.quantity == quantity),
            next(c.within for c in found if c.quantity == quantity),
        )
        for quantity in dict.fromkeys(c.quantity for c in found)
    ]


def write(quick: bool, seed: int) -> Written:
    """The section of the verification; neither the size nor the seed matters."""
    found = list(counts(SkyModel(load_embedded(), LruCache(256 << 20))))
    rows = [(c.zone, c.quantity, c.paper, c.here, f"{c.off:+.1%}") for c in found]
    text = f"""
Stars and pairs of the zones whose counts Fink & Shoup print, from the catalog that is shipped.
Their run catalogs of 1994 are not to be had, so agreement within 8 % of the stars and 15 % of the
pairs is asked for, not equality. The bands about the Sun are those of the first of each month from
July 1995 to January 1996; of these the paper gives the fewest and the most.

{table(("zone", "of", "paper", "here", "difference"), rows, numbers=3)}
"""
    return Written(text, bounds_of(found))


SECTION = Section("The sky", write, (*CORE, "tests/studies/against_paper/zone_counts.json"))
