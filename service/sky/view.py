"""The sky as one batch sees it: the run catalog of its epoch and the zones in it."""

from dataclasses import dataclass
from typing import NamedTuple

from service.missions.mission import Mission
from service.sky.catalog import Catalog
from service.sky.guide import Guide, GuideKey, build_guide
from service.sky.run_catalog import RunCatalog, build_run_catalog
from service.sky.shelf import Shelf
from service.sky.sky_index import FURTHER_MAG, SkyIndex, sky_index_for
from service.sky.triangles import SLAVES
from service.sky.zones import Aim, Zone, ZoneKey, zone_for
from service.times import Utc


class RunCatalogKey(NamedTuple):
    """What a run catalog depends on: the key under which the shelf keeps it."""

    catalog: str
    settings: str
    epoch_year: float


@dataclass(frozen=True)
class Sky:
    """A star catalog with the shelf that caches what is derived from it."""

    catalog: Catalog
    shelf: Shelf

    def run_catalog(self, mission: Mission, time: Utc) -> RunCatalog:
        """The run catalog that serves a mission at a time: that of the nearest epoch."""
        epoch_year = mission.catalog.epoch_of(time.julian_year)
        key = RunCatalogKey(self.catalog.digest, mission.catalog.digest, epoch_year)
        run_catalog, _ = self.shelf.get(
            key, lambda: build_run_catalog(self.catalog, mission.catalog, epoch_year)
        )
        return run_catalog

    def zone(
        self,
        mission: Mission,
        run_catalog: RunCatalog,
        aim: Aim,
        separation_max_deg: float,
        grid_deg: float,
    ) -> tuple[Zone, bool]:
        """The zone that serves an aim, and whether it was on the shelf."""
        return zone_for(self.shelf, mission.name, run_catalog, aim, separation_max_deg, grid_deg)

    def guide(self, run_catalog: RunCatalog, reach_deg: float) -> Guide:
        """The guide database of PTP for trackers that see so far from their boresight."""
        key = GuideKey(run_catalog.digest, reach_deg, SLAVES)
        guide, _ = self.shelf.get(key, lambda: build_guide(run_catalog, reach_deg))
        return guide

    def index(self, mission: Mission, run_catalog: RunCatalog, radius_deg: float) -> SkyIndex:
        """The whole sky of a mission's run catalog, for fields of view of a radius.

        Stars a little beyond the catalog's limit, which noise may show, are known to it.
        """
        limit_mag = mission.catalog.magnitude_limit_mag
        settings = mission.catalog.model_copy(
            update={"magnitude_limit_mag": limit_mag + FURTHER_MAG}
        )
        index, _ = sky_index_for(
            self.shelf,
            run_catalog,
            limit_mag,
            radius_deg,
            lambda: build_run_catalog(self.catalog, settings, run_catalog.epoch_year),
        )
        return index

    def drop_zones(self, mission: str | None = None) -> int:
        """Take the zones of a mission, or all, off the shelf; how many there were."""
        return self.shelf.drop(
            lambda key: isinstance(key, ZoneKey) and mission in (None, key.mission)
        )
