"""IM-1 and IM-2: the image of a star through any aperture, in light of any colours."""

import math
from functools import partial

import numpy as np
import pytest
from scipy.special import j1

from service.errors import BadInput
from service.features.pictures.centroids.optics import Pupil, Spectrum, disc, image_at, thermal
from studies.star_image_report.optics import (
    airy,
    disc_autocorrelation,
    disc_image,
    first_null_rad,
    line_correlation,
    null_fill,
    omega_of,
)
from studies.star_image_report.transfer import (
    autocorrelation,
    behind_plate,
    correlation,
    gaussian_line,
    image_by_fft,
    image_by_functional,
    image_of,
    is_even,
    mean_wavelength_m,
    monochromatic,
)
from tests.features.pictures.optics import DIAMETER_M, LASER_M

RADIUS_M = DIAMETER_M / 2.0


def patchy_pupil(rng, n=24):
    """Any transparency at all: every cell with its own amplitude and phase."""
    amplitude = rng.uniform(0, 1, (n, n))
    return Pupil(amplitude * np.exp(1j * rng.uniform(0, 6, (n, n))), 1e-4)


def disc_phi(steps):
    cell = DIAMETER_M / steps
    place = np.arange(-steps, steps + 1) * cell
    return disc_autocorrelation(np.hypot(place[None, :], place[:, None]), RADIUS_M), cell


def test_an_image_holds_the_open_area_whatever_the_colour(rng):
    """The 1/(lambda f) that the report's 2.9 lacks: to 1e-14 over the whole grid of a transform."""
    pupil = patchy_pupil(rng, 25)
    for wavelength in (400e-9, 800e-9):
        assert image_by_fft(pupil, wavelength).held_m2 == pytest.approx(
            pupil.open_area_m2, rel=1e-14
        )


def test_the_autocorrelation_of_a_disc_is_the_closed_form():
    """Within 1e-3 of its peak at 768 cells a diameter, and pi a² in its middle."""
    pupil = disc(768, DIAMETER_M / 768, RADIUS_M)
    phi = autocorrelation(pupil)
    place = np.arange(-767, 768) * pupil.cell_m
    closed = disc_autocorrelation(np.hypot(place[None, :], place[:, None]), RADIUS_M)
    assert closed.max() == pytest.approx(math.pi * RADIUS_M**2)
    assert np.abs(phi - closed).max() < 1e-3 * closed.max()


def test_the_image_is_the_transform_of_the_autocorrelation(rng):
    """2.13 and 2.14 against |f2|² of 2.10, for a transparency without any symmetry."""
    pupil = patchy_pupil(rng)
    light = monochromatic(LASER_M)
    p, q = rng.uniform(-1e-3, 1e-3, (2, 6))
    by_phi = image_by_functional(
        autocorrelation(pupil), pupil.cell_m, partial(correlation, light), p, q
    )
    direct = [image_at(pupil, LASER_M, p[[k]], q[[k]])[0, 0] for k in range(6)]
    assert by_phi / LASER_M**2 == pytest.approx(direct, rel=1e-9)


@pytest.mark.parametrize("width", [0.02, 0.1, 0.2])
def test_the_functional_equals_the_sum_of_airy_patterns(width):
    """2.23 with the Gaussian line, in the report's own weighting: within 1e-5 of the peak."""
    phi, cell = disc_phi(120)
    p = np.linspace(0.0, 3.0, 10) * LASER_M / DIAMETER_M
    omega = omega_of(LASER_M)

    def light(delay):
        return line_correlation(delay, omega, width * omega)

    found = image_by_functional(phi, cell, light, p, 0.4 * p)
    power = gaussian_line(LASER_M, width, 401).power.sum()
    airys = disc_image(np.hypot(p, 0.4 * p), RADIUS_M, LASER_M, width, report_weight=True) * power
    assert np.abs(found - airys).max() < 1e-5 * airys.max()


def test_the_functional_is_right_in_colour_with_the_image_s_own_weights(rng):
    """With S / lambda² in place of S it equals the image summed colour by colour."""
    pupil = disc(40, DIAMETER_M / 40, RADIUS_M)
    light = thermal(6000.0, 450e-9, 700e-9, colours=7)
    angle = np.array([0.0, 1.0, 2.5]) * LASER_M / DIAMETER_M
    scale = (mean_wavelength_m(light) / light.wavelength_m) ** 2
    weighted = Spectrum(light.omega_rad_per_s, light.power * scale)
    found = image_by_functional(
        autocorrelation(pupil), pupil.cell_m, partial(correlation, weighted), angle, 0 * angle
    )
    step = float(angle[1]) / 2
    direct = image_of(pupil, light, step, 5)
    along = direct.intensity[5, [5, 7, 10]]
    assert found / found[0] == pytest.approx(along / along[0], rel=1e-9)
    assert direct.held_m2 < pupil.open_area_m2


def test_the_transform_on_a_grid_and_in_any_direction_agree(rng):
    pupil = patchy_pupil(rng)
    image = image_by_fft(pupil, LASER_M)
    middle = image.intensity.shape[0] // 2
    near = slice(middle - 3, middle + 4)
    there = image_at(pupil, LASER_M, image.angles_rad[near], image.angles_rad[near])
    assert there == pytest.approx(image.intensity[near, near], rel=1e-10)


