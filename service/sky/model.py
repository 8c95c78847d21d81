"""The sky of one batch: the run catalog of its epoch, and the zones in it."""

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
    """What a run catalog depends on: its key in the cache and among the files."""

    catalog: str
    settings: str
    epoch_year: float


class SkyIndexKey(NamedTuple):
    """What an index of the whole sky depends on: its key in the cache and among the files."""

    run_catalog: RunCatalogKey
    limit_mag: float
    radius_deg: float


@dataclass(frozen=True)
class SkyModel:
    """A star catalog, with the cache of all that is derived from it.

    Run catalogs and indexes of the whole sky are files, too: see `service.sky.files`.
    """

    catalog: Catalog
    cache: LruCache
    require_whole_sky: Callable[[], None] = field(default=lambda: None, kw_only=True)
    """Raises `Busy` while the kernels that search the whole sky are compiled."""
    builder: Executor | None = field(default=None, kw_only=True)
    """What builds files that are not there yet: `BeingBuilt` is raised meanwhile.

    None: the caller does."""
    opens_files: bool = field(default=True, kw_only=True)
    """False: everything is built anew, as where what builds it is to be compiled."""
    waits: bool = field(default=True, kw_only=True)
    """True: the model builds what is missing; False: it raises `NotAtHand` instead."""

    def at_hand(self) -> "SkyModel":
        """The same sky for who must not wait: what takes long raises `NotAtHand`."""
        return replace(self, waits=False, require_whole_sky=_not_at_hand)

    def run_catalog(self, mission: Mission, time: Utc) -> RunCatalog:
        """The run catalog that serves a mission at a time: that of the nearest epoch."""
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
        """The thing that `made_of` makes of a file's content, from the cache."""

        def find_builder() -> Executor | None:
            # To open a file takes less than to wait for another thread.
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
        """Drop the zones of a mission, or all, from the cache; how many there were."""
        return self.cache.drop(
            lambda key: isinstance(key, ZoneKey) and mission in (None, key.mission)
        )


def _not_at_hand() -> None:
    raise NotAtHand
