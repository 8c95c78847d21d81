"""Sliding window over a quantity's values of the latest batches, evaluated against limits.

The window is ordered by batch time, whatever the order of arrival: a late batch is inserted in its
place, or left out if it is older than the window.  A preview evaluates a recorded series in the
same way.
"""

from bisect import insort
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise
from math import isclose
from typing import Any, NamedTuple

import numpy as np

from service.trends.limits import LimitSettings, RecordedSample, Sample, Severity
from service.vectors import Vector

SLACK = 1e-9
"""Rounding tolerance of sums in different order, as a share of the largest summand."""


BatchRef = tuple[str, str | None]
"""Time and id of a batch."""


class Point(NamedTuple):
    """An evaluated value, with the time and the id of its batch."""

    value: float
    time: str
    batch_id: str | None


@dataclass(frozen=True)
class Evaluated:
    """Mean value over the latest batches, with its severity; None within limits.

    `worst` is the value furthest beyond the bounds of the severity since they were left.
    """

    value: float
    severity: Severity | None
    worst: Point | None = None


@dataclass
class SampleWindow:
    """Latest samples of a quantity, and the time since when each limit is exceeded."""

    samples: list[Sample] = field(default_factory=list)
    since_ns: dict[Severity, int] = field(default_factory=dict)
    worst: dict[Severity, Point] = field(default_factory=dict)
    """Value furthest beyond the bound of each exceeded severity, since it was exceeded."""
    _known_within: LimitSettings | None = field(default=None, compare=False, repr=False)
    """Limits that every single sample of the window is known to be within; None: not known."""

    def add(
        self, sample: Sample, limits: LimitSettings, latest: BatchRef = ("", None)
    ) -> Evaluated | None:
        """Add the sample of one batch and evaluate the window; None with too few samples.

        `latest` names the batch with the latest time, the new one included.
        """
        self._known_within = None
        insort(self.samples, sample)
        del self.samples[: -limits.minimum_count]
        value = self.value(limits)
        if value is None:
            return None
        severity = self.severity_at(Point(value, *latest), self.samples[-1][0], limits)
        return Evaluated(value, severity, None if severity is None else self.worst[severity])

    def value(self, limits: LimitSettings) -> float | None:
        """Mean value over the samples of the window; None with too few samples."""
        if len(self.samples) < limits.minimum_count:
            return None
        _, parts, wholes = zip(*self.samples, strict=True)
        return float(sum(parts) / sum(wholes))

    def add_if_within(self, samples: Sequence[Sample], limits: LimitSettings) -> bool:
        """Add several samples at once, provided that none of them could change the severity.

        True: adding the samples one by one with `add` would give values within limits every time,
        as before.  False: nothing is added, and the samples must be added one by one.
        """
        if self.since_ns:
            return False
        count = limits.minimum_count
        if self._known_within is limits and _each_within(samples, limits):
            self.samples = sorted([*self.samples, *samples])[-count:]
            return True
        if len(self.samples) >= count:
            # A sample older than the whole window is not part of it.
            samples = [each for each in samples if each > self.samples[0]]
        taken = [*self.samples, *samples]
        in_order = sorted(taken)
        # The order of samples is irrelevant: a mean lies between the least and the greatest.
        each_within = _each_within(taken, limits)
        within = each_within or (
            taken == in_order and _all_within(_means(taken, count, len(self.samples)), limits)
        )
        if within:
            self.samples = in_order[-count:]
            self._known_within = limits if each_within else None
        return within

    def severity_at(self, point: Point, time_ns: int, limits: LimitSettings) -> Severity | None:
        """Highest severity whose bounds have been exceeded for at least `duration_s`."""
        worst = None
        for severity in Severity if self.since_ns else limits.severities_out(point.value):
            if not limits.out(severity, point.value, self._was_out(severity, limits)):
                self.since_ns.pop(severity, None)
                self.worst.pop(severity, None)
                continue
            since_ns = self.since_ns.setdefault(severity, time_ns)
            before = self.worst.setdefault(severity, point)
            if limits.beyond(severity, point.value) > limits.beyond(severity, before.value):
                self.worst[severity] = point
            if time_ns - since_ns >= limits.duration_s * 1e9:
                worst = severity
        return worst

    def _was_out(self, severity: Severity, limits: LimitSettings) -> bool:
        """True if a severity's bound is exceeded up to now, also the bound as it is set now."""
        if severity not in self.since_ns:
            return False
        worst = self.worst.get(severity)
        return worst is None or limits.beyond(severity, worst.value) > 0

    def to_json(self) -> Any:
        """Window of samples as JSON values, for the database."""
        kept: dict[str, Any] = {
            "samples": self.samples,
            "since_ns": {s.word: t for s, t in self.since_ns.items()},
        }
        # Most windows are within limits, and the text is written with every batch.
        if self.worst:
            kept["worst"] = {s.word: tuple(point) for s, point in self.worst.items()}
        return kept

    @classmethod
    def from_json(cls, kept: Any) -> "SampleWindow":
        """Restore a window of samples from JSON values."""
        since_ns = {Severity[word.upper()]: time_ns for word, time_ns in kept["since_ns"].items()}
        # A window of a version that kept no worst values has none: the next value is the worst.
        worst = {
            Severity[word.upper()]: Point(*each) for word, each in kept.get("worst", {}).items()
        }
        return cls([tuple(each) for each in kept["samples"]], since_ns, worst)


