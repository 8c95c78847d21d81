"""The cache of zones."""

from typing import ClassVar

from service.storage.models.answers import (
    ZoneKind,
    ZonePairCount,
    ZoneRightAscension,
    ZoneStarCount,
    ZoneSummary,
)
from service.storage.models.base import Count, Digest, Record


class CacheUse(Record, frozen=True, kw_only=True):
    """Cost and use of a cache entry."""

    component: ClassVar[str] = "CacheUse"
    bytes: Count
    hits: Count
    build_us: Count


class CachedZone(CacheUse, frozen=True, kw_only=True):
    """A zone in the cache."""

    component: ClassVar[str] = "CachedZone"
    kind: ZoneKind
    ra_deg: ZoneRightAscension
    dec_deg: float
    stars: ZoneStarCount
    pairs: ZonePairCount
    spacecraft: str
    grid_deg: float
    run_catalog: Digest


class CachedRunCatalog(CacheUse, frozen=True, kw_only=True):
    """A run catalog in the cache."""

    component: ClassVar[str] = "CachedRunCatalog"
    digest: Digest
    epoch_year: float
    stars: Count


class ZoneCache(Record, frozen=True, kw_only=True):
    """The content of the cache, least recently used first, and its counters.

    A batch looks up its run catalog, and the zone of each tracker. The counters here cover
    both; each entry has its own.
    """

    component: ClassVar[str] = "ZoneCache"
    items: list[CachedZone]
    run_catalogs: list[CachedRunCatalog]
    bytes: Count
    max_bytes: Count
    hits: Count
    misses: Count
    evictions: Count
    build_us: Count


class ZoneList(Record, frozen=True, kw_only=True):
    """Zones."""

    component: ClassVar[str] = "ZoneList"
    items: list[ZoneSummary]


class Dropped(Record, frozen=True, kw_only=True):
    """How many zones were dropped."""

    component: ClassVar[str] = "Dropped"
    dropped: Count
