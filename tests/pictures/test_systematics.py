"""Errors that stars share are seen in their residuals, and do not average down."""

import numpy as np
import pytest

from service.identify.blind.lens import Lens, fit_lens
from service.identify.blind.systematics import shared_variance_px2, simpler_fit

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
