"""The fit of a great circle: against scipy's least squares, and its covariance by Monte-Carlo."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from service.features.tracks.linking import fit_motion
from service.vectors import rotate_about, unit

RATE = np.array([2e-4, -1e-4])
TIMES = np.linspace(0.0, 900.0, 25)


def drawn(rng, sigma=1e-5):
    """Points of a motion with noise that is twice as large along one axis, and its truth."""
    place = unit(rng.normal(size=3))
    along = unit(np.cross(place, rng.normal(size=3)))
    pole = np.cross(place, along) * 2e-4
    moments = TIMES - TIMES.mean()
    truth = rotate_about(pole * moments[:, None], np.tile(place, (len(TIMES), 1)))
    spread = np.diag([sigma, 2 * sigma, sigma]) ** 2
    across = np.eye(3) - truth[:, :, None] * truth[:, None, :]
    covariance = across @ spread @ across + 1e-24 * np.eye(3)
    noise = rng.normal(size=(len(TIMES), 3)) @ np.sqrt(spread)
    noise -= np.sum(noise * truth, axis=1)[:, None] * truth
    return unit(truth + noise), covariance, place, np.cross(pole, place)


def test_the_optimum_is_that_of_scipy(rng):
    direction, covariance, *_ = drawn(rng)
    found = fit_motion(TIMES, direction, covariance, moves=True)
    # Independent: a start and a rotation vector, with weights of the whole covariance.
    weight = np.linalg.pinv(covariance, rcond=1e-6, hermitian=True)
    root = np.linalg.eigh(weight)
    root = root.eigenvectors * np.sqrt(np.maximum(root.eigenvalues, 0.0))[:, None, :]

    def off(state):
        place, turn = unit(state[:3]), state[3:] * 1e-4
        turn = turn - (turn @ place) * place
        moved = rotate_about(turn * (TIMES - found.time_s)[:, None], np.tile(place, (25, 1)))
        misfit = np.einsum("nij,ni->nj", root, direction - moved).ravel()
        # Without these, nothing holds the length of the place and the part of the turn along it.
        # A step along them once led to the far side of the sky, where the misfit is the same.
        return np.concatenate([misfit, [state[:3] @ state[:3] - 1.0, state[3:] @ place]])

    start = np.concatenate([direction[12], np.cross(direction[0], direction[-1]) / 900.0 * 1e4])
    best = least_squares(off, start, xtol=1e-15, ftol=1e-15, gtol=1e-15, x_scale="jac")
    assert found.chi_square == pytest.approx(2 * best.cost, rel=1e-4)
    assert np.linalg.norm(unit(best.x[:3]) - found.direction) < 1e-8
    assert np.linalg.norm(np.cross(best.x[3:] * 1e-4, found.direction) - found.rate) < 1e-10


def test_errors_are_as_large_as_their_covariance_says(rng):
    squares, chi_squares = [], []
    for _ in range(400):
        direction, covariance, place, rate = drawn(rng)
        found = fit_motion(TIMES, direction, covariance, moves=True)
        error = np.concatenate(
            [found.axes @ (found.direction - place), found.axes @ (found.rate - rate)]
        )
        squares.append(error @ np.linalg.solve(found.covariance, error))
        chi_squares.append(found.chi_square)
    # Chi-square with four degrees of freedom: mean 4, the mean of 400 within five sigmas.
    assert np.mean(squares) == pytest.approx(4.0, abs=5 * np.sqrt(8 / 400))
    assert np.mean(chi_squares) == pytest.approx(46.0, abs=5 * np.sqrt(92 / 400))


def test_a_direction_at_another_time_has_the_error_that_is_foretold(rng):
    later, pulls = np.array([2500.0]), []
    for _ in range(400):
        direction, covariance, place, rate = drawn(rng)
        found = fit_motion(TIMES, direction, covariance, moves=True)
        seen, axes = found.at(later)
        pole = np.cross(place, rate)
        truth = rotate_about(pole * (later - TIMES.mean()), place)
        error = axes[0] @ (seen[0] - truth)
        pulls.append(error @ np.linalg.solve(found.spread(later)[0], error))
    assert np.mean(pulls) == pytest.approx(2.0, abs=5 * np.sqrt(4 / 400))
