"""The step of the filter, held against matrix exponentials and numerical integrals."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from service.attitude.quaternions import rotation_between, turn
from service.features.definitive.kernels.filter import noise_of
from service.features.definitive.kernels.propagation import (
    bias_shift,
    predict,
    transition,
    workspace,
)
from service.gyro.samples import GyroModel
from service.vectors import matrix_from_quaternion

NO_SHIFT = np.zeros(3)
RATES = [
    np.zeros(3),
    np.array([1e-6, -2e-6, 3e-6]),
    np.array([0.0, -1.16e-3, 0.0]),
    np.array([0.03, 0.01, -0.02]),
    np.array([0.9, -1.7, 0.4]),
]


def cross(v):
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def system(rate):
    """The matrix of d(theta, b)/dt."""
    matrix = np.zeros((6, 6))
    matrix[:3, :3], matrix[:3, 3:] = -cross(rate), -np.eye(3)
    return matrix


def integrated(matrix, densities, dt):
    """The noise of white densities over a step of a system, by Van Loan's exponential (1978)."""
    n = len(matrix)
    exponential = expm(np.block([[-matrix, densities], [np.zeros((n, n)), matrix.T]]) * dt)
    return exponential[n:, n:].T @ exponential[:n, n:]


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("dt", [0.01, 1.0, 8.0])
def test_the_transition_is_the_exponential_of_the_system(rate, dt):
    work = workspace()
    transition(rate, dt, work)
    np.testing.assert_allclose(work.phi, expm(system(rate) * dt), rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("dt", [0.01, 1.0, 8.0])
def test_the_process_noise_is_the_integral_over_the_step(rate, dt):
    """Densities of one make rounding visible in each block."""
    noise, work, found = noise_of(GyroModel(1.0, 1.0)), workspace(), np.zeros((6, 6))
    predict(found, rate, dt, -1.0, NO_SHIFT, noise, work)
    expected = integrated(system(rate), np.eye(6), dt)
    np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12 * dt)


def test_both_forms_of_the_coefficients_agree_where_one_takes_over():
    for dt in (0.1 - 1e-9, 0.1 + 1e-9):
        work, rate = workspace(), np.array([0.6, 0.0, -0.8])
        transition(rate, dt, work)
        np.testing.assert_allclose(work.phi, expm(system(rate) * dt), rtol=1e-13, atol=1e-15)


def test_a_turn_is_that_of_the_body_axes(rng):
    q, theta, out = Rotation.random(random_state=1).as_quat(), rng.normal(size=3), np.empty(4)
    turn(q, theta, out)
    expected = expm(-cross(theta)) @ matrix_from_quaternion(q)
    np.testing.assert_allclose(matrix_from_quaternion(out), expected, atol=1e-14)


@pytest.mark.parametrize("size", [0.0, 1e-12, 1e-6, 1.0, 3.1])
def test_the_rotation_between_two_attitudes_is_the_turn_that_led_from_one_to_the_other(size, rng):
    theta, found, to = rng.normal(size=3), np.empty(3), np.empty(4)
    theta *= size / np.linalg.norm(theta)
    for q in Rotation.random(20, random_state=2).as_quat():
        turn(q, theta, to)
        rotation_between(q, to, found)
        np.testing.assert_allclose(found, theta, rtol=1e-9, atol=1e-15)


def test_a_gap_makes_the_attitude_uncertain_along_the_turn_most():
    noise, work, found = noise_of(GyroModel(1e-6, 1e-9)), workspace(), np.zeros((6, 6))
    rate = np.array([0.0, -1e-3, 0.0])
    predict(found, rate, 60.0, 0.0, NO_SHIFT, noise, work)
    walk = 1e-8 * 60.0**3 / 3.0
    np.testing.assert_allclose(np.diag(found)[:3], [walk, walk + 1e-6, walk], rtol=1e-3)


def test_a_turn_in_small_steps_widens_the_bias_as_one_in_a_single_step():
    noise = noise_of(GyroModel(1e-7, 0.0, scale=1e-4, misalignment_rad=1e-5))
    final = np.array([2e-3, 0.0, 0.0])
    for steps in (1, 10, 100):
        anchor, total, shift = np.zeros(3), np.zeros(3), np.zeros(3)
        for k in range(steps):
            bias_shift(anchor, final * (k + 1) / steps, 1.0, noise, shift)
            total += shift
        np.testing.assert_allclose(np.sqrt(total), [2e-7, 2e-8, 2e-8], rtol=0.01)


def test_the_noise_of_a_gyro_is_no_change_of_its_rate(rng):
    noise = noise_of(GyroModel(1e-6, 0.0, scale=1e-3))
    anchor, shift = np.full(3, 1e-3), np.zeros(3)
    for _ in range(1_000):
        bias_shift(anchor, 1e-3 + rng.normal(0.0, 1e-6, 3), 1.0, noise, shift)
        assert not shift.any()
