"""The latest values of one quantity, judged together: out of limits, for how long, how badly.

The latest are those of the latest batch times, whatever the order they came in:
a batch that comes late takes its place among them, or none if it is older.
"""

from bisect import insort
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any, NamedTuple

from service.alarms.limits import LimitSettings, Severity

Sample = tuple[int, float, float]
"""(time_ns, part, whole): a share of counts, or a value over one."""

SLACK = 1e-9
"""Of the largest part: far more than sums in another order differ by."""


Moment = tuple[str, str | None]
"""The time and the id of a batch."""


class Point(NamedTuple):
    """A judged value, with the time and the batch that it is of."""

    value: float
    time: str
    batch_id: str | None


@dataclass(frozen=True)
class Judged:
    """What the latest values amount to: the value, and how bad it is, None: in limits.

    `worst` is the value furthest beyond the bounds of that severity since it is out of them.
    """

    value: float
    severity: Severity | None
    worst: Point | None = None


@dataclass
class Window:
    """The latest values of a quantity, and since when they are out of which limit."""

    samples: list[Sample] = field(default_factory=list)
    since_ns: dict[Severity, int] = field(default_factory=dict)
    worst: dict[Severity, Point] = field(default_factory=dict)
    """The value furthest beyond each limit that they are out of, since then."""
    _calm: LimitSettings | None = field(default=None, compare=False, repr=False)
    """The limits that each of the samples is known to be in by itself."""

    def add(
        self, sample: Sample, limits: LimitSettings, moment: Moment = ("", None)
    ) -> Judged | None:
        """Take one batch's part and judge the latest; None while there are too few of them.

        `moment` is that of the batch of the latest time, this one included.
        """
        self._calm = None
        insort(self.samples, sample)
        del self.samples[: -limits.minimum_count]
        value = self.value(limits)
        if value is None:
            return None
        severity = self.judge(Point(value, *moment), self.samples[-1][0], limits)
        return Judged(value, severity, None if severity is None else self.worst[severity])

    def value(self, limits: LimitSettings) -> float | None:
        """What the latest amount to; None while there are too few of them."""
        if len(self.samples) < limits.minimum_count:
            return None
        _, parts, wholes = zip(*self.samples, strict=True)
        return float(sum(parts) / sum(wholes))

    def pass_over(self, samples: Sequence[Sample], limits: LimitSettings) -> bool:
        """Take many batches' parts at once, if none of them could change how bad it is.

        True: what `add` makes of them one after the other is in limits each time,
        and was before.  False: nothing is taken, and they must be added one by one.
        """
        if self.since_ns:
            return False
        count = limits.minimum_count
        if self._calm is limits and _each_within(samples, limits):
            self.samples = sorted([*self.samples, *samples])[-count:]
            return True
        if len(self.samples) >= count:
            # What is older than all that is judged takes no place.
            samples = [each for each in samples if each > self.samples[0]]
        taken = [*self.samples, *samples]
        in_order = sorted(taken)
        # In whatever order they come, a mean lies between the least and the greatest.
        each_within = _each_within(taken, limits)
        calm = each_within or (
            taken == in_order
            and _all_within(_judged_values(taken, count, len(self.samples)), limits)
        )
        if calm:
            self.samples = in_order[-count:]
            self._calm = limits if each_within else None
        return calm

    def judge(self, point: Point, time_ns: int, limits: LimitSettings) -> Severity | None:
        """The worst severity whose bound the value has been out of for long enough."""
        worst = None
        for severity in Severity if self.since_ns else limits.passed(point.value):
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
        """Whether the values are out of a bound so far: of a wider one only if they passed it."""
        if severity not in self.since_ns:
            return False
        worst = self.worst.get(severity)
        return worst is None or limits.beyond(severity, worst.value) > 0

    def to_json(self) -> Any:
        """The window as plain values."""
        kept: dict[str, Any] = {
            "samples": self.samples,
            "since_ns": {s.word: t for s, t in self.since_ns.items()},
        }
        # Most are in limits, and the text is written with every batch.
        if self.worst:
            kept["worst"] = {s.word: tuple(point) for s, point in self.worst.items()}
        return kept

    @classmethod
    def from_json(cls, kept: Any) -> "Window":
        """A window as it was kept."""
        since_ns = {Severity[word.upper()]: time_ns for word, time_ns in kept["since_ns"].items()}
        # What was written before worst values were kept has none: the next value takes their place.
        worst = {
            Severity[word.upper()]: Point(*each) for word, each in kept.get("worst", {}).items()
        }
        return cls([tuple(each) for each in kept["samples"]], since_ns, worst)


def _each_within(samples: Sequence[Sample], limits: LimitSettings) -> bool:
    return _all_within([part / whole for _, part, whole in samples], limits)


def _all_within(values: Sequence[float], limits: LimitSettings) -> bool:
    low, high = limits.calm
    return not values or (low <= min(values) and max(values) <= high)


def _judged_values(samples: Sequence[Sample], count: int, known: int) -> list[float]:
    """The means over the latest `count`, after each sample beyond the `known` ones and before.

    The least and the greatest are widened: as differences of sums from the start
    they may differ in the last digits from sums of their own.
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
