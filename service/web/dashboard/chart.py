"""The geometry of a chart of star rates: stacked bars over time, in percent of its plot.

Bars, because a bucket without batches is a gap and no zero.  Lengths are
percentages, so that the browser stretches the bars and not the lettering.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from service.times import DAY_S, HOUR_S, Utc, bucket_start, parse_utc

BUCKETS = {"hour": (HOUR_S, 96), "day": (DAY_S, 92)}
"""Width of a bucket in seconds, and how many of them a chart shows at most."""
FEWEST_BUCKETS = 6
X_TICKS = 4


@dataclass(frozen=True)
class Bar:
    """One bucket: where it stands, how high its two parts are, and its figures."""

    x: float
    width: float
    ambiguous: float
    unmatched: float
    label: str
    figures: Mapping[str, Any]

    @property
    def top(self) -> float:
        """The height of both parts."""
        return self.ambiguous + self.unmatched


@dataclass(frozen=True)
class Tick:
    """A mark on an axis, in percent along it."""

    at: float
    label: str
    anchor: str = "middle"


@dataclass(frozen=True)
class Chart:
    """Shares of ambiguous and unmatched stars over time; `full_pct` is the top of the y axis."""

    bars: tuple[Bar, ...]
    x_ticks: tuple[Tick, ...]
    y_ticks: tuple[Tick, ...]
    full_pct: float
    bucket: str


def with_day_of_year(moment: Utc, seconds: bool = True) -> str:
    """UTC for reading: date, day of the year, time of day."""
    day, _, clock = moment.text.partition("T")
    return f"{day} ({moment.day_of_year:03d}) {clock[: 8 if seconds else 5]}"


def first_bucket(latest: Utc, bucket: str) -> Utc:
    """The start of the earliest bucket of a chart that ends with `latest`."""
    width_s, most = BUCKETS[bucket]
    return bucket_start(latest.bucket(width_s) - most + 1, width_s)


def chart_of(rates: Sequence[Mapping[str, Any]], latest: Utc, bucket: str) -> Chart:
    """The chart of rates in buckets, the newest of which holds `latest`."""
    width_s, most = BUCKETS[bucket]
    last = latest.bucket(width_s)
    numbered = [(parse_utc(each["start"]).bucket(width_s), each) for each in rates]
    numbered = [(number, each) for number, each in numbered if last - most < number <= last]
    shown = max(FEWEST_BUCKETS, last - min((n for n, _ in numbered), default=last) + 1)
    first = last - shown + 1
    full_pct = _full_pct([_share(each, "ambiguous", "unmatched") for _, each in numbered])
    bars = tuple(
        Bar(
            x=100 * (number - first) / shown,
            width=100 / shown,
            ambiguous=100 * _share(each, "ambiguous") / full_pct,
            unmatched=100 * _share(each, "unmatched") / full_pct,
            label=with_day_of_year(bucket_start(number, width_s), seconds=False),
            figures=each,
        )
        for number, each in numbered
    )
    return Chart(bars, _x_ticks(first, shown, width_s), _y_ticks(full_pct), full_pct, bucket)


def _share(rates: Mapping[str, Any], *outcomes: str) -> float:
    """Percent of all observed stars; without any star there is no share to show."""
    observed = rates["observed"]
    return 100 * sum(rates[outcome] for outcome in outcomes) / observed if observed else 0.0


def _full_pct(shares: Sequence[float]) -> float:
    """A round top of the y axis, 1 % at least: a handful of stars shall not look like a lot."""
    highest = max(shares, default=0.0)
    for full in (1.0, 2.0, 4.0, 10.0, 20.0, 40.0, 60.0, 80.0):
        if highest <= full:
            return full
    return 100.0


def _x_ticks(first: int, shown: int, width_s: int) -> tuple[Tick, ...]:
    step = math.ceil(shown / X_TICKS)
    ticks = []
    for index in range(0, shown, step):
        start = bucket_start(first + index, width_s)
        text = with_day_of_year(start, seconds=False)
        label = text[5:] if width_s == HOUR_S else text[:16]
        ticks.append(Tick(100 * index / shown, label, "start"))
    return tuple(ticks)


def _y_ticks(full_pct: float) -> tuple[Tick, ...]:
    return tuple(Tick(100 * part, f"{full_pct * part:g} %") for part in (0.0, 0.5, 1.0))