def test_one_colour_of_a_line_is_the_ordinary_airy_disc():
    pupil = disc(400, DIAMETER_M / 400, RADIUS_M)
    angle = np.linspace(0, 4, 30) * LASER_M / DIAMETER_M
    image = image_at(pupil, LASER_M, angle, np.zeros(1))[0]
    assert image / image[0] == pytest.approx(airy(angle, RADIUS_M, LASER_M), abs=2e-3)
    q = 2.0
    assert airy(q / (2 * math.pi), 1.0, 1.0) == pytest.approx((2 * j1(q) / q) ** 2)
    assert first_null_rad(RADIUS_M, LASER_M) == pytest.approx(1.21967 * LASER_M / DIAMETER_M, 1e-5)


def test_a_wedge_moves_the_image_and_a_plate_does_not(rng):
    """A prism of glass deflects by (n - 1) times its angle; the image keeps its shape."""
    pupil = disc(64, DIAMETER_M / 64, RADIUS_M)
    angle = 3.0 * LASER_M / DIAMETER_M
    wedge = np.broadcast_to(pupil.places_m * angle / 0.5, (64, 64))
    flat = np.full((64, 64), 1.234e-3)
    straight = image_by_fft(pupil, LASER_M).intensity
    through_flat = image_by_fft(behind_plate(pupil, flat, 1.5, LASER_M), LASER_M).intensity
    through_wedge = image_by_fft(behind_plate(pupil, wedge, 1.5, LASER_M), LASER_M).intensity
    assert through_flat == pytest.approx(straight, rel=1e-9, abs=1e-12 * straight.max())
    # One sample of the transform is lambda / D here.
    assert np.roll(straight, 3, axis=1) == pytest.approx(through_wedge, abs=2e-6 * straight.max())


def test_a_plate_that_depends_on_the_colour_is_given_as_a_function():
    light = gaussian_line(LASER_M, 0.05, 5)
    clear = disc(32, DIAMETER_M / 32, RADIUS_M)
    half_wave = np.where(clear.places_m[None, :] > 0, LASER_M, 0.0) * np.ones((32, 1))

    def split(wavelength):
        return behind_plate(clear, half_wave, 1.5, wavelength)

    step = 0.25 * LASER_M / DIAMETER_M
    image = image_of(split, light, step, 8)
    # Half a wave between the halves: dark where the star was.
    assert image.intensity[8, 8] < 0.05 * image.intensity.max()


@pytest.mark.parametrize("photons", [False, True])
def test_colours_add_by_their_energy_or_by_their_number_of_photons(photons):
    """Two colours of equal power against their Airy discs; a photon of red has less energy."""
    wavelength = np.array([800e-9, 400e-9])
    light = Spectrum(omega_of(wavelength), np.array([1.0, 1.0]))
    pupil = disc(200, DIAMETER_M / 200, RADIUS_M)
    image = image_of(pupil, light, 0.2 * LASER_M / DIAMETER_M, 5, photons=photons)
    weight = wavelength if photons else np.ones(2)
    # An image holds the open area whatever the colour, so that its peak goes with 1 / lambda².
    discs = [
        airy(np.abs(image.angles_rad), RADIUS_M, colour) * (math.pi * RADIUS_M**2 / colour) ** 2
        for colour in wavelength
    ]
    expected = weight @ np.array(discs) / weight.sum()
    assert image.intensity[5] == pytest.approx(expected, abs=2e-3 * expected.max())


@pytest.mark.parametrize(
    ("width", "fill", "within"),
    [(0.02, 2.6e-4, 0.02), (0.05, 1.6e-3, 0.03), (0.1, 5.9e-3, 0.03), (0.2, 1.67e-2, 0.02)],
)
def test_the_first_dark_ring_fills_as_the_line_widens(width, fill, within):
    assert null_fill(width) == pytest.approx(fill, rel=within)


def test_a_fifth_of_the_colour_wide_there_is_no_ring_but_a_shoulder():
    """Where the light falls off slowest, 1.3 % of the peak are left."""
    radius = np.linspace(1.0, 1.4, 400) * first_null_rad(1.0, 1e-6)
    light = disc_image(radius, 1.0, 1e-6, 0.2) / disc_image(np.zeros(1), 1.0, 1e-6, 0.2)
    assert (np.diff(light) < 0).all()
    shoulder = np.argmin(np.abs(np.gradient(light)))
    assert 0 < shoulder < len(light) - 1
    assert light[shoulder] == pytest.approx(1.3e-2, rel=0.03)


def test_a_narrow_line_leaves_the_ring_dark():
    assert null_fill(1e-4) < 5e-8


def test_an_even_aperture_makes_an_even_image(rng):
    """7.10 to 7.16, and for a real aperture point symmetry anyway."""
    even = disc(40, DIAMETER_M / 40, RADIUS_M, obscuration=0.3)
    assert is_even(even)
    image = image_by_fft(even, LASER_M).intensity
    assert image == pytest.approx(image[:, ::-1], rel=1e-9, abs=1e-12 * image.max())
    odd = Pupil(rng.uniform(0, 1, (20, 20)), 1e-4)
    assert not is_even(odd)
    image = image_by_fft(odd, LASER_M).intensity
    assert image == pytest.approx(image[::-1, ::-1], rel=1e-9, abs=1e-12 * image.max())
    assert np.abs(image - image[:, ::-1]).max() > 1e-3 * image.max()


def test_a_spectrum_without_light_or_order_is_refused():
    for omega, power in (([1.0, 1.0], [1, 1]), ([1.0, 2.0], [0, 0]), ([1.0, 2.0], [1, -1])):
        with pytest.raises(BadInput, match="spectrum"):
            Spectrum(np.array(omega), np.array(power, dtype=float))
