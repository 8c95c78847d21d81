"""The sky of one batch: the run catalog of its epoch, and the zones in it."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from service.missions.mission import Mission
from service.sky.cache import LruCache, NotAtHand
from service.sky.catalog.run_catalog import RunCatalog, build_run_catalog
from service.sky.catalog.star_catalog import Catalog
from service.sky.geometry.triangles import SLAVES
from service.sky.whole_sky.guide import Guide, GuideKey, build_guide
from service.sky.whole_sky.index import FURTHER_MAG, SkyIndex, sky_index_for
from service.sky.zones import SearchRegion, Zone, ZoneKey, zone_for
from service.times import Utc


class RunCatalogKey(NamedTuple):
    """What a run catalog depends on: its key in the cache."""

    catalog: str
    settings: str
    epoch_year: float


@dataclass(frozen=True)
class SkyModel:
    """A star catalog, with the cache of all that is derived from it."""

    catalog: Catalog
    cache: LruCache
    require_whole_sky: Callable[[], None] = field(default=lambda: None, kw_only=True)
    """Raises `Busy` while the kernels that search the whole sky are compiled."""
    waits: bool = field(default=True, kw_only=True)
    """Whether it builds what is missing, or raises `NotAtHand` there."""

    def at_hand(self) -> "SkyModel":
        """The same sky for who must not wait: what takes long raises `NotAtHand`."""
        return replace(self, waits=False, require_whole_sky=_not_at_hand)

    def run_catalog(self, mission: Mission, time: Utc) -> RunCatalog:
        """The run catalog that serves a mission at a time: that of the nearest epoch."""
        epoch_year = mission.catalog.epoch_of(time.julian_year)
        key = RunCatalogKey(self.catalog.digest, mission.run_catalog_settings.digest, epoch_year)
        run_catalog, _ = self.cache.get(
            key,
            lambda: build_run_catalog(self.catalog, mission.run_catalog_settings, epoch_year),
            self.waits,
        )
        return run_catalog

    def zone(
        self,
        mission: Mission,
        run_catalog: RunCatalog,
        region: SearchRegion,
        separation_max_deg: float,
        grid_deg: float,
    ) -> tuple[Zone, bool]:
        """The zone that serves a search region, and whether it was cached."""
        asked = (mission.name, run_catalog, region, separation_max_deg, grid_deg)
        return zone_for(self.cache, *asked, wait=self.waits)

    def guide(self, run_catalog: RunCatalog, reach_deg: float) -> Guide:
        """The guide database of PTP for trackers that see so far from their boresight."""
        key = GuideKey(run_catalog.digest, reach_deg, SLAVES)
        guide, _ = self.cache.get(key, lambda: build_guide(run_catalog, reach_deg))
        return guide

    def index(self, mission: Mission, run_catalog: RunCatalog, radius_deg: float) -> SkyIndex:
        """The whole sky of a mission's run catalog, for fields of view of a radius.

        Stars a little beyond the catalog's limit, which noise may show, are known to it.
        """
        limit_mag = mission.catalog.magnitude_limit_mag
        settings = mission.run_catalog_settings.model_copy(
            update={"magnitude_limit_mag": limit_mag + FURTHER_MAG}
        )
        index, _ = sky_index_for(
            self.cache,
            run_catalog,
            limit_mag,
            radius_deg,
            lambda: build_run_catalog(self.catalog, settings, run_catalog.epoch_year),
        )
        return index

    def drop_zones(self, mission: str | None = None) -> int:
        """Drop the zones of a mission, or all, from the cache; how many there were."""
        return self.cache.drop(
            lambda key: isinstance(key, ZoneKey) and mission in (None, key.mission)
        )


def _not_at_hand() -> None:
    raise NotAtHand
