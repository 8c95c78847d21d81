"""Drawings of results on frames: stars with names and residual arrows; and maps of residuals."""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from service.missions.camera import Camera
from service.missions.mission import Tracker
from service.observations.batch import ObservationBatch
from service.sky.catalog.run_catalog import RunCatalog
from service.sky.ephemeris import apparent, observer_velocity
from service.vectors import Vector, matrix_from_quaternion

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw


LEAST_SIDE_PX = 768
ARROW_PX = 28.0
"""Length in pixels of the arrow of the median residual; all arrows have the same scale factor."""
MOST_ENLARGED = 5000.0
RADIUS_PX, SMALL_RADIUS_PX = 9, 5
LINE_PX = 18
FOOT_PX = 3 * LINE_PX + 8

Color = tuple[int, int, int]
COLORS: Mapping[str, Color] = {
    "unique": (90, 220, 120),
    "ambiguous": (240, 200, 60),
    "unmatched": (255, 90, 90),
    "left_out": (120, 150, 190),
    "sharp": (200, 110, 220),
}
_ARROW: Color = (110, 200, 255)
_TEXT: Color = (225, 225, 225)
_WORDS = {"left_out": "not in the batch", "sharp": "hot pixel or cosmic ray"}


@dataclass(frozen=True)
class Mark:
    """A mark on a frame, in pixels: a star with its outcome, or a hot pixel or cosmic ray.

    `kind` is the star's outcome, `left_out` for a star in no batch, or `sharp` for a hot pixel or
    cosmic ray. `predicted_px` is the star's place by catalog and attitude, None if either is
    missing.
    """

    u_px: float
    v_px: float
    kind: str
    label: str = ""
    predicted_px: tuple[float, float] | None = None


def marks_of(
    answer: Any,
    batch: ObservationBatch,
    tracker: Tracker,
    camera: Camera,
    detections: Mapping[str, Any],
    run_catalog: RunCatalog | None,
) -> list[Mark]:
    """The marks for a recorded `Answer`: stars, names, and predicted places if available."""
    found = [star for star in detections["stars"] if star["u_px"] is not None]
    used = [star for star in found if star["used"]]
    answered = next(each.stars for each in answer.observations if each.tracker == tracker.name)
    names = [None if each.star is None else str(each.star.id) for each in answered]
    predicted = _predicted(names, answer, batch, tracker, camera, run_catalog)
    marks = [
        Mark(
            star["u_px"],
            star["v_px"],
            each.outcome,
            name or "",
            place if each.outcome == "unique" else None,
        )
        for star, each, name, place in zip(used, answered, names, predicted, strict=True)
    ]
    marks += [Mark(star["u_px"], star["v_px"], "left_out") for star in found if not star["used"]]
    return marks + [Mark(u, v, "sharp") for u, v in detections["hot_or_cosmic_px"]]


def _predicted(
    names: Sequence[str | None],
    answer: Any,
    batch: ObservationBatch,
    tracker: Tracker,
    camera: Camera,
    run_catalog: RunCatalog | None,
) -> list[tuple[float, float] | None]:
    attitude = answer.attitude
    # Without a calibration the lens model fitted to the frame is not recorded.
    if attitude is None or run_catalog is None or not camera.calibrated:
        return [None] * len(names)
    wanted = set(names)
    rows = {name: row for row, name in enumerate(run_catalog.star_id) if name in wanted}
    row = np.array([-1 if name is None else rows.get(name, -1) for name in names])
    direction = run_catalog.direction_at(batch.time)[row]
    if batch.aberration == "to_correct":
        velocity_c = observer_velocity(batch.time, batch.velocity_km_per_s)
        direction = apparent(direction, velocity_c, batch.time)
    body = direction @ matrix_from_quaternion(attitude.quaternion).T
    u, v = camera.places(body @ tracker.body_from_tracker)
    return [
        (at_u, at_v) if known >= 0 and np.isfinite(at_u) else None
        for known, at_u, at_v in zip(row.tolist(), u.tolist(), v.tolist(), strict=True)
    ]


