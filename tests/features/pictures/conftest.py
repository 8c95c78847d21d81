"""Frames of a spacecraft, which are pictures too, and the sky in which pictures are solved."""

import numpy as np
import pytest

from service.features.pictures.blind.lens import Lens
from service.features.pictures.blind.picture import blind_sky
from service.features.pictures.blind.solver import focal_px_of
from service.sky.catalog.star_catalog import load_embedded
from tests.features.pictures.drawn import draw_picture
from tests.features.pictures.test_frames_over_http import frames, send

__all__ = ["frames", "send"]


@pytest.fixture(scope="module")
def blind(request):
    """Sky and solver for the year that a module names `YEAR`, or 2020."""
    return blind_sky(load_embedded(), getattr(request.module, "YEAR", 2020))


@pytest.fixture(scope="module")
def picture(blind):
    """A picture with plenty of stars."""
    lens = Lens(640, 480, focal_px_of(640, 14.0))
    return draw_picture(np.random.default_rng(5), blind[0], stars=60, quality=None, lens=lens)
