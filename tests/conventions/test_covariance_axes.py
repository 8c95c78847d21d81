"""The covariance is of rotations about the body axes: a narrow field knows its roll the least."""

import numpy as np
import pytest

from service.vectors import attitude_error_arcsec, coordinate_rotation, matrix_from_quaternion
from tests.attitude.cases import field_of_stars, random_attitude, solved

# Body axis of the boresight: XTE and SWAS look along body X, SOHO along body Z.
BORESIGHT = {"XTE": 0, "SWAS": 0, "SOHO": 2}


@pytest.mark.parametrize("name", BORESIGHT)
def test_roll_about_the_boresight_is_the_worst_axis(name, missions, rng):
    axis = BORESIGHT[name]
    tracker = missions[name].trackers[0]
    assert tracker.body_from_tracker[:, 2].tolist() == np.eye(3)[axis].tolist()
    truth = random_attitude(rng)
    body = field_of_stars(rng, np.eye(3)[axis], tracker.field_of_view_radius_deg, 8)
    solution = solved(body, body @ truth, 2.0)
    variance = np.diag(solution.covariance_arcsec2)
    assert int(np.argmax(variance)) == axis
    assert variance[axis] > 50 * max(np.delete(variance, axis))


def test_eight_stars_all_round_know_every_axis_alike():
    body = np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)]) / 3**0.5
    covariance = solved(body, body, 2.0).covariance_arcsec2
    # Each axis: sigma^2 over the sum of sin^2, eight times two thirds.
    assert covariance == pytest.approx(np.eye(3) * 4.0 / (8 * 2 / 3), abs=1e-6)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_turn_of_the_body_about_its_own_axis_is_an_error_about_that_axis(axis, rng):
    """The sign: axes that turned by +e give an attitude error of +e."""
    truth = random_attitude(rng)
    turned = coordinate_rotation(axis, 10.0 / 3600.0) @ truth
    assert attitude_error_arcsec(turned, truth) == pytest.approx(np.eye(3)[axis] * 10.0, abs=1e-8)


def test_errors_scatter_as_the_covariance_s_axes_say(rng):
    """A narrow field's errors scatter by their sigmas, and hang together as predicted."""
    truth = random_attitude(rng)
    body = field_of_stars(rng, [1.0, 0.0, 0.0], 4.0, 5)
    errors = []
    for _ in range(2000):
        noisy = body + rng.normal(size=body.shape) * 2.0 / 206264.806
        noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
        solution = solved(noisy, body @ truth, 2.0)
        errors.append(attitude_error_arcsec(matrix_from_quaternion(solution.quaternion), truth))
    predicted = solved(body, body @ truth, 2.0).covariance_arcsec2
    scatter = np.cov(np.array(errors).T)
    scale = np.sqrt(np.outer(np.diag(predicted), np.diag(predicted)))
    assert scatter / scale == pytest.approx(predicted / scale, abs=0.15)
