"""A picture with the sky drawn over it: named stars, a coordinate grid, a scale, candidates."""

import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from service.imaging.frames.frame import CountArray
from service.vectors import Matrix, Vector, from_ra_dec

MOST_SIDE_PX, LEAST_SIDE_PX = 1600, 800
BLACK_SIGMAS, BEND_SIGMAS, WHITE_SIGMAS = -0.5, 3.0, 300.0
STEPS_DEG = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0)
GRID_LINES = 4.0
"""Approximate number of grid lines across the shorter side."""
MOST_LABELS = 60
_GRID, _STAR, _CANDIDATE, _TEXT = (60, 90, 130), (90, 220, 120), (150, 120, 70), (230, 230, 230)
Box = tuple[float, float, float, float]
Places = Callable[[Vector], tuple[Vector, Vector]]
"""A function from directions (n, 3) in the camera's axes to places in pixels of the picture."""


@dataclass(frozen=True)
class DrawnStar:
    """An identified star to draw at its measured place, with its label."""

    u_px: float
    v_px: float
    label: str


@dataclass(frozen=True)
class SkyView:
    """The mapping of the sky to a picture: projection, attitude (3, 3), boresight and field."""

    places: Places
    attitude: Matrix
    boresight_deg: tuple[float, float]
    field_deg: tuple[float, float]


