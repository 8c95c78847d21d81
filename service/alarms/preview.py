"""A preview of limits: how a series of recorded values would have been evaluated against them."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np

from service.alarms.limits import LimitSettings, Severity
from service.alarms.window import Evaluated, Point, Sample, SampleWindow
from service.vectors import Vector


@dataclass
class Excursion:
    """A time for which a value would have been out of its limits, as an alarm counts it.

    `start_ns` is the batch that would have raised the alarm, `end_ns` the first one that was
    back in limits; None: it lasts to the end of the series.
    """

    severity: Severity
    start_ns: int
    end_ns: int | None
    worst: float
    bound: float


@dataclass(frozen=True)
class Preview:
    """How many values were evaluated, how many lay beyond each severity, and every excursion."""

    evaluated: int = 0
    beyond: dict[Severity, int] = field(default_factory=lambda: dict.fromkeys(Severity, 0))
    excursions: list[Excursion] = field(default_factory=list)


def preview_of(samples: Sequence[Sample], limits: LimitSettings) -> Preview:
    """Evaluate samples in the order of their time, as batches that arrive in order would be.

    A value is the mean over the latest `minimum_count` samples.  `beyond` counts the
    values beyond the bounds, without hysteresis or duration.
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
    """The same for the time without a batch, in seconds: each gap is evaluated by itself."""
    alone = {"minimum_count": 1, "duration_s": 0.0, "hysteresis": 0.0}
    settings = LimitSettings.model_validate(limits.model_dump() | alone)
    gaps = [(later, (later - earlier) / 1e9, 1.0) for earlier, later in pairwise(time_ns)]
    return preview_of(gaps, settings)


def _values(samples: Sequence[Sample], count: int) -> tuple[Vector, Vector]:
    """The mean over the latest `count` samples at each of them, and its time."""
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
    """The values that could change a severity, with their times; the others are within limits."""
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
