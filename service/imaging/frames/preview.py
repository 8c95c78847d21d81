"""A small picture of a frame for people: its stars, without the noise between them."""

import io
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from service.imaging.frames.frame import CountArray

if TYPE_CHECKING:
    from service.imaging.detection.detect import Detections

MAX_SIDE_PX = 1024
BLACK_SIGMAS = 2.0
WHITE_SIGMAS = 400.0
GREYS = 48
"""Few greys, and black where there is only noise, make a small file."""


def preview_of(found: "Detections") -> tuple[bytes, int]:
    """A PNG of a frame, and how many of its pixels a side make one of the picture's."""
    return preview_png(np.where(found.good, found.light, 0.0), found.noise_counts)


def preview_png(light: CountArray, noise_counts: float) -> tuple[bytes, int]:
    """A PNG of light (rows, columns) above its background, and how many pixels a side make one.

    The brightest of the pixels that become one counts, so that no star is lost.
    """
    from PIL import Image

    rows, columns = light.shape
    step = -(-max(rows, columns) // MAX_SIDE_PX)
    light = np.pad(light, ((0, -rows % step), (0, -columns % step)))
    blocks = light.reshape(light.shape[0] // step, step, light.shape[1] // step, step)
    image = Image.fromarray(_greys(blocks.max(axis=(1, 3)) / noise_counts))
    file = io.BytesIO()
    image.save(file, "PNG")
    return file.getvalue(), step


def _greys(sigmas: npt.NDArray[np.floating]) -> npt.NDArray[np.uint8]:
    """Light in sigmas of the noise as greys, by the inverse hyperbolic sine."""
    above = np.clip(sigmas - BLACK_SIGMAS, 0.0, WHITE_SIGMAS)
    share = np.arcsinh(above / 4.0) / np.arcsinh(WHITE_SIGMAS / 4.0)
    return np.asarray(np.round(share * GREYS) * (255.0 / GREYS), dtype=np.uint8)
