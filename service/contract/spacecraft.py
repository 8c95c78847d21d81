"""Records of spacecraft: state, settings, rates, histories, gyro blocks, and the overview.

The state of the service is here too: its versions, and the cache of zones.
"""

from typing import Annotated, ClassVar, Literal

from msgspec import UNSET, UnsetType
from pydantic import Field

from service.acquire.result import TrackingState
from service.contract import answers
from service.contract.alarms import Alarm, AlarmSummary
from service.contract.answers import Summary
from service.contract.base import (
    Absent,
    Components,
    Count,
    Covariance,
    DescribedAs,
    Digest,
    Id,
    MissionSettings,
    Moment,
    Quaternion,
    Record,
    Stamp,
    Status,
    doc,
    list_record,
    page_record,
)
from service.trends.quantities import QuantityName


class AttitudeRow(Record, frozen=True, kw_only=True):
    """Entry of an attitude history; use the attitude only where `status` is good."""

    id: Id
    batch: str
    time: Moment
    quaternion: Quaternion
    frame: Annotated[str, DescribedAs(Literal["EME2000"])]
    covariance_arcsec2: Covariance
    residual_rms_arcsec: float | None
    """Rms of the attitude's residuals; null, as the next two, for an attitude that a tracker
        measured itself."""
    predicted_rms_arcsec: float | None
    taste: float | None
    method: Annotated[str, DescribedAs(Literal["quest", "triad", "measured"])]
    status: Status


AttitudePage = page_record("AttitudePage", AttitudeRow, "A page of attitudes.")


AttitudeState = Literal["good", "suspect", "no_attitude", "no_batches"]
FaultPart = Literal["attitude", "tracker", "alarms", "freshness"]
FaultState = Literal["no_attitude", "critical", "silent", "behind", "suspect", "warning", "watch"]


class StateFault(Record, frozen=True, kw_only=True):
    """Fault of a spacecraft: what is wrong with its attitude, a tracker, alarms or freshness."""

    part: FaultPart
    state: FaultState
    words: Annotated[str, doc("The fault in words, such as `critical alarm`.")]
    age_s: float | None
    """Time since a batch was received (`silent`), or behind the run (`behind`)."""


class SpacecraftRow(Record, frozen=True, kw_only=True):
    """The state of a spacecraft in a run."""

    name: str
    description: str
    retired: Annotated[bool, doc("True if no mission file describes it any more.")]
    state: AttitudeState
    """Status of the latest batch's attitude, `no_attitude`, or `no_batches`; for the state of the
        spacecraft see `faults`."""
    faults: Annotated[list[StateFault], doc("What is wrong now, the worst first; empty: nothing.")]
    latest_batch: Summary | None
    attitude: AttitudeRow | None
    """Attitude of the latest batch; null if this batch has none."""
    last_attitude: AttitudeRow | None
    """Latest attitude of the spacecraft. It can be older than the latest batch; see its time."""
    tracking: Annotated[str, DescribedAs(TrackingState)] | None
    """Tracking state of the latest batch; null if that does not ask for the last attitude."""


SpacecraftList = list_record("SpacecraftList", SpacecraftRow, "Every spacecraft.")


class MissionNow(Record, frozen=True, kw_only=True):
    """Present settings of a mission."""

    digest: Digest
    settings: MissionSettings


class MissionThen(MissionNow, frozen=True, kw_only=True):
    """Settings of a mission, with the time from which they were in use."""

    since: Stamp


class SpacecraftState(SpacecraftRow, frozen=True, kw_only=True):
    """The state of a spacecraft, and its mission's settings with their history."""

    mission: MissionNow
    history: list[MissionThen]
    """Settings of the mission, oldest first; a return to earlier settings is a new entry."""


class Rates(Record, frozen=True, kw_only=True):
    """Counts of batches and stars in an hour or a day."""

    start: Moment
    batches: Count
    observed: Count
    unique: Count
    ambiguous: Count
    unmatched: Count
    solved: Annotated[Count, doc("Batches with an attitude.")]
    suspect: Annotated[Count, doc("Batches with a suspect attitude.")]


RateList = list_record("RateList", Rates, "The buckets with batches, oldest first.")


Numbers = list[float | None]


class Series(Record, frozen=True, kw_only=True):
    """Values of a quantity over time: bucket statistics (`minmax`) or single values (`latest`)."""

    unit: Annotated[str, Field(examples=["arcsec"])]
    count: Annotated[list[Count] | UnsetType, doc("`minmax`: batches with a value.")] = UNSET
    mean: Numbers | UnsetType = UNSET
    """Mean of each bucket (`minmax`); for shares, over all stars or batches."""
    min: Annotated[Numbers | UnsetType, doc("Least value of a batch.")] = UNSET
    max: Annotated[Numbers | UnsetType, doc("Greatest value of a batch.")] = UNSET
    value: Annotated[Numbers | UnsetType, doc("`latest`: the value of each batch.")] = UNSET