def largest_contribution(
    point: Point, recorded: Sequence[RecordedSample], limits: LimitSettings
) -> str | None:
    """Id of the batch that moved a mean furthest towards its bound; None if the batches of the mean
    are not known, or all of them are zero.

    `recorded` are batches up to that of the point.  Some may have arrived after its evaluation, so
    the batches known at each arrival are tried; those with the mean of the point are its window.
    """
    low, high = limits.inner_bounds
    sign = -1.0 if low - point.value > point.value - high else 1.0

    def pull(each: RecordedSample) -> tuple[float, float, RecordedSample]:
        # Of equal numbers of stars the greater share counts, of equal shares the latest.
        _, part, whole = each.sample
        return sign * part, sign * part / whole, each

    begun = [each.seq for each in recorded if each.batch_id == point.batch_id]
    for seq in sorted({each.seq for each in recorded if begun and each.seq >= begun[0]}):
        known = sorted((each for each in recorded if each.seq <= seq), reverse=True)
        window = known[: limits.minimum_count]
        mean = sum(part for (_, part, _), *_ in window) / sum(whole for (_, _, whole), *_ in window)
        if len(window) == limits.minimum_count and isclose(
            mean, point.value, rel_tol=SLACK, abs_tol=SLACK
        ):
            worst = max(window, key=pull)
            return None if sign > 0.0 and not worst.sample[1] else worst.batch_id
    return None


def _each_within(samples: Sequence[Sample], limits: LimitSettings) -> bool:
    return _all_within([part / whole for _, part, whole in samples], limits)


def _all_within(values: Sequence[float], limits: LimitSettings) -> bool:
    low, high = limits.inner_bounds
    return not values or (low <= min(values) and max(values) <= high)


def _means(samples: Sequence[Sample], count: int, known: int) -> list[float]:
    """Means over `count` samples, ending after the first `known` ones, and bounds for rounding.

    The least and the greatest mean are widened by the rounding error of differences of running
    sums.
    """
    part = list(accumulate((each[1] for each in samples), initial=0.0))
    whole = list(accumulate((each[2] for each in samples), initial=0.0))
    values = [
        (part[end] - part[end - count]) / (whole[end] - whole[end - count])
        for end in range(max(known, count), len(samples) + 1)
    ]
    if values:
        slack = SLACK * max(abs(each[1]) for each in samples)
        values += [min(values) - slack, max(values) + slack]
    return values


