"""IM-11: stars by raster lines, and the constant that knows their pattern."""

import itertools

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays

from service.features.pictures.centroids.psf import GaussianPsf
from service.vectors import rotate_about, unit
from studies.star_image_report.recognising import (
    chord_constant,
    constant_sigma,
    find_by_rasters,
    key_of,
    pattern_constant,
    store_of,
)

FIELDS = arrays(np.float64, st.tuples(st.integers(2, 9), st.just(2)), elements=st.floats(-1e3, 1e3))


def as_printed(x, y):
    """7.43, written out."""
    n = len(x)
    crossed = sum(x[i] * x[j] + y[i] * y[j] for i, j in itertools.permutations(range(n), 2))
    return (n - 1) * (np.sum(x**2) + np.sum(y**2)) - crossed


@given(FIELDS)
def test_k_is_the_sum_of_the_squared_distances_of_all_pairs(field):
    x, y = field.T
    pairs = sum(
        (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2 for i, j in itertools.combinations(range(len(x)), 2)
    )
    scale = max(float(np.sum(field**2)), 1e-300) * len(x)
    assert pattern_constant(x, y) == pytest.approx(pairs, abs=1e-12 * scale)
    assert as_printed(x, y) == pytest.approx(pairs, abs=1e-11 * scale)


@given(FIELDS, st.randoms(use_true_random=False))
def test_k_does_not_ask_which_x_belongs_to_which_y(field, random):
    x, y = field.T
    shuffled = np.array(random.sample(y.tolist(), len(y)))
    tight = 1e-12 * max(float(np.sum(field**2)), 1e-300) * len(x)
    assert pattern_constant(x, shuffled) == pytest.approx(pattern_constant(x, y), abs=tight)


def test_the_noise_of_k_is_two_sigma_root_n_k(rng):
    field, sigma = rng.uniform(-1, 1, (2, 6)), 1e-3
    constant = pattern_constant(*field)
    noisy = field + rng.normal(0, sigma, (6000, 2, 6))
    scatter = np.std([pattern_constant(*each) for each in noisy])
    predicted = constant_sigma(constant, 6, sigma)
    assert scatter == pytest.approx(predicted, rel=5 / np.sqrt(2 * 6000))
    keys = [key_of(6, pattern_constant(*each)) for each in noisy]
    assert np.std(keys) == pytest.approx(sigma, rel=5 / np.sqrt(2 * 6000))


def test_chords_are_the_same_wherever_the_telescope_points(rng):
    stars = unit(rng.normal(size=(6, 3)) * 0.05 + (0, 0, 1))
    turned = rotate_about(np.array([0.03, -0.04, 1.1]), stars)
    assert chord_constant(turned) == pytest.approx(chord_constant(stars), rel=1e-12)
    flat = pattern_constant(*(stars[:, :2] / stars[:, 2:]).T)
    tilted = pattern_constant(*(turned[:, :2] / turned[:, 2:]).T)
    assert abs(tilted / flat - 1) > 1e-5


def drawn_field(rng, places, sigma=0.5):
    psf, grid = GaussianPsf(1.2), np.arange(120.0)
    image = rng.normal(0, sigma, (120, 120))
    for u, v in places:
        image += 2000.0 * psf.pixel(grid[None, :] - u, grid[:, None] - v)
    return image


def test_rasters_find_every_star_to_a_pixel(rng):
    places = np.array([(20.2, 70.4), (55.7, 31.0), (90.1, 101.6)])
    found = find_by_rasters(drawn_field(rng, places), 0.5)
    assert found.refused is None
    assert found.u_px == pytest.approx(np.sort(places[:, 0]), abs=0.5)
    assert found.v_px == pytest.approx(np.sort(places[:, 1]), abs=0.5)
    true = pattern_constant(*places.T)
    assert pattern_constant(found.u_px, found.v_px) == pytest.approx(true, rel=0.01)


def test_two_stars_in_one_row_refuse_the_field(rng):
    found = find_by_rasters(drawn_field(rng, [(20, 40), (60, 40.5), (90, 80)]), 0.5)
    assert "3 stars by columns, 2 by rows" in found.refused


def test_an_empty_field_is_refused(rng):
    assert find_by_rasters(drawn_field(rng, []), 0.5).refused is not None


def test_a_store_knows_a_field_again_among_its_likes(rng):
    store = store_of({"A": (5, 4.0), "B": (5, 4.1), "C": (6, 4.0), "D": (5, 9.0)})
    assert store.within(5, 4.02, position_sigma=0.01) == ["A", "B"]
    assert store.within(5, 4.02, position_sigma=0.0005) == []
    assert store.nearest(6, 7.0) == "C"
    assert store.nearest(3, 4.0) is None
