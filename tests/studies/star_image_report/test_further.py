"""What the report only names, each held against a second way to the same number."""

import math

import numpy as np
import pytest

from service.features.pictures.centroids.sequential import diffuse
from studies.star_image_report.correlate import (
    FIELD,
    SIGMA_PX,
    align,
    correlation_of_field,
    field_image,
    misaligned,
)
from studies.star_image_report.measurements import (
    HUMP,
    SIGMA,
    best_order,
    grid_points,
    learning,
    least_spread,
    most_telling,
    spread_of,
    spreads_along,
)
from studies.star_image_report.optics import DIAMETER_M, LASER_M
from studies.star_image_report.sun_tracker import ThreeDetectors
from studies.star_image_report.wires_and_lines import (
    THICK_M,
    THIN_M,
    THIRD_M,
    in_light,
    lines,
    tail_of_wires,
    wires,
)


@pytest.mark.parametrize("turn", [0.0, 0.2, -2.5])
def test_phi_of_a_field_is_the_integral_of_its_definition(turn, rng):
    """By a sum over a plane of f(x, y) f((x + k) cos - (y + h) sin, (x + k) sin + ...)."""
    k, h = rng.uniform(-5.0, 5.0, 2)

    def field(x, y):
        return sum(
            light * np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / SIGMA_PX**2)
            for u, v, light in FIELD
        )

    place = np.arange(-60.0, 60.1, 0.5)
    x, y = place[None, :], place[:, None]
    cosine, sine = math.cos(turn), math.sin(turn)
    moved = field((x + k) * cosine - (y + h) * sine, (x + k) * sine + (y + h) * cosine)
    expected = np.sum(field(x, y) * moved) / np.sum(field(x, y) ** 2)
    assert correlation_of_field(k, h, turn) == pytest.approx(expected, abs=1e-9)


def test_a_field_turned_by_any_angle_is_aligned(rng):
    reference = field_image()
    k, h = rng.uniform(-5.0, 5.0, 2)
    turn = float(rng.uniform(-math.pi, math.pi))
    image = misaligned(reference, k, h, turn) + rng.normal(0.0, 0.01, reference.shape)
    at = align(image, reference, 0.01)
    assert at.k_px == pytest.approx(k, abs=5.0 * at.sigmas[0])
    assert at.h_px == pytest.approx(h, abs=5.0 * at.sigmas[1])
    assert math.remainder(at.turn_rad - turn, math.tau) == pytest.approx(0, abs=5 * at.sigmas[2])


def test_the_tail_of_three_wires_is_that_of_points_all_over_the_aperture(rng):
    """A sum of waves from points of the open aperture: a low-discrepancy Monte-Carlo."""
    from scipy.stats import qmc

    three = wires(THIN_M, THICK_M, THIRD_M)
    p = np.array([0.4, 1.0, 2.0, 2.8, 4.0]) * 1e-3
    point = DIAMETER_M * (qmc.Sobol(2, rng=rng).random_base2(18) - 0.5)
    x = point[np.hypot(*point.T) < DIAMETER_M / 2.0, 0]
    dark = np.any([np.abs(x - at) < width / 2.0 for at, width in three], axis=0)
    waves = np.exp(-2j * np.pi / LASER_M * np.outer(np.append(p, 0.0), x[~dark])).sum(axis=1)
    expected = np.abs(waves) ** 2 / np.abs(waves[-1]) ** 2
    got = tail_of_wires(three, LASER_M, p)
    # Six times what the points of another seed change.
    assert got == pytest.approx(expected[:-1], rel=0.03, abs=5e-6)


def test_a_spectrum_of_lines_is_the_sum_of_its_lines():
    p = np.array([2e-3, 5e-3])
    one, other = (in_light(lines([nm]), wires(THIN_M), p) for nm in (500.0, 600.0))
    both = in_light(lines([500.0, 600.0], [3.0, 1.0]), wires(THIN_M), p)
    assert both == pytest.approx(0.75 * one + 0.25 * other, rel=1e-12)


