"""A fleet at one glance: a row for each spacecraft, and counts in cells of time."""

from collections.abc import Mapping
from dataclasses import dataclass

from service.storage.models.alarms import Alarm, AlarmSummary
from service.storage.models.answers import Summary
from service.storage.models.overview import WindowCounts
from service.times import Utc
from service.vectors import Matrix


@dataclass(frozen=True)
class TrackerCounts:
    """One tracker's stars of the latest batch, and how many of them are unique."""

    tracker: str
    observed: int
    unique: int


@dataclass(frozen=True)
class KnownAttitude:
    """The newest attitude of a spacecraft: of which result, at what time, how good."""

    id: str
    time: str
    status: str
    sigma_arcsec: tuple[float, float, float]
    """One standard deviation about each body axis."""


@dataclass(frozen=True)
class FleetRow:
    """The state of one spacecraft in a run; None without a batch."""

    name: str
    description: str
    retired: bool
    """Whether no mission file describes it any more."""
    state: str
    """`good`, `suspect`, `no_attitude` or `no_batches`: that of the latest batch."""
    latest_batch: Summary | None
    last_attitude: KnownAttitude | None
    """It can be older than the latest batch."""
    trackers: tuple[TrackerCounts, ...]
    age_s: float | None
    """From its latest batch to the run's latest batch."""
    received_age_s: float | None
    """Since the service received its latest batch."""
    last_hour: WindowCounts | None
    alarms: tuple[Alarm, ...]
    """Those that are not cleared, worst first."""

    @property
    def alarms_now(self) -> list[Alarm]:
        """Alarms whose quantity is out of its limits, without shelved ones."""
        return [each for each in self.alarms if not each.in_limits and each.state != "shelved"]

    @property
    def alarms_returned(self) -> list[Alarm]:
        """Alarms whose quantity is back in its limits and that wait to be acknowledged."""
        return [each for each in self.alarms if each.in_limits and each.state != "shelved"]

    @property
    def has_attitude(self) -> bool:
        """Whether the latest batch has an attitude of its own."""
        return self.state in ("good", "suspect")


@dataclass(frozen=True)
class FleetCells:
    """Counts in cells of equal width in time: a row for each spacecraft, a column for each cell."""

    start_s: float
    """POSIX time at which the first cell begins."""
    width_s: int
    counts: Mapping[str, Matrix]
    """Of a rollup's counts, such as `observed`; 0 where there was no batch."""

    @property
    def columns(self) -> int:
        """How many cells there are in time."""
        return int(self.counts["batches"].shape[1])


@dataclass(frozen=True)
class Fleet:
    """Every spacecraft in a run; the rows of `cells` are those of `rows`."""

    run: str
    as_of: Utc | None
    """The time of the run's latest batch."""
    alarms: AlarmSummary
    rows: tuple[FleetRow, ...]
    cells: FleetCells | None