@dataclass
class Excursion:
    """A period in which a value would have been out of limits, counted like one alarm.

    `start_ns` is the time of the batch that would have raised the alarm, `end_ns` that of the first
    batch back in limits; None if there is none.
    """

    severity: Severity
    start_ns: int
    end_ns: int | None
    worst: float
    bound: float


@dataclass(frozen=True)
class Preview:
    """Result of evaluating a series: number of values, number beyond each severity, excursions."""

    evaluated: int = 0
    beyond: dict[Severity, int] = field(default_factory=lambda: dict.fromkeys(Severity, 0))
    excursions: list[Excursion] = field(default_factory=list)


def preview_of(samples: Sequence[Sample], limits: LimitSettings) -> Preview:
    """Evaluate a recorded series against limits, in order of time, as if its batches arrived now.

    A value is the mean over the latest `minimum_count` samples.  `beyond` counts the values beyond
    the bounds, without hysteresis or duration.
    """
    values, time_ns = _values(samples, limits.minimum_count)
    found = Preview(len(values), {s: _count_beyond(values, limits, s) for s in Severity}, [])
    latest: Excursion | None = None
    for at_ns, each in _evaluated(values, time_ns, limits):
        if each.severity is None:
            if latest is not None and latest.end_ns is None:
                latest.end_ns = at_ns
            continue
        assert each.worst is not None
        worst, bound = each.worst.value, limits.bound(each.severity, each.worst.value)
        if latest is None or latest.end_ns is not None:
            latest = Excursion(each.severity, at_ns, None, worst, bound)
            found.excursions.append(latest)
        elif each.severity >= latest.severity:
            latest.severity, latest.worst, latest.bound = each.severity, worst, bound
    return found


def preview_of_gaps(time_ns: Sequence[int], limits: LimitSettings) -> Preview:
    """Evaluate gaps between batches, in seconds, against limits of silence, each by itself."""
    alone = {"minimum_count": 1, "duration_s": 0.0, "hysteresis": 0.0}
    settings = LimitSettings.model_validate(limits.model_dump() | alone)
    gaps = [(later, (later - earlier) / 1e9, 1.0) for earlier, later in pairwise(time_ns)]
    return preview_of(gaps, settings)


def _values(samples: Sequence[Sample], count: int) -> tuple[Vector, Vector]:
    """Means over `count` consecutive samples, and the time of the last sample of each."""
    if len(samples) < count:
        return np.empty(0), np.empty(0, dtype=np.int64)
    time_ns, parts, wholes = zip(*samples, strict=True)
    sums = [np.cumsum([0.0, *each]) for each in (parts, wholes)]
    part, whole = (each[count:] - each[:-count] for each in sums)
    return part / whole, np.asarray(time_ns[count - 1 :], dtype=np.int64)


def _count_beyond(values: Vector, limits: LimitSettings, severity: Severity) -> int:
    bounds = limits.bounds(severity)
    if not limits.enabled:
        return 0
    low = -np.inf if bounds.low is None else bounds.low
    high = np.inf if bounds.high is None else bounds.high
    return int(np.count_nonzero((values < low) | (values > high)))


def _evaluated(
    values: Vector, time_ns: Vector, limits: LimitSettings
) -> Iterator[tuple[int, Evaluated]]:
    """Evaluate a series in order of time; yields its values except in stretches within limits."""
    low, high = limits.inner_bounds
    out = np.flatnonzero((values < low) | (values > high))
    window = SampleWindow()
    place = 0
    while place < len(values):
        if not window.since_ns:
            following = np.searchsorted(out, place)
            if following == len(out):
                return
            place = int(out[following])
        value, at_ns = float(values[place]), int(time_ns[place])
        severity = window.severity_at(Point(value, "", None), at_ns, limits)
        worst = None if severity is None else window.worst[severity]
        yield at_ns, Evaluated(value, severity, worst)
        place += 1
