"""State of one spacecraft in a run: latest batch, alarms, recent counts, and what is wrong now."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property

from service.contract.alarms import Alarm
from service.contract.answers import Summary
from service.contract.spacecraft import (
    FaultPart,
    FaultState,
    StateFault,
    WindowCounts,
)

STALE_AFTER_S = 3600.0
"""Seconds after which a spacecraft counts as silent, or as behind the latest batch of its run."""
MARKED_SHARE = 0.15
"""Share of stars or attitudes of the last hour: by default the bound of `watch`."""
RANKS: Mapping[FaultState, int] = {
    "no_attitude": 5,
    "critical": 5,
    "silent": 4,
    "behind": 4,
    "suspect": 3,
    "warning": 2,
    "watch": 1,
}
"""Rank of each fault by severity."""


@dataclass(frozen=True)
class TrackerCounts:
    """Number of stars of a tracker in the latest batch, and number of unique ones."""

    tracker: str
    observed: int
    unique: int


@dataclass(frozen=True)
class KnownAttitude:
    """Newest attitude of a spacecraft: id of its result, time and accuracy."""

    id: str
    time: str
    status: str
    sigma_arcsec: tuple[float, float, float]
    """One standard deviation about each body axis, in arcsec."""


@dataclass(frozen=True)
class DayCounts:
    """Counts of observed and ambiguous stars in the last day of a run, and in the day before."""

    observed: int = 0
    ambiguous: int = 0
    observed_before: int = 0
    ambiguous_before: int = 0
    is_certain: bool = field(default=False, compare=False, kw_only=True)
    """True if the shares differ by more than chance, where each hour is one trial."""

    @property
    def points(self) -> float | None:
        """Rise of the ambiguous share of stars in percentage points; None if a day has no star."""
        if not self.observed or not self.observed_before:
            return None
        before = self.ambiguous_before / self.observed_before
        return 100.0 * (self.ambiguous / self.observed - before)


@dataclass(frozen=True)
class FleetRow:
    """State of one spacecraft in a run; without a batch it has no times, attitude or counts."""

    name: str
    description: str
    retired: bool
    """True if no mission file describes the spacecraft any more."""
    state: str
    """State of the latest batch alone; `faults` say what is wrong with the spacecraft."""
    alarms: tuple[Alarm, ...]
    """Alarms that are not cleared, the one with the worst present severity first."""
    latest_batch: Summary | None = None
    last_attitude: KnownAttitude | None = None
    """Newest attitude of the spacecraft, which can be older than the latest batch."""
    trackers: tuple[TrackerCounts, ...] = ()
    age_s: float | None = None
    """Seconds from the spacecraft's latest batch to the run's latest batch."""
    received_age_s: float | None = None
    """Seconds since the service received the spacecraft's latest batch."""
    last_hour: WindowCounts | None = None
    days: DayCounts = DayCounts()
    is_live: bool = True
    """True in the run of live batches, where a spacecraft can be silent."""

    @property
    def alarms_now(self) -> list[Alarm]:
        """Alarms whose quantity is out of its limits, without shelved ones."""
        return out_of_limits(self.alarms)

    @property
    def alarms_returned(self) -> list[Alarm]:
        """Alarms whose quantity is back in its limits and that wait to be acknowledged."""
        return [each for each in self.alarms if each.in_limits and each.state != "shelved"]

    @property
    def has_attitude(self) -> bool:
        """True if the latest batch has an attitude of its own."""
        return self.state in ("good", "suspect")

    @cached_property
    def faults(self) -> list[StateFault]:
        """Faults of the spacecraft in attitude, trackers, alarms and freshness, the worst first."""
        found = [*self._of_attitude(), *self._of_trackers()]
        if not self.retired:
            if self.is_live and _is_long(self.received_age_s):
                found.append(_fault("freshness", "silent", "silent", self.received_age_s))
            elif _is_long(self.age_s):
                found.append(_fault("freshness", "behind", "behind", self.age_s))
        if self.alarms_now:
            word = self.alarms_now[0].current_severity or "watch"
            found.append(_fault("alarms", word, f"{word} alarm"))
        return sorted(found, key=lambda each: RANKS[each.state], reverse=True)

    def _of_attitude(self) -> Iterator[StateFault]:
        """Faults of the latest attitude, or otherwise of the attitudes of the last hour."""
        hour = self.last_hour
        if self.state == "suspect":
            yield _fault("attitude", "suspect", "suspect")
        elif self.state == "no_attitude":
            yield _fault("attitude", "no_attitude", "no attitude")
        elif hour is not None:
            for name, count in (
                ("no attitude", hour.batches - hour.solved),
                ("suspect", hour.suspect),
            ):
                if count > MARKED_SHARE * hour.batches:
                    words = f"{name} in {count} of {hour.batches} of the last hour"
                    yield _fault("attitude", "watch", words)

    def _of_trackers(self) -> Iterator[StateFault]:
        """Trackers that identify none of their stars while others do."""
        if not self.has_attitude or len(self.trackers) < 2:
            return
        for each in self.trackers:
            if each.observed and not each.unique:
                yield _fault("tracker", "suspect", f"{each.tracker} 0 of {each.observed}")


def out_of_limits(found: Iterable[Alarm]) -> list[Alarm]:
    """Alarms whose quantity is out of its limits, without shelved ones."""
    return [each for each in found if not each.in_limits and each.state != "shelved"]


def _fault(part: FaultPart, state: FaultState, words: str, s: float | None = None) -> StateFault:
    return StateFault(part=part, state=state, words=words, age_s=s)


def _is_long(seconds: float | None) -> bool:
    return seconds is not None and seconds > STALE_AFTER_S
