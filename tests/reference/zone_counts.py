"""Stars and pairs of the paper's own zones, from a catalog of today, beside the paper's."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from service.missions.mission import Band, Cap, Mission, load_missions
from service.sky.ephemeris import sun_direction
from service.sky.model import SkyModel
from service.sky.zones import SearchRegion
from service.times import Utc, parse_utc
from service.vectors import Vector, from_ra_dec

_FILE = Path(__file__).with_name("zone_counts.json")


@dataclass(frozen=True)
class ZoneQuantity:
    """One quantity of one zone, the paper's and ours; `within` is the bound on their ratio."""

    zone: str
    quantity: str
    paper: int
    ours: int
    within: float

    @property
    def off(self) -> float:
        """Our count beyond the paper's, as a share of the paper's."""
        return self.ours / self.paper - 1.0

    @property
    def passed(self) -> bool:
        """True if the difference is within its bound."""
        return abs(self.off) <= self.within


def counted(sky: SkyModel, mission: Mission, axis: Vector, time: Utc) -> tuple[int, int]:
    """Stars and pairs of a mission's exact zone about an axis."""
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


def counts(sky: SkyModel) -> Iterator[ZoneQuantity]:
    """Every count that the paper prints, beside what is found here."""
    paper = json.loads(_FILE.read_text(encoding="utf-8"))
    missions = load_missions()
    time = parse_utc(paper["time"])
    for zone in paper["zones"]:
        axis = from_ra_dec(zone["ra_deg"], zone["dec_deg"])
        found = counted(sky, missions[zone["mission"]], axis, time)
        for quantity, ours in zip(("stars", "pairs"), found, strict=True):
            yield ZoneQuantity(
                zone["name"], quantity, zone[quantity], ours, paper["within"][quantity]
            )
    bands = paper["sun_bands"]
    mission = missions[bands["mission"]]
    months = [
        counted(sky, mission, sun_direction(time, None), time)
        for time in map(parse_utc, bands["times"])
    ]
    for extreme, pick in (("fewest", min), ("most", max)):
        for k, quantity in enumerate(("stars", "pairs")):
            yield ZoneQuantity(
                f"{bands['name']}, {extreme}",
                quantity,
                bands[extreme][quantity],
                pick(month[k] for month in months),
                paper["within"][quantity],
            )