def draw_overlay(preview: bytes, step: int, marks: Sequence[Mark], title: str) -> bytes:
    """A PNG of a frame's preview with marks; one of its pixels is `step` pixels of the frame."""
    from PIL import Image, ImageDraw, ImageFont

    with Image.open(io.BytesIO(preview), formats=("PNG",)) as stored:
        picture = stored.convert("RGB")
    enlarged = max(1, -(-LEAST_SIDE_PX // max(picture.size)))
    picture = picture.resize((picture.width * enlarged, picture.height * enlarged), 0)
    canvas = Image.new("RGB", (picture.width, picture.height + FOOT_PX))
    canvas.paste(picture)
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(12)
    scale = enlarged / step
    factor = _arrow_factor(marks)
    # Stars of the batch are drawn last, so that nothing hides them.
    for mark in sorted(marks, key=lambda each: each.kind not in _WORDS):
        _draw_mark(draw, mark, scale, factor, font, canvas.width)
    _draw_foot(draw, marks, title, factor, font, picture.height)
    file = io.BytesIO()
    canvas.save(file, "PNG")
    return file.getvalue()


def _draw_mark(
    draw: "ImageDraw", mark: Mark, scale: float, factor: float, font: object, width: int
) -> None:
    # The centre of the first pixel is (0, 0) on the frame and (0.5, 0.5) in the picture.
    x, y = (mark.u_px + 0.5) * scale, (mark.v_px + 0.5) * scale
    color = COLORS[mark.kind]
    if mark.kind == "sharp":
        r = SMALL_RADIUS_PX - 2
        draw.line((x - r, y - r, x + r, y + r), color)
        draw.line((x - r, y + r, x + r, y - r), color)
        return
    r = SMALL_RADIUS_PX if mark.kind == "left_out" else RADIUS_PX
    box = (x - r, y - r, x + r, y + r)
    if mark.kind == "unmatched":
        draw.rectangle(box, outline=color, width=2)
    else:
        draw.ellipse(box, outline=color, width=1 if mark.kind == "left_out" else 2)
    if mark.predicted_px is not None:
        # Observed minus predicted, as the star field of the console shows it.
        du, dv = mark.u_px - mark.predicted_px[0], mark.v_px - mark.predicted_px[1]
        _draw_arrow(draw, x, y, du * factor, dv * factor)
    if mark.label or mark.kind == "unmatched":
        text = mark.label or "?"
        length = draw.textlength(text, font=font)  # type: ignore[arg-type]
        left = x + r + 3 if x + r + 3 + length < width else x - r - 3 - length
        draw.text((left, y - r - 6), text, color, font=font)  # type: ignore[arg-type]


def _draw_arrow(draw: "ImageDraw", x: float, y: float, along_x: float, along_y: float) -> None:
    end_x, end_y = x + along_x, y + along_y
    draw.line((x, y, end_x, end_y), _ARROW, 2)
    angle = math.atan2(along_y, along_x)
    for turn in (2.6, -2.6):
        tip = (end_x + 6 * math.cos(angle + turn), end_y + 6 * math.sin(angle + turn))
        draw.line((end_x, end_y, *tip), _ARROW, 2)


def _arrow_factor(marks: Sequence[Mark]) -> float:
    """The scale factor of residual arrows, rounded to one digit; 0 without a predicted place."""
    lengths = [
        math.hypot(mark.predicted_px[0] - mark.u_px, mark.predicted_px[1] - mark.v_px)
        for mark in marks
        if mark.predicted_px is not None
    ]
    if not lengths:
        return 0.0
    factor = min(ARROW_PX / max(float(np.median(lengths)), 1e-9), MOST_ENLARGED)
    digit = 10.0 ** math.floor(math.log10(factor))
    return max(1.0, round(factor / digit) * digit)


def _draw_foot(
    draw: "ImageDraw", marks: Sequence[Mark], title: str, factor: float, font: object, top: int
) -> None:
    draw.text((6, top + 4), title, _TEXT, font=font)  # type: ignore[arg-type]
    x = 6.0
    for kind, color in COLORS.items():
        text = f"{sum(mark.kind == kind for mark in marks)} {_WORDS.get(kind, kind)}"
        draw.text((x, top + 4 + LINE_PX), text, color, font=font)  # type: ignore[arg-type]
        x += draw.textlength(text, font=font) + 16  # type: ignore[arg-type]
    if factor:
        text = f"arrows: from the expected to the measured place, {factor:,.0f} times enlarged"
        draw.text((6, top + 4 + 2 * LINE_PX), text, _ARROW, font=font)  # type: ignore[arg-type]


SIDE_PX, MAP_FOOT_PX = 900, 24
MAP_ARROW_PX = 22.0
"""Length in pixels of the arrow of the reference residual on a residual map."""
_GROUND, _STAR, _MAP_ARROW, _MAP_TEXT = (
    (12, 14, 20),
    (90, 120, 150),
    (110, 200, 255),
    (225, 225, 225),
)


def draw_residuals(
    place_px: Vector,
    residual_px: Vector,
    size_px: tuple[int, int],
    arrow_of_px: float,
    title: str,
) -> bytes:
    """A PNG of residuals (n, 2) as arrows on a sensor; `arrow_of_px` is the reference residual."""
    from PIL import Image, ImageDraw, ImageFont

    scale = SIDE_PX / max(size_px)
    width, height = (max(1, round(side * scale)) for side in size_px)
    image = Image.new("RGB", (width, height + MAP_FOOT_PX), _GROUND)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(13)
    factor = MAP_ARROW_PX / max(arrow_of_px, 1e-9)
    ends = (place_px + 0.5) * scale + residual_px * factor
    for (x, y), (u, v) in zip(((place_px + 0.5) * scale).tolist(), ends.tolist(), strict=True):
        draw.ellipse((x - 1, y - 1, x + 1, y + 1), fill=_STAR)
        draw.line((x, y, u, v), fill=_MAP_ARROW)
    rms = math.sqrt(float(np.mean(residual_px**2))) if residual_px.size else 0.0
    text = f"{title}: {rms:.3f} px rms per axis; this bar is {arrow_of_px:.3f} px"
    draw.rectangle((0, height, width, height + MAP_FOOT_PX), fill=(0, 0, 0))
    draw.text((6, height + 4), text, fill=_MAP_TEXT, font=font)
    end = draw.textlength(text, font=font) + 14
    draw.line((end, height + 12, end + MAP_ARROW_PX, height + 12), fill=_MAP_ARROW, width=2)
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()
