"""What is drawn on the picture of a frame."""

import io

import numpy as np
import pytest
from PIL import Image

from service.features.pictures.tracker.overlay import Mark, draw_overlay

SIDE_PX = 256
ARROW = (110, 200, 255)


def overlay(marks):
    file = io.BytesIO()
    Image.fromarray(np.zeros((SIDE_PX, SIDE_PX), np.uint8)).save(file, "PNG")
    with Image.open(io.BytesIO(draw_overlay(file.getvalue(), 1, marks, ""))) as picture:
        return np.asarray(picture)


@pytest.mark.parametrize("along", [(0.05, 0.0), (-0.05, 0.0), (0.0, 0.05), (0.0, -0.05)])
def test_an_arrow_points_from_the_expected_to_the_measured_place(along):
    """Columns to the right and rows downwards, as on the frame; longer, but no other way."""
    u, v = 100.0, 140.0
    picture = overlay([Mark(u, v, "unique", predicted_px=(u - along[0], v - along[1]))])
    rows, columns = np.nonzero((picture[: 3 * SIDE_PX] == ARROW).all(axis=2))
    star = 3.0 * (np.array([u, v]) + 0.5)
    away = np.array([columns, rows]).T - star
    tip = away[np.argmax(np.hypot(*away.T))]
    assert np.hypot(*tip) > 20.0
    assert tip / np.hypot(*tip) == pytest.approx(np.array(along) / 0.05, abs=0.1)
