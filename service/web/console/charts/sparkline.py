"""The geometry of a sparkline: shares over a stretch of time; a gap where nothing was."""

from collections.abc import Sequence
from dataclasses import dataclass

from service.storage.models.overview import Sparkline as Shares

WIDTH, HEIGHT = 132, 30
PAD = 2.0


@dataclass(frozen=True)
class SparklineDrawing:
    """Two lines and the share that the top stands for; lone points are dots."""

    ambiguous: str
    unmatched: str
    dots: tuple[tuple[str, float, float], ...]
    top: float
    width: int = WIDTH
    height: int = HEIGHT


def sparkline(series: Shares, start_s: float, end_s: float) -> SparklineDrawing:
    """The picture of `sparkline_hour` or `sparkline_day` of an overview, from start to end."""
    moments: Sequence[float] = series.unix_s
    shares: dict[str, list[float]] = {
        "ambiguous": series.ambiguous_share,
        "unmatched": series.unmatched_share,
    }
    # A handful of stars shall not look like a lot: the top is a twentieth at least.
    top: float = max(0.05, *(max(each, default=0.0) for each in shares.values()))
    step_s = float(series.bucket_s)
    span_s = max(end_s - start_s, step_s)

    def x(moment_s: float) -> float:
        along = (moment_s + step_s / 2 - start_s) / span_s
        return PAD + min(1.0, max(0.0, along)) * (WIDTH - 2 * PAD)

    def y(part: float) -> float:
        return HEIGHT - PAD - part / top * (HEIGHT - 2 * PAD)

    paths, dots = {}, []
    for name, values in shares.items():
        parts: list[list[tuple[float, float]]] = []
        for k, (moment_s, value) in enumerate(zip(moments, values, strict=True)):
            if k == 0 or moment_s - moments[k - 1] > 1.5 * step_s:
                parts.append([])
            parts[-1].append((x(moment_s), y(value)))
        paths[name] = "".join(
            "M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in part) for part in parts if len(part) > 1
        )
        dots += [(name, *part[0]) for part in parts if len(part) == 1]
    return SparklineDrawing(paths["ambiguous"], paths["unmatched"], tuple(dots), top)
