"""Cache of the sky's zones and run catalogs, as seen by operators."""

from collections.abc import Sequence

from service.acquire.prewarm import prewarm_zones
from service.app.context import Context
from service.contract.answers import ZoneSummary
from service.contract.spacecraft import CachedRunCatalog, CachedZone, ZoneCache
from service.ingest.solver_pool import mission_in_input
from service.observations.schema import APrioriIn, prior_of
from service.sky.cache import CacheEntry, Sized
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.zones import Zone
from service.times import Utc


class Zones:
    """Service that shows, fills and empties the cache of zones."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def state(self) -> ZoneCache:
        """Content of the cache of zones, least recently used first, with counters."""
        state = self._context.sky.cache.state()
        return ZoneCache(
            items=[
                _zone(each, each.thing) for each in state.entries if isinstance(each.thing, Zone)
            ],
            run_catalogs=[
                _run_catalog(each, each.thing)
                for each in state.entries
                if isinstance(each.thing, RunCatalog)
            ],
            bytes=state.nbytes,
            max_bytes=state.max_bytes,
            hits=state.hits,
            misses=state.misses,
            evictions=state.evictions,
            build_us=state.build_us,
        )

    def warm(self, spacecraft: str, a_priori: Sequence[APrioriIn], time: Utc) -> list[ZoneSummary]:
        """Build the zones for batches with the given a priori attitudes, in advance."""
        mission = mission_in_input(self._context.missions, spacecraft)
        return [
            ZoneSummary(**zone.summary())
            for each in a_priori
            for zone in prewarm_zones(self._context.sky, mission, prior_of(each), time)
        ]

    def drop(self, spacecraft: str | None = None) -> int:
        """Drop the cached zones of a spacecraft, or all; returns their number."""
        if spacecraft is not None:
            mission_in_input(self._context.missions, spacecraft)
        return self._context.sky.drop_zones(spacecraft)


def _zone(entry: CacheEntry[Sized], zone: Zone) -> CachedZone:
    return CachedZone(
        **zone.summary(),
        spacecraft=zone.mission,
        grid_deg=zone.grid_deg,
        run_catalog=zone.run_catalog,
        bytes=zone.nbytes,
        hits=entry.hits,
        build_us=entry.build_us,
    )


def _run_catalog(entry: CacheEntry[Sized], catalog: RunCatalog) -> CachedRunCatalog:
    return CachedRunCatalog(
        digest=catalog.digest,
        epoch_year=catalog.epoch_year,
        stars=len(catalog),
        bytes=catalog.nbytes,
        hits=entry.hits,
        build_us=entry.build_us,
    )
