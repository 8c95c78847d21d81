"""The small trend on the page of an alarm: means over time, the bound, and when it was raised."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

WIDTH, HEIGHT = 640, 96
PAD = 4.0
ROOM = 1.1
"""The top of the picture over the greatest value, so that the bound is seen below it."""

GAP = 1.5
"""Values further apart than so many times their usual distance are not joined."""


@dataclass(frozen=True)
class AlarmTrend:
    """A path of means with gaps, and the places of the bound and of the raise."""

    path: str
    bound_y: float
    raised_x: float
    low: float
    high: float
    width: int = WIDTH
    height: int = HEIGHT


def alarm_trend(
    unix_s: Sequence[float],
    means: Sequence[float | None],
    *,
    start_s: float,
    end_s: float,
    step_s: float,
    bound: float,
    raised_s: float,
) -> AlarmTrend | None:
    """The picture of a period; None without any value."""
    points = [(at, mean) for at, mean in zip(unix_s, means, strict=True) if mean is not None]
    if not points:
        return None
    values = [0.0, bound, *(mean for _, mean in points)]
    low, high = min(values) * ROOM, max(values) * ROOM
    high = high if high > low else low + 1.0

    def x(at_s: float) -> float:
        along = (at_s - start_s) / max(end_s - start_s, step_s)
        return PAD + min(1.0, max(0.0, along)) * (WIDTH - 2 * PAD)

    def y(value: float) -> float:
        return HEIGHT - PAD - (value - low) / (high - low) * (HEIGHT - 2 * PAD)

    apart = sorted(b[0] - a[0] for a, b in pairwise(points))
    usual_s = apart[len(apart) // 2] if apart else 0.0
    path, before = "", -1e300
    for at, mean in points:
        is_gap = at - before > GAP * max(step_s, usual_s)
        # A lone value is a dot: a line without length.
        path += f"{'M' if is_gap else 'L'}{x(at + step_s / 2):.1f} {y(mean):.1f}"
        path += "h0" if is_gap else ""
        before = at
    return AlarmTrend(path, y(bound), x(raised_s), low, high)
