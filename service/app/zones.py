"""The cache of zones and run catalogs."""

from collections.abc import Sequence

from service.acquire.prewarm import prewarm_zones
from service.app.context import Context
from service.ingest.solver_pool import mission_in_input
from service.observations.schema import APrioriIn, prior_of
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.zones import Zone
from service.storage.recording.unsaved_result import Row
from service.times import Utc


class Zones:
    """Shows, fills and empties the cache."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def state(self) -> Row:
        """What the cache holds, the least recently used first, and its counters."""
        state = self._context.sky.cache.state()
        zones, run_catalogs = [], []
        for entry in state.entries:
            use = {"bytes": entry.thing.nbytes, "hits": entry.hits, "build_us": entry.build_us}
            if isinstance(entry.thing, Zone):
                zone = entry.thing
                about = {"spacecraft": zone.mission, **zone.summary(), "grid_deg": zone.grid_deg}
                zones.append(about | {"run_catalog": zone.run_catalog} | use)
            elif isinstance(entry.thing, RunCatalog):
                catalog = entry.thing
                about = {"digest": catalog.digest, "epoch_year": catalog.epoch_year}
                run_catalogs.append(about | {"stars": len(catalog)} | use)
        return {
            "items": zones,
            "run_catalogs": run_catalogs,
            "bytes": state.nbytes,
            "max_bytes": state.max_bytes,
            "hits": state.hits,
            "misses": state.misses,
            "evictions": state.evictions,
            "build_us": state.build_us,
        }

    def warm(self, spacecraft: str, a_priori: Sequence[APrioriIn], time: Utc) -> list[Row]:
        """Build the zones that batches of these a priori attitudes will ask for."""
        mission = mission_in_input(self._context.missions, spacecraft)
        return [
            zone.summary()
            for each in a_priori
            for zone in prewarm_zones(self._context.sky, mission, prior_of(each), time)
        ]

    def drop(self, spacecraft: str | None = None) -> int:
        """Drop the cached zones of a spacecraft, or all; how many there were."""
        if spacecraft is not None:
            mission_in_input(self._context.missions, spacecraft)
        return self._context.sky.drop_zones(spacecraft)
