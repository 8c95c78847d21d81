"""Shapes on pixels: whole, even, and with slopes that are their own."""

import numpy as np
import pytest

from service.errors import BadInput
from service.features.pictures.centroids.centroid import centroid
from service.features.pictures.centroids.psf import GaussianPsf, SampledPsf, airy_psf, wired_psf
from service.features.pictures.centroids.window import Detector
from studies.star_image_report.optics import airy
from tests.features.pictures.optics import DIAMETER_M, LASER_M, MESH
from tests.reference.star_windows import draw_stars

WIRES = [
    (turn, place / DIAMETER_M, width / DIAMETER_M)
    for turn in (0.0, 90.0)
    for place, width in MESH.across(DIAMETER_M)
]
PIXEL_RAD = LASER_M / DIAMETER_M


@pytest.fixture(scope="module")
def shapes():
    return {
        "gaussian": GaussianPsf(0.9),
        "airy": airy_psf(1.1),
        "ring": airy_psf(1.4, obscuration=0.3, jitter_px=0.2),
        "cross": wired_psf(1.0, WIRES, reach_px=32, cells_across=256),
    }


@pytest.mark.parametrize("name", ["gaussian", "airy", "ring", "cross"])
def test_a_shape_is_even_and_its_slopes_are_its_own(name, shapes, rng):
    psf = shapes[name]
    u, v = rng.uniform(-4, 4, (2, 50))
    peak = float(psf.pixel(0.0, 0.0))
    assert psf.pixel(-u, v) == pytest.approx(psf.pixel(u, v), abs=1e-6 * peak)
    assert psf.pixel(u, -v) == pytest.approx(psf.pixel(u, v), abs=1e-6 * peak)
    h = 1e-5
    in_u = (psf.pixel(u + h, v) - psf.pixel(u - h, v)) / (2 * h)
    in_v = (psf.pixel(u, v + h) - psf.pixel(u, v - h)) / (2 * h)
    assert psf.slopes(u, v)[0] == pytest.approx(in_u, abs=1e-5 * peak)
    assert psf.slopes(u, v)[1] == pytest.approx(in_v, abs=1e-5 * peak)


@pytest.mark.parametrize(
    ("name", "least"), [("gaussian", 1 - 1e-12), ("airy", 0.98), ("ring", 0.95), ("cross", 0.85)]
)
def test_pixels_share_the_light_and_no_more(name, least, shapes):
    grid = np.arange(-20.0, 21.0)
    held = shapes[name].pixel(grid[None, :] - 0.3, grid[:, None] + 0.4).sum()
    assert least <= held <= 1 + 1e-9


def test_a_sampled_gaussian_is_the_gaussian(rng):
    fine = np.arange(-60, 61) / 5.0
    image = np.exp(-0.5 * (fine[None, :] ** 2 + fine[:, None] ** 2) / 1.2**2)
    u, v = rng.uniform(-5, 5, (2, 100))
    sampled, exact = SampledPsf(image, 5.0), GaussianPsf(1.2)
    assert sampled.pixel(u, v) == pytest.approx(exact.pixel(u, v), abs=2e-6)
    assert sampled.fwhm_px == pytest.approx(exact.fwhm_px, rel=0.01)
    smeared = SampledPsf(image, 5.0, jitter_px=0.9)
    assert smeared.pixel(u, v) == pytest.approx(GaussianPsf(1.5).pixel(u, v), abs=2e-5)


def test_pixels_far_finer_than_the_image_see_the_airy_disc():
    psf = airy_psf(20.0, reach_px=60)
    r = np.linspace(0.0, 45.0, 20)
    expected = airy(r, 0.5, 20.0)
    assert psf.pixel(r, 0 * r) / psf.pixel(0.0, 0.0) == pytest.approx(expected, abs=2e-3)
    assert psf.fwhm_px == pytest.approx(1.029 * 20.0, rel=0.01)


def test_a_cross_has_its_arms_along_the_axes(shapes):
    psf = shapes["cross"]
    first = PIXEL_RAD and LASER_M / MESH.pitch_m / PIXEL_RAD
    on_tail, beside = psf.pixel(first, 0.0), psf.pixel(first, 0.5 * first)
    assert on_tail > 100 * beside
    assert psf.pixel(0.0, first) == pytest.approx(float(on_tail), rel=1e-6)


@pytest.mark.parametrize("name", ["airy", "cross"])
def test_matched_reaches_its_predicted_sigma_on_any_shape(name, shapes, rng):
    psf, normal = shapes[name], []
    for star in draw_stars(rng, 120, psf, 60.0, Detector(read_noise_e=8.0), 20.0):
        found = centroid(star.window, "matched", psf)
        normal.append(
            (
                (found.u_px - star.u_px) / found.sigma_u_px,
                (found.v_px - star.v_px) / found.sigma_v_px,
            )
        )
    assert np.std(normal) == pytest.approx(1.0, abs=0.1 + 5 / np.sqrt(480))
    assert np.abs(np.mean(normal, axis=0)).max() < 5 / np.sqrt(120)


def test_shapes_that_make_no_sense_are_refused():
    with pytest.raises(BadInput, match="sigma_px"):
        GaussianPsf(0.0)
    with pytest.raises(BadInput, match="odd"):
        SampledPsf(np.ones((4, 5)), 4.0)
    with pytest.raises(BadInput, match="samples_per_px"):
        SampledPsf(np.ones((5, 5)), 1.0)
    with pytest.raises(BadInput, match="obscuration"):
        airy_psf(1.0, obscuration=1.0)
