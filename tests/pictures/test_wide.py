"""Pictures of very wide lenses, and of pixels that are not square, of which nothing is told."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.acquire.picture import blind_sky, solve_picture
from service.imaging.frames.frame import Frame
from service.sky.catalog.star_catalog import load_embedded
from service.vectors import attitude_error_arcsec
from tests.pictures.trailed import add_path

RADIUS = {
    "gnomonic": math.tan,
    "equidistant": float,
    "equisolid": lambda angle: 2.0 * math.sin(0.5 * angle),
    "stereographic": lambda angle: 2.0 * math.tan(0.5 * angle),
}
WIDTH, HEIGHT, PSF_PX, NOISE = 1200, 800, 1.2, 7.0


@pytest.fixture(scope="module")
def blind():
    return blind_sky(load_embedded(), 2026)


def drawn(sky, kind, field_deg, faintest_mag, seed, stretch=(1.0, 1.0)):
    """A picture through a lens, with its truth; `stretch` is of the pixels along u and v."""
    rng = np.random.default_rng(seed)
    attitude = Rotation.random(random_state=seed).as_matrix()
    counts = rng.normal(100.0, NOISE, (round(HEIGHT * stretch[1]), round(WIDTH * stretch[0])))
    height, width = counts.shape
    scale_px = 0.5 * WIDTH / RADIUS[kind](math.radians(0.5 * field_deg))
    bright = sky.magnitude_mag < faintest_mag
    body = sky.direction[bright] @ attitude.T
    light = 126.0 * NOISE * 10.0 ** (0.4 * (faintest_mag - sky.magnitude_mag[bright]))
    for (x, y, z), flux in zip(body.tolist(), light.tolist(), strict=True):
        angle = math.acos(max(min(z, 1.0), -1.0))
        if angle > (1.5 if kind == "gnomonic" else 2.5):
            continue
        radius_px = scale_px * RADIUS[kind](angle) / max(math.hypot(x, y), 1e-9)
        u = 0.5 * (width - 1) + stretch[0] * radius_px * x
        v = 0.5 * (height - 1) + stretch[1] * radius_px * y
        if -9.0 < u < width + 9.0 and -9.0 < v < height + 9.0:
            add_path(counts, np.array([u]), np.array([v]), PSF_PX, np.array([flux]))
    return Frame(counts.astype(np.float32), "NPY", "sha256:0", math.inf), attitude


def assert_right(result, attitude, word):
    error = attitude_error_arcsec(result.attitude.attitude, attitude)
    assert np.hypot(*error[:2]) < 60.0
    assert np.all(np.abs(error) < 4.0 * result.attitude.sigma_arcsec)
    assert any(each.startswith(word) for each in result.remarks)


@pytest.mark.parametrize(
    ("kind", "field_deg", "faintest_mag"),
    [
        ("gnomonic", 100, 5.5),
        ("equidistant", 140, 5.5),
        ("stereographic", 140, 5.5),
        ("equisolid", 180, 5.0),
        ("equidistant", 180, 5.0),
    ],
)
def test_a_lens_too_wide_for_the_search_is_solved_in_its_middle(
    blind, kind, field_deg, faintest_mag
):
    frame, attitude = drawn(blind[0], kind, field_deg, faintest_mag, 5)
    assert_right(solve_picture(frame, *blind), attitude, "wide_lens: ")


@pytest.mark.parametrize("stretch", [(2.0, 1.0), (1.0, 0.5)])
def test_pixels_binned_along_one_side_only_are_solved(blind, stretch):
    frame, attitude = drawn(blind[0], "gnomonic", 40, 6.0, 6, stretch)
    assert_right(solve_picture(frame, *blind), attitude, "unequal_pixels: ")


def test_clear_points_that_are_no_sky_get_a_plain_sentence(blind):
    rng = np.random.default_rng(7)
    counts = rng.normal(100.0, NOISE, (HEIGHT, WIDTH))
    for u, v in rng.uniform(10.0, 790.0, (60, 2)).tolist():
        add_path(counts, np.array([u]), np.array([v]), PSF_PX, np.array([3000.0]))
    result = solve_picture(Frame(counts.astype(np.float32), "NPY", "x", math.inf), *blind)
    assert result.attitude is None
    assert any("the lens may be too wide" in each for each in result.remarks)
