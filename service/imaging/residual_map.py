"""A picture of residuals: an arrow a star, all longer by the same factor."""

import io
import math

import numpy as np

from service.vectors import Vector

SIDE_PX, FOOT_PX = 900, 24
ARROW_PX = 22.0
"""The length of the arrow of the reference residual."""
_GROUND, _STAR, _ARROW, _TEXT = (12, 14, 20), (90, 120, 150), (110, 200, 255), (225, 225, 225)


def draw_residuals(
    place_px: Vector,
    residual_px: Vector,
    size_px: tuple[int, int],
    arrow_of_px: float,
    title: str,
) -> bytes:
    """A PNG of residuals (n, 2) at places (n, 2) of a sensor; `arrow_of_px` has a usual arrow."""
    from PIL import Image, ImageDraw, ImageFont

    scale = SIDE_PX / max(size_px)
    width, height = (max(1, round(side * scale)) for side in size_px)
    image = Image.new("RGB", (width, height + FOOT_PX), _GROUND)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(13)
    factor = ARROW_PX / max(arrow_of_px, 1e-9)
    ends = (place_px + 0.5) * scale + residual_px * factor
    for (x, y), (u, v) in zip(((place_px + 0.5) * scale).tolist(), ends.tolist(), strict=True):
        draw.ellipse((x - 1, y - 1, x + 1, y + 1), fill=_STAR)
        draw.line((x, y, u, v), fill=_ARROW)
    rms = math.sqrt(float(np.mean(residual_px**2))) if residual_px.size else 0.0
    text = f"{title}: {rms:.3f} px rms per axis; this bar is {arrow_of_px:.3f} px"
    draw.rectangle((0, height, width, height + FOOT_PX), fill=(0, 0, 0))
    draw.text((6, height + 4), text, fill=_TEXT, font=font)
    end = draw.textlength(text, font=font) + 14
    draw.line((end, height + 12, end + ARROW_PX, height + 12), fill=_ARROW, width=2)
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue()
