"""A picture with the sky drawn over it: named stars, a coordinate grid, a scale, candidates."""

import io
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from service.features.pictures.blind.picture import PictureAttitude, PictureResult
from service.vectors import Vector, from_ra_dec

MOST_SIDE_PX, LEAST_SIDE_PX = 1600, 800
BLACK_SIGMAS, BEND_SIGMAS, WHITE_SIGMAS = -0.5, 3.0, 300.0
STEPS_DEG = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0)
GRID_LINES = 4.0
"""Approximate number of grid lines across the shorter side."""
_GRID, _STAR, _CANDIDATE, _TEXT = (60, 90, 130), (90, 220, 120), (150, 120, 70), (230, 230, 230)
Box = tuple[float, float, float, float]


def overlay_of(result: PictureResult, title: str) -> bytes:
    """A PNG of a picture's light, stretched by asinh, with candidates, stars, a grid and a scale.

    Without an attitude only the candidates are drawn.  Labels that would cover one another are
    left out, those of the brightest stars, which come first, last.
    """
    from PIL import Image, ImageDraw, ImageFont

    points, found = result.points, result.attitude
    greys = _greys(points.light / max(points.noise_counts, 1e-9))
    picture = Image.fromarray(greys).convert("RGB")
    scale = min(MOST_SIDE_PX / max(picture.size), 1.0)
    if max(picture.size) < LEAST_SIDE_PX:
        scale = float(-(-LEAST_SIDE_PX // max(picture.size)))
    size = (max(1, round(picture.width * scale)), max(1, round(picture.height * scale)))
    picture = picture.resize(size)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(13)
    pen = _Pen(draw, font, scale / points.binning, size)
    if found is not None:
        _draw_grid(pen, found)
    for u, v in zip(points.u_px.tolist(), points.v_px.tolist(), strict=True):
        pen.circle(u, v, 4.0, _CANDIDATE)
    if found is not None:
        for star in found.stars:
            pen.circle(star.u_px, star.v_px, 8.0, _STAR)
        for star in found.stars[:60]:
            pen.label(star.u_px, star.v_px, star.name or star.id, 9.0, _STAR)
        _draw_scale(pen, found.field_deg[0])
        (ra_deg, dec_deg), (width_deg, height_deg) = found.boresight_deg, found.field_deg
        title += (
            f"   RA {ra_deg:.3f}° Dec {dec_deg:+.3f}° roll {found.roll_deg:.2f}°   "
            f"{width_deg:.2f}° x {height_deg:.2f}°"
        )
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


def _draw_grid(pen: _Pen, found: PictureAttitude) -> None:
    """Draw circles of right ascension and declination, labelled where they leave the picture."""
    short = min(found.field_deg)
    step = _step_of(short / GRID_LINES)
    ra, dec = found.boresight_deg
    reach = 0.75 * math.hypot(*found.field_deg)
    lowest, highest = max(dec - reach, -90.0), min(dec + reach, 90.0)
    away = max(abs(lowest), abs(highest))
    around = 180.0
    if away < 89.0:
        around = min(180.0, 1.3 * reach / math.cos(math.radians(away)))
    ra_step = _step_of(step / max(math.cos(math.radians(dec)), 0.1))
    fine = np.linspace(-1.0, 1.0, 240)
    for value in _multiples(lowest, highest, step):
        line = from_ra_dec(ra + around * fine, np.full(240, value))
        _draw_line(pen, found, line, f"{value:+g}°")
    along = np.linspace(max(lowest, -88.0), min(highest, 88.0), 240)
    for value in _multiples(ra - around, ra + around, ra_step):
        line = from_ra_dec(np.full(240, value), along)
        _draw_line(pen, found, line, f"{value % 360.0:g}°")


def _draw_line(pen: _Pen, found: PictureAttitude, line: Vector, text: str) -> None:
    u, v = found.lens.places(line @ found.lens_attitude.T)
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
        # Where the line comes in, well inside.
        k = int(np.flatnonzero(inside)[min(3, int(inside.sum()) - 1)]) if inside.any() else -1
        if k >= 0:
            pen.label(float(u[k]), float(v[k]), text, 2.0, _GRID)


def _draw_scale(pen: _Pen, width_deg: float) -> None:
    """Draw a scale bar of a round angle at the lower left."""
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
