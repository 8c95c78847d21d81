"""IM-3 and IM-6: location by correlation, on a cross and on anything."""

import math

import numpy as np
import pytest

from service.errors import BadInput
from service.features.pictures.centroids.psf import GaussianPsf
from service.vectors import ARCSEC_PER_RADIAN
from studies.star_image_report.correlate import (
    displacement_by_derivative,
    displacement_by_peak,
    light_through,
    locate,
    misaligned,
    negative,
    overlap,
    search_by_axes,
)
from studies.star_image_report.transfer import PointImage, image_by_fft
from studies.star_image_report.wires import INCH_M, filtered
from tests.features.pictures.optics import DIAMETER_M, LASER_M

GRID = np.arange(-40.0, 41.0)


def hump(u=0.0, v=0.0, sigma_u=2.0, sigma_v=2.0):
    return np.exp(-0.5 * (((GRID[None, :] - u) / sigma_u) ** 2)) * np.exp(
        -0.5 * ((GRID[:, None] - v) / sigma_v) ** 2
    )


def cross(u=0.0, v=0.0):
    return hump(u, v) + 0.3 * hump(u, v, 15.0, 1.5) + 0.3 * hump(u, v, 1.5, 15.0)


def test_peak_and_derivative_find_a_shift_along_a_line(rng):
    x = np.arange(128.0)
    for shift in rng.uniform(-20, 20, 5):
        f, g = (np.exp(-0.5 * ((x - 64 - s) / 3) ** 2) for s in (0.0, shift))
        assert displacement_by_peak(g, f) == pytest.approx(shift, abs=0.02)
        assert displacement_by_derivative(g, f) == pytest.approx(shift, abs=1e-6)


def test_correlation_is_greatest_when_nothing_is_misaligned():
    shape = cross()
    aligned = overlap(shape, misaligned(shape, 0.0, 0.0, 0.0))
    assert aligned == pytest.approx(1.0)
    for k, h, turn in ((1.0, 0, 0), (0, -1.0, 0), (0, 0, 0.1)):
        assert overlap(shape, misaligned(shape, k, h, turn)) < 0.995 * aligned


def test_a_turn_is_a_turn():
    """With the cosine that one printing of the report lost, a quarter turn keeps the light."""
    tilted = hump(8.0, 3.0, 4.0, 1.5)
    turned = misaligned(tilted, 0.0, 0.0, math.pi / 2)
    assert turned == pytest.approx(np.rot90(tilted), abs=1e-6)
    assert misaligned(turned, 0.0, 0.0, -math.pi / 2) == pytest.approx(tilted, abs=1e-6)


def test_two_searches_along_axes_find_a_cross_however_far(rng):
    noise = rng.normal(0.0, 0.02, cross().shape)
    for u, v in ((18.3, -12.4), (-3.0, 19.7)):
        found = search_by_axes(cross(u, v) + noise, cross())
        assert found == pytest.approx((u, v), abs=0.1)


def test_a_compact_star_gives_two_searches_nothing_to_climb():
    """The authors' own objection: phi is zero until the star is nearly aligned."""
    far = np.roll(hump(), (13, 18), axis=(0, 1))
    assert overlap(far, np.roll(hump(), 18, axis=1)) < 1e-4
    assert overlap(np.roll(cross(), (13, 18), axis=(0, 1)), np.roll(cross(), 18, axis=1)) > 0.05


def test_location_by_transform_reaches_its_bound_in_noise(rng):
    """Unbiased, and scattered as the Cramér-Rao bound that it tells, within 15 %."""
    psf = GaussianPsf(1.5)
    place = np.arange(-20.0, 21.0)
    pattern = psf.pixel(place[None, :], place[:, None])
    errors, sigmas = [], []
    for _ in range(300):
        u, v = rng.uniform(-6, 6, 2)
        image = 1000 * psf.pixel(place[None, :] - u, place[:, None] - v)
        found = locate(image + 20 + rng.normal(0, 2, image.shape), pattern, noise_sigma=2.0)
        errors.append((found.u_px - u, found.v_px - v))
        sigmas.append(found.sigma_u_px)
    scatter = np.std(errors)
    assert np.abs(np.mean(errors, axis=0)).max() < 5 * scatter / math.sqrt(300)
    assert scatter == pytest.approx(np.mean(sigmas), rel=0.15)


def test_location_works_on_anything_and_tells_how_much_the_peak_stands_out(rng):
    pattern = rng.normal(size=(40, 52))
    moved = np.roll(pattern, (-7, 11), axis=(0, 1))
    found = locate(moved, pattern)
    assert (found.u_px, found.v_px) == pytest.approx((11.0, -7.0), abs=1e-6)
    assert found.peak == pytest.approx(1.0)
    assert found.peak_ratio > 3.0
    twin = locate(moved + np.roll(moved, 20, axis=1), pattern)
    assert twin.peak_ratio < 1.5


def test_an_image_of_nothing_is_refused():
    with pytest.raises(BadInput, match="image"):
        locate(np.ones((8, 8)), np.ones((8, 8)))
    with pytest.raises(BadInput, match="reference"):
        locate(np.ones((8, 8)), np.ones((8, 9)))


@pytest.fixture(scope="module")
def apodised_cross() -> tuple[PointImage, float]:
    """Two diameters each way through the report's aperture, at steps of 5 arcsec."""
    wires = [(-0.1355 * INCH_M, 0.00443 * INCH_M), (0.1355 * INCH_M, 0.00663 * INCH_M)]
    step = 5.0 / ARCSEC_PER_RADIAN
    width = LASER_M / step / DIAMETER_M
    pupil = filtered(DIAMETER_M, wires, wires, cells=400, width=width)
    image = image_by_fft(pupil, LASER_M)
    return image, image.step_rad * ARCSEC_PER_RADIAN


def test_a_thousandth_of_an_inch_is_15_arcsec():
    assert pytest.approx(14.97, abs=0.005) == 0.001 / (350.0 / 25.4) * ARCSEC_PER_RADIAN
    assert pytest.approx(9.48, abs=0.005) == LASER_M / DIAMETER_M * ARCSEC_PER_RADIAN


def test_light_through_the_negative_rises_at_15_60_and_240_arcsec(apodised_cross):
    """The experiment of 5.4: least when aligned, and more with every displacement along a tail."""
    image, step_arcsec = apodised_cross
    film = negative(image.intensity, full_at=0.01)
    through = [
        light_through(image.intensity, film, round(arcsec / step_arcsec), 0)
        for arcsec in (0.0, 15.0, 60.0, 240.0)
    ]
    assert all(np.diff(through) > 0.01)
