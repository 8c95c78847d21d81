"""Errors that stars share are seen in their residuals, and do not average down."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.features.pictures.blind.lens import (
    PARAMETERS,
    Lens,
    fit_lens,
    lens_of,
    linearised,
    shared_variance_px2,
    simpler_fit,
)

COUNT = 200


def test_residuals_that_neighbours_share_are_told_from_noise(rng):
    u, v = rng.uniform(0, 1000, (2, COUNT))
    noise = rng.normal(0.0, 0.2, (COUNT, 2))
    wave = 0.2 * np.sqrt(2.0) * np.column_stack([np.sin(u / 150.0), np.sin(v / 150.0)])
    unseen = 0.04 / np.sqrt(COUNT)
    assert shared_variance_px2(u, v, noise, 0.04) == pytest.approx(unseen, abs=0.005)
    shared = shared_variance_px2(u, v, noise + wave, 0.04)
    assert shared == pytest.approx(0.04 + unseen, rel=0.3)


def test_the_simpler_fit_lies_away_by_what_the_last_terms_do(rng):
    lens = Lens(1000, 1000, 2000.0, 0.0, 0.05, 0.0)
    u, v = rng.uniform(0, 1000, (2, COUNT))
    star = lens.directions(u, v)
    fits = [
        fit_lens(Lens(1000, 1000, 2000.0), np.eye(3), u, v, np.full(COUNT, 0.1), star, parameters)
        for parameters in (4, 5, 7)
    ]
    assert simpler_fit(fits[0], u, v, star, fits[0].residual_px) is None
    one = simpler_fit(fits[2], u, v, star, fits[2].residual_px)
    assert one.parameters == 5
    middle = np.array([499.5]), np.array([499.5])
    apart = one.lens.directions(*middle) @ one.attitude - lens.directions(*middle)
    assert 0.1 < np.linalg.norm(apart) * 2000.0 < 3.0


def test_the_derivatives_of_a_lens_are_those_of_differences(rng):
    lens = Lens(1000, 800, 900.0, -0.03, 0.04, -0.02)
    u, v = rng.uniform(0, 1000, 20), rng.uniform(0, 800, 20)
    attitude = Rotation.random(random_state=3).as_matrix()
    near = Rotation.from_rotvec([1e-3, -2e-3, 5e-4]).as_matrix() @ attitude
    star = lens.directions(u, v) @ near
    free = np.array([0.0, lens.bend, lens.off_u, lens.off_v])
    residual, jacobian = linearised(lens, PARAMETERS, free, attitude, u, v, star)
    for k in range(7):
        changes = []
        for step in (1e-6, -1e-6):
            turned, other = attitude, free.copy()
            if k < 3:
                turned = Rotation.from_rotvec(step * np.eye(3)[k]).as_matrix() @ attitude
            else:
                other[k - 3] += step
            moved, _ = linearised(lens, PARAMETERS, other, turned, u, v, star)
            scale = lens.focal_px / lens_of(lens, PARAMETERS, other).focal_px
            changes.append(moved * scale)
        expected = (changes[1] - changes[0]) / 2e-6
        assert jacobian[:, k] == pytest.approx(expected, rel=1e-5, abs=1e-3)
    assert residual.shape == (40,)
