"""The cache of zones."""

from service.web.schemas.answers import ZoneSummary
from service.web.schemas.base import Count, Digest, Shape


class CacheUse(Shape):
    """What a cached thing costs and gives."""

    bytes: Count
    hits: Count
    build_us: Count


class CachedZone(ZoneSummary, CacheUse):
    """A zone in the cache."""

    spacecraft: str
    grid_deg: float
    run_catalog: Digest


class CachedRunCatalog(CacheUse):
    """A run catalog in the cache."""

    digest: Digest
    epoch_year: float
    stars: Count


class ZoneCache(Shape):
    """The cache: what it holds, least recently used first, and its counters.

    Every batch asks for its run catalog and for the zone of each tracker; the
    counters are of both together, those of each thing stand with it.
    """

    items: list[CachedZone]
    run_catalogs: list[CachedRunCatalog]
    bytes: Count
    max_bytes: Count
    hits: Count
    misses: Count
    evictions: Count
    build_us: Count


class ZoneList(Shape):
    """Zones."""

    items: list[ZoneSummary]


class Dropped(Shape):
    """How many zones were dropped."""

    dropped: Count