def draw_sky(
    light: CountArray,
    noise_counts: float,
    binning: int,
    candidates: Sequence[tuple[float, float]],
    stars: Sequence[DrawnStar],
    view: SkyView | None,
    title: str,
) -> bytes:
    """A PNG of a picture's light above the background, with asinh stretch, stars, candidates and
    grid.

    `light` is binned by `binning` pixels of the picture a side; without a view only the candidates
    are drawn. Overlapping labels are left out, with priority for the brightest stars, which come
    first.
    """
    from PIL import Image, ImageDraw, ImageFont

    picture = Image.fromarray(_greys(light / max(noise_counts, 1e-9))).convert("RGB")
    scale = min(MOST_SIDE_PX / max(picture.size), 1.0)
    if max(picture.size) < LEAST_SIDE_PX:
        scale = float(-(-LEAST_SIDE_PX // max(picture.size)))
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    picture = picture.resize(size)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    pen = _Pen(draw, font, scale / binning, size)
    if view is not None:
        _draw_grid(pen, view)
    for u, v in candidates:
        pen.circle(u, v, 4.0, _CANDIDATE)
    for star in stars:
        pen.circle(star.u_px, star.v_px, 8.0, _STAR)
    for star in stars[:MOST_LABELS]:
        pen.label(star.u_px, star.v_px, star.label, 9.0, _STAR)
    if view is not None:
        _draw_scale(pen, view)
    pen.text(6, 4, title, _TEXT)
    file = io.BytesIO()
    picture.save(file, "PNG")
    return file.getvalue()


def _greys(sigmas: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    above = np.clip(sigmas - BLACK_SIGMAS, 0.0, WHITE_SIGMAS)
    share = np.arcsinh(above / BEND_SIGMAS) / math.asinh(WHITE_SIGMAS / BEND_SIGMAS)
    return np.asarray(np.round(share * 255.0), dtype=np.uint8)


class _Pen:
    """A drawing surface in pixels of the picture that keeps labels from overlapping."""

    def __init__(self, draw: Any, font: Any, scale: float, size: tuple[int, int]) -> None:
        self.draw, self.font, self.scale, self.size = draw, font, scale, size
        self.taken: list[Box] = []

    def at(self, u_px: float, v_px: float) -> tuple[float, float]:
        """The point (x, y) on the drawing of a place in pixels of the picture."""
        return (u_px + 0.5) * self.scale, (v_px + 0.5) * self.scale

    def circle(self, u_px: float, v_px: float, radius: float, color: Any) -> None:
        """Draw a circle about a place of the picture, with a radius on the drawing."""
        x, y = self.at(u_px, v_px)
        self.draw.ellipse((x - radius, y - radius, x + radius, y + radius), outline=color)

    def text(self, x: float, y: float, text: str, color: Any) -> None:
        """Draw text on a dark background at a fixed point of the drawing."""
        box = self.draw.textbbox((x, y), text, font=self.font)
        self.taken.append(box)
        self.draw.rectangle(box, fill=(0, 0, 0))
        self.draw.text((x, y), text, fill=color, font=self.font)

    def label(self, u_px: float, v_px: float, text: str, off: float, color: Any) -> bool:
        """Draw text beside a place on the first free side; returns true if one was free."""
        x, y = self.at(u_px, v_px)
        left, top, right, bottom = self.draw.textbbox((0, 0), text, font=self.font)
        width, height = right - left, bottom - top
        for dx, dy in (
            *((off, -0.5 * height), (-off - width, -0.5 * height)),
            *((-0.5 * width, -off - height), (-0.5 * width, off)),
        ):
            box = (x + dx - 1, y + dy - 1, x + dx + width + 1, y + dy + height + 1)
            if self._is_free(box):
                self.taken.append(box)
                self.draw.text((x + dx - left, y + dy - top), text, fill=color, font=self.font)
                return True
        return False

    def _is_free(self, box: Box) -> bool:
        left, top, right, bottom = box
        if left < 0 or top < 0 or right > self.size[0] or bottom > self.size[1]:
            return False
        return all(
            right < other[0] or left > other[2] or bottom < other[1] or top > other[3]
            for other in self.taken
        )


def _draw_grid(pen: _Pen, view: SkyView) -> None:
    """Draw circles of right ascension and declination, labelled where they leave the picture."""
    short = min(view.field_deg)
    step = _step_of(short / GRID_LINES)
    ra, dec = view.boresight_deg
    reach = 0.75 * math.hypot(*view.field_deg)
    lowest, highest = max(dec - reach, -90.0), min(dec + reach, 90.0)
    away = max(abs(lowest), abs(highest))
    around = 180.0
    if away < 89.0:
        around = min(180.0, 1.3 * reach / math.cos(math.radians(away)))
    ra_step = _step_of(step / max(math.cos(math.radians(dec)), 0.1))
    fine = np.linspace(-1.0, 1.0, 240)
    for value in _multiples(lowest, highest, step):
        line = from_ra_dec(ra + around * fine, np.full(240, value))
        _draw_line(pen, view, line, f"{value:+g}°")
    along = np.linspace(max(lowest, -88.0), min(highest, 88.0), 240)
    for value in _multiples(ra - around, ra + around, ra_step):
        line = from_ra_dec(np.full(240, value), along)
        _draw_line(pen, view, line, f"{value % 360.0:g}°")


def _draw_line(pen: _Pen, view: SkyView, line: Vector, text: str) -> None:
    u, v = view.places(line @ view.attitude.T)
    seen = np.isfinite(u) & np.isfinite(v)
    x, y = (u + 0.5) * pen.scale, (v + 0.5) * pen.scale
    width, height = pen.size
    with np.errstate(invalid="ignore"):
        inside = seen & (x >= 0) & (y >= 0) & (x < width) & (y < height)
    near = inside.copy()
    near[1:] |= inside[:-1]
    near[:-1] |= inside[1:]
    points = [(float(a), float(b)) for a, b in zip(x[near & seen], y[near & seen], strict=True)]
    if len(points) > 1:
        pen.draw.line(points, fill=_GRID)
        # The label stands where the line enters the picture, well inside.
        k = int(np.flatnonzero(inside)[min(3, int(inside.sum()) - 1)]) if inside.any() else -1
        if k >= 0:
            pen.label(float(u[k]), float(v[k]), text, 2.0, _GRID)


def _draw_scale(pen: _Pen, view: SkyView) -> None:
    """Draw a scale bar of a round angle at the lower left."""
    width_deg = view.field_deg[0]
    angle = max((each for each in STEPS_DEG if each <= width_deg / 4.0), default=STEPS_DEG[0])
    length = (
        pen.size[0] * math.tan(math.radians(angle / 2.0)) / math.tan(math.radians(width_deg / 2.0))
    )
    x, y = 12, pen.size[1] - 14
    pen.draw.line((x, y, x + length, y), fill=_TEXT, width=2)
    for end in (x, x + length):
        pen.draw.line((end, y - 4, end, y + 4), fill=_TEXT, width=2)
    pen.text(x + length + 6, y - 8, f"{angle:g}°", _TEXT)


def _step_of(wanted_deg: float) -> float:
    return min(STEPS_DEG, key=lambda each: abs(math.log(each / wanted_deg)))


def _multiples(low: float, high: float, step: float) -> Iterator[float]:
    for k in range(math.ceil(low / step), math.floor(high / step) + 1):
        yield round(k * step, 6)