class History(Record, frozen=True, kw_only=True):
    """History of quantities over a period, oldest first; null: unknown."""

    spacecraft: str
    run: str
    tracker: Annotated[str | UnsetType, doc("If the request names one.")] = UNSET
    not_split: Annotated[bool | UnsetType, Absent(False)] = UNSET
    """True while older batches of the run are not split by tracker yet, and are missing here;
        only with `tracker`."""
    start: Moment | None
    end: Moment | None
    strategy: Literal["minmax", "latest"]
    bucket_s: Annotated[int | None, doc("The width of a bucket; null for single batches.")]
    source: Literal["batch", "hour", "day"]
    """Source of the history: batches, or sums by hour or day; both ends of the period are exact."""
    thinned: Annotated[bool, doc("True if the period has more batches than the answer has points.")]
    unix_s: list[float]
    """POSIX time of the beginning of each bucket, or of each batch. Empty buckets are omitted."""
    batches: Annotated[list[Count] | UnsetType, doc("`minmax`: batches in each bucket.")] = UNSET
    time: list[Moment] | UnsetType = UNSET
    """Time of each batch; `latest` only, like the next two fields."""
    id: list[Id] | UnsetType = UNSET
    batch: list[str] | UnsetType = UNSET
    series: dict[QuantityName, Series]


class RankedBatch(Summary, frozen=True, kw_only=True):
    """Batch in a ranking, with its value of the ranked quantity."""

    component: ClassVar[str] = "WorstBatch"
    value: float


class Ranking(Record, frozen=True, kw_only=True):
    """Ranking of the worst batches of a period by a quantity."""

    component: ClassVar[str] = "WorstList"
    by: QuantityName
    tracker: Annotated[str | UnsetType, doc("If the request names one.")] = UNSET
    not_split: Annotated[bool | UnsetType, Absent(False)] = UNSET
    """True while older batches are not split by tracker; only with `tracker`."""
    items: list[RankedBatch]


class GyroBlockRow(Record, frozen=True, kw_only=True):
    """Gyro block as recorded, without its samples."""

    component: ClassVar[str] = "GyroBlock"
    client_name: ClassVar[str] = "GyroBlock"
    id: Id
    spacecraft: str
    run: str
    block: str
    start: Annotated[Moment, doc("Time of the first sample.")]
    end: Annotated[Moment, doc("Time of the last sample.")]
    samples: Annotated[int, Field(ge=1)]
    step_s: float | None
    """Interval between samples in seconds; null: the block has a time for each sample."""
    received: Stamp


GyroBlockPage = page_record("GyroBlockPage", GyroBlockRow, "A page of gyro blocks.")


class GyroSamples(GyroBlockRow, frozen=True, kw_only=True):
    """A recorded gyro block with its samples."""

    times_s: Annotated[list[float], doc("Times of the samples, in seconds of TAI after `start`.")]
    rates_rad_per_s: list[Components]
    """Angular rates of each sample as sent, about the three axes of the mission's gyro."""


Shares = list[float]


class WindowCounts(Record, frozen=True, kw_only=True):
    """Counts of batches and stars in a period that ends with the run's latest batch."""

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
    """Shares of stars by outcome in time steps; steps without batches are omitted."""

    bucket_s: int
    unix_s: Annotated[list[float], doc("POSIX time of the beginning of each step.")]
    batches: list[Count]
    unique_share: Shares
    ambiguous_share: Shares
    unmatched_share: Shares


class OverviewRow(SpacecraftRow, frozen=True, kw_only=True):
    """Overview of one spacecraft; fields are null without a batch in the run."""

    sigma_arcsec: Components | None
    """Standard deviations of `last_attitude` about the body axes."""
    age_s: Annotated[float | None, doc("Time from its latest batch to the run's latest batch.")]
    received_age_s: float | None
    """Time since the service received the spacecraft's latest batch."""
    last_hour: WindowCounts | None
    last_day: WindowCounts | None
    sparkline_hour: Sparkline | None
    sparkline_day: Sparkline | None
    alarms: Annotated[list[Alarm], doc("Alarms that are not cleared, worst first.")]


class Overview(Record, frozen=True, kw_only=True):
    """Overview of every spacecraft in a run."""

    run: str
    default_run: Annotated[str, doc("`live`; while it is empty, the newest run.")]
    as_of: Annotated[Moment | None, doc("The time of the run's latest batch.")]
    now: Annotated[Stamp, doc("The service's clock.")]
    alarms: AlarmSummary
    items: list[OverviewRow]


class CatalogAbout(Record, frozen=True, kw_only=True):
    """Star catalog of the service: digest, name and number of stars."""

    digest: Digest
    name: str
    stars: Count


class MissionAbout(Record, frozen=True, kw_only=True):
    """Mission that the service serves: name, description and digest of its settings."""

    name: str
    description: str
    digest: Digest


class About(Record, frozen=True, kw_only=True):
    """The service: its version, start, database, catalog and missions."""

    version: str
    started: Stamp
    database: Annotated[str, Field(examples=["sqlite", "postgresql"])]
    catalog: CatalogAbout
    missions: list[MissionAbout]
    credits: list[str]


class CacheUse(Record, frozen=True, kw_only=True):
    """Size, use and building time of a cache entry."""

    bytes: Count
    hits: Count
    build_us: Count


class CachedZone(CacheUse, frozen=True, kw_only=True):
    """Zone of the sky in the service's cache."""

    kind: answers.ZoneKind
    ra_deg: answers.ZoneRightAscension
    dec_deg: float
    stars: answers.ZoneStarCount
    pairs: answers.ZonePairCount
    spacecraft: str
    grid_deg: float
    run_catalog: Digest


class CachedRunCatalog(CacheUse, frozen=True, kw_only=True):
    """Entry of the service's cache with a run catalog: its digest, epoch and number of stars."""

    digest: Digest
    epoch_year: float
    stars: Count


class ZoneCache(Record, frozen=True, kw_only=True):
    """Cache of zones and run catalogs, least recently used first, with its counters.

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
    """Number of zones dropped from the cache."""

    dropped: Count
