"""The sky model: run catalogs for epochs, zones, and whole-sky indexes, all cached."""

from collections.abc import Callable, Hashable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

from service.missions.mission import Mission
from service.sky.cache import LruCache, NotAtHand
from service.sky.catalog.run_catalog import RunCatalog, build_run_catalog
from service.sky.catalog.star_catalog import Catalog
from service.sky.files import Content, is_kept, kept
from service.sky.geometry.triangles import SLAVES
from service.sky.whole_sky.guide import Guide, GuideKey, build_guide
from service.sky.whole_sky.index import FURTHER_MAG, SkyIndex, build_sky_index
from service.sky.zones import SearchRegion, Zone, ZoneKey, zone_for
from service.times import Utc

Kept = TypeVar("Kept", RunCatalog, SkyIndex)


class RunCatalogKey(NamedTuple):
    """The inputs of a run catalog: its key in the cache and among the files."""

    catalog: str
    settings: str
    epoch_year: float


class SkyIndexKey(NamedTuple):
    """The inputs of a whole-sky index: its key in the cache and among the files."""

    run_catalog: RunCatalogKey
    limit_mag: float
    radius_deg: float


@dataclass(frozen=True)
class SkyModel:
    """A star catalog with a cache of everything derived from it.

    Run catalogs and whole-sky indexes are also stored in files: see `service.sky.files`.
    """

    catalog: Catalog
    cache: LruCache
    require_whole_sky: Callable[[], None] = field(default=lambda: None, kw_only=True)
    """Function called before a search of the whole sky; it raises `Busy` while kernels compile."""
    builder: Executor | None = field(default=None, kw_only=True)
    """The executor that builds missing sky files while `BeingBuilt` is raised, or None.

    None if the caller builds them.
    """
    opens_files: bool = field(default=True, kw_only=True)
    """False if content is built anew and not opened, so that the code that builds it compiles."""
    waits: bool = field(default=True, kw_only=True)
    """True if the model builds missing items; false if it raises `NotAtHand` instead."""

    def at_hand(self) -> "SkyModel":
        """The same sky model, which raises `NotAtHand` instead of building anything."""
        return replace(self, waits=False, require_whole_sky=_not_at_hand)

    def run_catalog(self, mission: Mission, time: Utc) -> RunCatalog:
        """The run catalog of a mission for the epoch nearest to a time."""
        settings = mission.run_catalog_settings
        epoch_year = mission.catalog.epoch_of(time.julian_year)
        key = RunCatalogKey(self.catalog.digest, settings.digest, epoch_year)

        def build() -> Content:
            return build_run_catalog(self.catalog, settings, epoch_year).content

        return self._kept("run-catalog", key, build, RunCatalog.of_content)

    def _kept(
        self,
        kind: str,
        key: Hashable,
        build: Callable[[], Content],
        made_of: Callable[[Content], Kept],
    ) -> Kept:
        """The object made from the content of a sky file, kept in the memory cache."""

        def find_builder() -> Executor | None:
            # Opening a file takes less time than waiting for another thread.
            return None if self.builder is None or is_kept(kind, key) else self.builder

        def make() -> Kept:
            return made_of(kept(kind, key, build) if self.opens_files else build())

        thing, _ = self.cache.get((kind, key), make, find_builder, self.waits)
        return thing

    def zone(
        self,
        mission: Mission,
        run_catalog: RunCatalog,
        region: SearchRegion,
        separation_max_deg: float,
        grid_deg: float,
    ) -> tuple[Zone, bool]:
        """The zone that serves a search region, and true if it was cached."""
        asked = (mission.name, run_catalog, region, separation_max_deg, grid_deg)
        return zone_for(self.cache, *asked, wait=self.waits)

    def guide(self, run_catalog: RunCatalog, reach_deg: float) -> Guide:
        """The guide database of PTP for trackers with a field of view of a given radius."""
        key = GuideKey(run_catalog.digest, reach_deg, SLAVES)
        guide, _ = self.cache.get(key, lambda: build_guide(run_catalog, reach_deg))
        return guide

    def index(self, mission: Mission, run_catalog: RunCatalog, radius_deg: float) -> SkyIndex:
        """The whole-sky index of a mission's run catalog, for fields of view of a given radius.

        It includes stars a little beyond the catalog's limit, which noise may make visible.
        """
        limit_mag = mission.catalog.magnitude_limit_mag
        settings = mission.run_catalog_settings
        epoch_year = run_catalog.epoch_year
        key = SkyIndexKey(
            RunCatalogKey(self.catalog.digest, settings.digest, epoch_year), limit_mag, radius_deg
        )

        def build() -> Content:
            further = settings.model_copy(update={"magnitude_limit_mag": limit_mag + FURTHER_MAG})
            deeper = build_run_catalog(self.catalog, further, epoch_year)
            return build_sky_index(deeper, limit_mag, radius_deg).content

        return self._kept("whole-sky", key, build, SkyIndex.of_content)

    def drop_zones(self, mission: str | None = None) -> int:
        """Remove the zones of a mission, or all zones, from the cache; returns their number."""
        return self.cache.drop(
            lambda key: isinstance(key, ZoneKey) and mission in (None, key.mission)
        )


def _not_at_hand() -> None:
    raise NotAtHand
