"""The state of the service: spacecraft at a glance, a fleet, versions, and the cache of zones."""

from typing import Annotated, ClassVar

from pydantic import Field

from service.storage.models import answers
from service.storage.models.alarms import Alarm, AlarmSummary
from service.storage.models.base import (
    Components,
    Count,
    Digest,
    Moment,
    Record,
    Stamp,
    doc,
    list_record,
)
from service.storage.models.spacecraft import SpacecraftRow

Shares = list[float]


class WindowCounts(Record, frozen=True, kw_only=True):
    """Counts in a period that ends with the run's latest batch."""

    component: ClassVar[str] = "WindowOut"
    start: Moment
    end: Moment
    batches: Count
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count
    solved: Annotated[Count, doc("Batches with an attitude.")]
    suspect: Count


class Sparkline(Record, frozen=True, kw_only=True):
    """Shares of stars in time steps; steps without batches are omitted."""

    bucket_s: int
    unix_s: Annotated[list[float], doc("POSIX time of the beginning of each step.")]
    batches: list[Count]
    unique_share: Shares
    ambiguous_share: Shares
    unmatched_share: Shares


class OverviewRow(SpacecraftRow, frozen=True, kw_only=True):
    """The state of one spacecraft; null without a batch in the run."""

    sigma_arcsec: Components | None
    """Standard deviations of `last_attitude` about the body axes."""
    age_s: Annotated[float | None, doc("Time from its latest batch to the run's latest batch.")]
    received_age_s: float | None
    """Time since the service received its latest batch."""
    last_hour: WindowCounts | None
    last_day: WindowCounts | None
    sparkline_hour: Sparkline | None
    sparkline_day: Sparkline | None
    alarms: Annotated[list[Alarm], doc("Alarms that are not cleared, worst first.")]


class Overview(Record, frozen=True, kw_only=True):
    """Every spacecraft in a run."""

    run: str
    default_run: Annotated[str, doc("`live`; while it is empty, the newest run.")]
    as_of: Annotated[Moment | None, doc("The time of the run's latest batch.")]
    now: Annotated[Stamp, doc("The service's clock.")]
    alarms: AlarmSummary
    items: list[OverviewRow]


class CatalogAbout(Record, frozen=True, kw_only=True):
    """The star catalog."""

    digest: Digest
    name: str
    stars: Count


class MissionAbout(Record, frozen=True, kw_only=True):
    """A mission of this service."""

    name: str
    description: str
    digest: Digest


class About(Record, frozen=True, kw_only=True):
    """The service and its data."""

    version: str
    started: Stamp
    database: Annotated[str, Field(examples=["sqlite", "postgresql"])]
    catalog: CatalogAbout
    missions: list[MissionAbout]
    credits: list[str]


class CacheUse(Record, frozen=True, kw_only=True):
    """Cost and use of a cache entry."""

    bytes: Count
    hits: Count
    build_us: Count


class CachedZone(CacheUse, frozen=True, kw_only=True):
    """A zone in the cache."""

    kind: answers.ZoneKind
    ra_deg: answers.ZoneRightAscension
    dec_deg: float
    stars: answers.ZoneStarCount
    pairs: answers.ZonePairCount
    spacecraft: str
    grid_deg: float
    run_catalog: Digest


class CachedRunCatalog(CacheUse, frozen=True, kw_only=True):
    """A run catalog in the cache."""

    digest: Digest
    epoch_year: float
    stars: Count


class ZoneCache(Record, frozen=True, kw_only=True):
    """The content of the cache, least recently used first, and its counters.

    A batch looks up its run catalog, and the zone of each tracker. The counters here cover
    both; each entry has its own.
    """

    items: list[CachedZone]
    run_catalogs: list[CachedRunCatalog]
    bytes: Count
    max_bytes: Count
    hits: Count
    misses: Count
    evictions: Count
    build_us: Count


ZoneList = list_record("ZoneList", answers.ZoneSummary, "Zones.")


class Dropped(Record, frozen=True, kw_only=True):
    """How many zones were dropped."""

    dropped: Count
