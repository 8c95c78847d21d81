"""Cache of the sky's zones and run catalogs, as seen by operators."""

from collections.abc import Callable, Sequence
from functools import partial

from service.acquire.prewarm import prewarm_zones
from service.advice.zone_size import ZoneCost, ZoneSize, zone_cost, zone_size
from service.app.context import Context
from service.contract.answers import ZoneSummary
from service.contract.spacecraft import CachedRunCatalog, CachedZone, ZoneCache
from service.ingest.solver_pool import mission_in_input
from service.missions.mission import Mission
from service.observations.schema import APrioriIn, prior_of
from service.sky.cache import CacheEntry, Sized
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.zones import Zone
from service.storage.queries.pages import ResultFilter, latest_time
from service.storage.queries.trends import latest_prior_errors
from service.storage.recording.unsaved_result import LIVE
from service.times import Utc, utc_now

MOST_ERRORS = 10_000
MOST_COSTS = 1_000


class Zones:
    """Service that shows, fills and empties the cache of zones."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._costs: dict[tuple[str, str, float], ZoneCost] = {}

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

    def advised_size(self, name: str, run: str | None) -> tuple[ZoneSize, list[ZoneCost]]:
        """Advise the size of a spacecraft's zone from a run's a priori errors.

        The errors are those of the latest `MOST_ERRORS` batches; a batch without an attitude has
        none.  The costs are those of the compared sizes, if another size is advised.
        """
        size, cost_of = self._size(name, run)
        changes = size.verdict in ("too_small", "larger_than_needed")
        return size, [cost_of(each) for each in size.sizes_deg] if changes else []

    def _size(self, name: str, run: str | None) -> tuple[ZoneSize, Callable[[float], ZoneCost]]:
        mission = self._context.mission(name)
        place = ResultFilter(run or LIVE, name)
        with self._context.reading_record() as connection:
            time = latest_time(connection, place, utc_now())
            angles_deg, sigmas_deg = latest_prior_errors(connection, place, MOST_ERRORS)
        run_catalog = self._context.sky.run_catalog(mission, time or utc_now())
        size = zone_size(mission, angles_deg, sigmas_deg)
        return size, partial(self._cost, mission, run_catalog)

    def _cost(self, mission: Mission, run_catalog: RunCatalog, size_deg: float) -> ZoneCost:
        """Cost of searching a zone of a given size; searching the whole sky takes up to seconds."""
        key = mission.digest, run_catalog.digest, size_deg
        if key not in self._costs:
            if len(self._costs) >= MOST_COSTS:
                self._costs.clear()
            self._costs[key] = zone_cost(mission, run_catalog.direction, size_deg)
        return self._costs[key]

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
