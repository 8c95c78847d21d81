"""SVG chart of attitude errors over time."""

from xml.sax.saxutils import escape

import numpy as np

from service.features.products.scoring import AXES, Errors, histogram
from service.vectors import Vector

WIDTH, ROW, HEAD, FOOT = 960, 190, 44, 30
TIME_LEFT, TIME_RIGHT, BARS_LEFT, BARS_RIGHT = 76, 640, 690, 940
TOP, BOTTOM = 26, 166
"""Top and bottom of the drawing area within a row of the chart."""
MOST_POINTS = 3_000
"""Greatest number of points along an axis: a longer series is thinned evenly."""
POINT, SIGMA, BAR = "#1f5f99", "#b3541e", "#7ba7cf"


def errors_picture(errors: Errors, title: str) -> str:
    """Draw attitude errors as SVG; needs at least one attitude."""
    counts = histogram(errors)
    limit = counts["edges_arcsec"][-1]
    height = HEAD + ROW * len(AXES) + FOOT
    parts = [
        (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
            'font-family="sans-serif" font-size="13" fill="#222" role="img">'
        ),
        f"<title>Errors of {escape(title)}</title>",
        f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>',
        (
            f'<text x="12" y="26" font-size="15">Errors of {len(errors.time_ns):,} attitudes: '
            f"{escape(title)}</text>"
        ),
    ]
    for number, axis in enumerate(AXES):
        parts.append(f'<g transform="translate(0 {HEAD + number * ROW})">')
        parts += _over_time(errors, number, axis, limit)
        parts += _bars(counts[axis], limit)
        parts.append("</g>")
    y = HEAD + ROW * len(AXES) + 16
    parts.append(
        f'<text x="{TIME_LEFT}" y="{y}">time: {_hours(errors):.3g} h; '
        f'<tspan fill="{SIGMA}">lines: three predicted standard deviations</tspan>; errors '
        "beyond the scale stand at its ends</text>"
    )
    return "\n".join([*parts, "</svg>", ""])


def _hours(errors: Errors) -> float:
    return float(errors.time_ns.max() - errors.time_ns.min()) / 3.6e12


def _over_time(errors: Errors, number: int, axis: str, limit: float) -> list[str]:
    step = -(-len(errors.time_ns) // MOST_POINTS)
    time_ns = errors.time_ns[::step]
    span = max(1, int(time_ns.max() - time_ns.min()))
    x = TIME_LEFT + (TIME_RIGHT - TIME_LEFT) * (time_ns - time_ns.min()) / span
    y = _height(errors.error_arcsec[::step, number], limit)
    three = 3.0 * np.sqrt(errors.variance_arcsec2[::step, number])
    parts = [
        f'<text x="{TIME_LEFT}" y="16">about {axis}, arcsec</text>',
        *_scale(limit, TIME_LEFT, TIME_RIGHT),
    ]
    for sign in (-1.0, 1.0):
        points = _points(x, _height(sign * three, limit))
        parts.append(f'<polyline points="{points}" fill="none" stroke="{SIGMA}" opacity=".6"/>')
    parts += [
        f'<circle cx="{px:.1f}" cy="{py:.1f}" r="1.3" fill="{POINT}"/>'
        for px, py in zip(x.tolist(), y.tolist(), strict=True)
    ]
    return parts


def _scale(limit: float, left: int, right: int) -> list[str]:
    parts = []
    for share in (-1.0, 0.0, 1.0):
        y = float(_height(np.array([share * limit]), limit)[0])
        parts.append(f'<line x1="{left}" x2="{right}" y1="{y}" y2="{y}" stroke="#ccc"/>')
        parts.append(
            f'<text x="{left - 6}" y="{y + 4}" text-anchor="end">{share * limit:.3g}</text>'
        )
    return parts


def _bars(counts: list[int], limit: float) -> list[str]:
    most = max(1, *counts)
    width = (BARS_RIGHT - BARS_LEFT) / len(counts)
    parts = [
        f'<rect x="{BARS_LEFT + k * width:.2f}" width="{width - 0.6:.2f}" fill="{BAR}" '
        f'y="{BOTTOM - (BOTTOM - TOP) * count / most:.1f}" '
        f'height="{(BOTTOM - TOP) * count / most:.1f}"/>'
        for k, count in enumerate(counts)
    ]
    for share, anchor in ((-1.0, "start"), (0.0, "middle"), (1.0, "end")):
        x = BARS_LEFT + (BARS_RIGHT - BARS_LEFT) * (share + 1.0) / 2.0
        parts.append(
            f'<text x="{x}" y="{BOTTOM + 16}" text-anchor="{anchor}">{share * limit:.3g}</text>'
        )
    return parts


def _height(values: Vector, limit: float) -> Vector:
    middle, half = (TOP + BOTTOM) / 2.0, (BOTTOM - TOP) / 2.0
    return np.asarray(middle - half * np.clip(values / limit, -1.0, 1.0))


def _points(x: Vector, y: Vector) -> str:
    return " ".join(f"{px:.1f},{py:.1f}" for px, py in zip(x.tolist(), y.tolist(), strict=True))