@pytest.mark.parametrize(("along", "across"), [(0.0, 0.0), (4.0, -3.0), (-6.0, 5.0)])
def test_light_on_a_tail_s_detector_is_that_of_single_rays(along, across, rng):
    """Points of the sun's disc, colours and orders of the screen at random, and counted."""
    three, rays = ThreeDetectors(), 60_000
    sun = three.tracker
    radius = sun.sun_radius_arcmin * np.sqrt(rng.random(rays))
    angle = math.tau * rng.random(rays)
    here, aside = along + radius * np.cos(angle), across + radius * np.sin(angle)
    wave = rng.choice(np.linspace(sun.shortest_m, sun.longest_m, sun.colours), rays)
    minutes = 180.0 * 60.0 / math.pi
    spacing = wave / sun.mesh.pitch_m * minutes
    order = np.round(sun.out_arcmin / spacing)[:, None] + np.arange(-30, 31)
    light = np.sinc(order * sun.mesh.opening_m / sun.mesh.pitch_m) ** 2
    half = 0.5 * sun.side_arcmin
    on = np.abs(order * spacing[:, None] + here[:, None] - sun.out_arcmin) < half
    on &= (np.abs(aside - sun.aside_arcmin) < half)[:, None]
    each = (light * on).sum(axis=1) * math.pi * sun.sun_radius_arcmin**2 / sun.side_arcmin**2
    doubt = 5.0 * each.std() / math.sqrt(rays)
    got = three.flank_light(along, across)
    assert got == pytest.approx(each.mean(), abs=doubt + 0.01 * got)


def test_a_middle_detector_sees_the_share_of_the_disc_that_falls_on_it(rng):
    three = ThreeDetectors()
    p, q = 14.0, -11.0
    point = rng.uniform(-24.0, 24.0, (200_000, 2))
    inside = np.hypot(point[:, 0] - p, point[:, 1] - q) < 16.0
    assert three.acquired_light(p, q) == pytest.approx(inside.mean(), abs=0.006)


def test_a_sun_far_off_gives_no_signals_and_is_found(rng):
    three = ThreeDetectors()
    assert three.signals(60.0, 12.0) is None
    found = three.steered(*rng.uniform(-300.0, 300.0, 2))
    assert found is not None
    assert math.hypot(found[0], found[1]) < 0.1


def test_the_most_telling_measurement_is_that_of_all_tried(rng):
    rows = HUMP.rows(*grid_points(5))
    estimate = diffuse([0.3] * 3).replayed(rows[rng.integers(0, 25, 4)], np.zeros(4), SIGMA**2)
    after = [spread_of(estimate.updated(row, 0.0, SIGMA**2)) for row in rows]
    assert after[most_telling(estimate, rows, SIGMA**2)] == pytest.approx(min(after), rel=1e-12)


def test_the_chosen_order_is_nearly_as_good_as_the_best_of_all_choices():
    rows = HUMP.rows(*grid_points(3))
    chosen = rows[best_order(rows, SIGMA**2, 4)]
    assert spreads_along(chosen, SIGMA**2)[-1] < 1.2 * least_spread(rows, SIGMA**2, 4)


def test_learned_noise_is_that_of_least_squares(rng):
    """The residual variance of numpy's own least squares, after the last measurement."""
    rows = HUMP.rows(*rng.uniform(-1.0, 1.0, (2, 30)))
    values = rows @ [0.1, -0.05, 0.02] + rng.normal(0.0, 0.3, 30)
    found = learning(3)
    for row, value in zip(rows, values, strict=True):
        found = found.updated(row, float(value))
    state, squares, *_ = np.linalg.lstsq(rows, values, rcond=None)
    assert found.estimate.state == pytest.approx(state, abs=1e-6)
    assert found.noise_variance == pytest.approx(squares[0] / 27.0, rel=1e-5)
    covariance = squares[0] / 27.0 * np.linalg.inv(rows.T @ rows)
    assert found.sigma == pytest.approx(np.sqrt(np.diag(covariance)), rel=1e-4)
