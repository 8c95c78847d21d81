"""A dark frame takes hot pixels, and the light of the sensor itself, out of a picture."""

import numpy as np
import pytest

from service.errors import BadFile
from service.features.pictures.detection.points import find_points, hot_pixels, without_dark
from service.features.pictures.frames.frame import Frame

SHAPE = (300, 400)


@pytest.fixture
def sensor(rng):
    """What the sensor makes by itself, and the hot pixels of it."""
    own = np.linspace(0.0, 30.0, SHAPE[1]) * np.ones(SHAPE)
    hot = rng.integers(5, 290, 40), rng.integers(5, 390, 40)
    own[hot] += 400.0
    return own, hot


def exposed(rng, light):
    return Frame(np.round(light + rng.normal(100.0, 2.0, SHAPE)), "NPY", "sha256:0", 65535.0)


def test_hot_pixels_are_no_candidates(rng, sensor):
    own, hot = sensor
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    star = 60.0 * np.exp(-0.5 * ((u - 120.4) ** 2 + (v - 99.7) ** 2) / 1.3**2)
    frame, dark = exposed(rng, own + star), exposed(rng, own)
    assert hot_pixels(dark.counts)[hot].all()
    assert find_points(frame.counts, keep_hot=True).count > 20
    points = find_points(without_dark(frame, dark).counts)
    assert points.count <= 3
    assert (points.u_px[0], points.v_px[0]) == pytest.approx((120.4, 99.7), abs=0.15)


def test_a_dark_frame_of_another_size_is_refused(rng):
    dark = Frame(np.zeros((10, 20)), "NPY", "sha256:0")
    with pytest.raises(BadFile, match="20 x 10 px"):
        without_dark(exposed(rng, 0.0), dark)
