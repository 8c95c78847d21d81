"""The smoother, held against least squares over all epochs at once."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.attitude.definitive import Status
from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.inputs import ConstantRateModel, FilterSettings
from service.features.definitive.kernels.result import joined
from service.features.definitive.kernels.smoother import smooth
from service.gyro.samples import GyroModel, GyroSamples
from tests.chance import assert_chi_square
from tests.features.definitive.simulated import (
    ARCSEC,
    attitude_errors,
    attitudes_of,
    gyro_of,
    inertial_hold,
    nees,
    orbital_rate,
    slews,
    truth_of,
)
from tests.features.definitive.test_filter import FINE, assert_same_bytes, part_of
from tests.features.definitive.test_propagation import integrated, system


def step_noise(rate, dt, model):
    """The process noise of a step, by Van Loan's exponential."""
    v, u = model.sigma_v_rad_s0_5**2, model.sigma_u_rad_s1_5**2
    return integrated(system(rate), np.diag([v, v, v, u, u, u]), dt)


class Batch:
    """Attitudes and biases of n epochs by Gauss-Newton over all of them, dense.

    Residuals are in sigmas, their derivatives are differences: nothing of the filter is used.
    """

    def __init__(self, model, gyro, attitudes, rows):
        self.model, self.gyro, self.rows = model, gyro, rows
        self.n = len(gyro.tai_ns)
        self.measured = Rotation.from_quat(attitudes.quaternion)
        self.white = np.linalg.inv(np.linalg.cholesky(attitudes.covariance_rad2))
        self.dt = np.diff(gyro.tai_ns) * 1e-9
        self.step_white = np.array(
            [
                np.linalg.inv(np.linalg.cholesky(step_noise(rate, dt, model)))
                for rate, dt in zip(gyro.rate_rad_s[1:], self.dt, strict=True)
            ]
        )

    def residuals(self, attitude, bias):
        """Those of the first bias, of the steps and of the measurements, in sigmas."""
        turn = (self.gyro.rate_rad_s[1:] - bias[:-1]) * self.dt[:, None]
        predicted = attitude[:-1] * Rotation.from_rotvec(turn)
        steps = np.hstack([(predicted.inv() * attitude[1:]).as_rotvec(), np.diff(bias, axis=0)])
        seen = (attitude[self.rows].inv() * self.measured).as_rotvec()
        return np.concatenate(
            [
                bias[0] / self.model.bias_sigma_rad_s,
                np.einsum("nij,nj->ni", self.step_white, steps).ravel(),
                np.einsum("nij,nj->ni", self.white, seen).ravel(),
            ]
        )

    def solved(self, attitude, bias):
        """Attitude, bias and covariance (6 n, 6 n), from a first guess."""
        # A variable is of the size of its sigma, so that differences and factors are sound.
        sizes = np.tile([1e-5] * 3 + [1e-8] * 3, self.n)
        for _ in range(3):
            here = self.residuals(attitude, bias)
            columns = []
            for i in range(6 * self.n):
                x = np.zeros(6 * self.n)
                x[i] = 0.5 * sizes[i]
                more, less = (self.residuals(*self.moved(attitude, bias, s * x)) for s in (1, -1))
                columns.append(more - less)
            jacobian = np.array(columns).T
            step = np.linalg.lstsq(jacobian, -here, rcond=None)[0] * sizes
            attitude, bias = self.moved(attitude, bias, step)
        covariance = np.linalg.inv(jacobian.T @ jacobian) * np.outer(sizes, sizes)
        return attitude, bias, covariance

    def moved(self, attitude, bias, x):
        parts = x.reshape(self.n, 6)
        return attitude * Rotation.from_rotvec(parts[:, :3]), bias + parts[:, 3:]


@pytest.mark.parametrize("rate", [orbital_rate, slews])
def test_it_is_the_least_squares_solution_of_all_measurements(rate, rng):
    """States are within .05 sigma, sigmas within .1 %; there is a gap of ten epochs."""
    model = GyroModel(FINE.sigma_v_rad_s0_5, FINE.sigma_u_rad_s1_5, 2e-6)
    truth = truth_of(lambda t: rate(t + 1190.0), 26.0)
    gyro, _ = gyro_of(truth, model, rng)
    rows = np.array([0, 1, 2, 3, 6, 7, 8, 9, 19, 20, 22, 25])
    attitudes = attitudes_of(truth, rows, (6.0, 9.0, 40.0), rng)
    smoothed = smooth(filter_attitude(model, gyro, attitudes), model)
    batch = Batch(model, gyro, attitudes, rows)
    attitude, bias, covariance = batch.solved(truth.attitude, np.zeros((27, 3)))
    blocks = [covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(27)]
    sigmas = np.sqrt(np.array([np.diag(block) for block in blocks]))
    found = np.sqrt(np.diagonal(smoothed.covariance, axis1=1, axis2=2))
    np.testing.assert_allclose(found, sigmas, rtol=1e-3)
    apart = (Rotation.from_quat(smoothed.quaternion).inv() * attitude).as_rotvec()
    both = np.hstack([apart, bias - smoothed.bias_rad_s])
    assert np.abs(both / sigmas).max() < 0.05


def test_it_roughly_halves_the_covariance_of_the_filter(rng):
    model = GyroModel(FINE.sigma_v_rad_s0_5, FINE.sigma_u_rad_s1_5, 5e-8)
    truth = truth_of(orbital_rate, 3600.0)
    rows, middle = np.arange(0, 3601, 8), slice(900, 2700)
    ratios, of_filter, of_smoother, squared = [], [], [], []
    for _ in range(12):
        gyro, bias = gyro_of(truth, model, rng)
        result = filter_attitude(model, gyro, attitudes_of(truth, rows, (20.0, 20.0, 25.0), rng))
        smoothed = smooth(result, model)
        filtered, after = (
            np.diagonal(each.covariance, axis1=1, axis2=2)[middle, :3]
            for each in (result.history, smoothed)
        )
        # While the filter doubts, its covariance holds both attitudes.
        ratios.append((after / filtered)[result.history.good[middle]])
        of_filter.append(attitude_errors(result.history, truth)[middle])
        of_smoother.append(attitude_errors(smoothed, truth)[middle])
        squared.append(nees(smoothed, truth, bias))
    assert np.concatenate(ratios).min() > 0.2
    assert np.concatenate(ratios).max() < 0.6
    assert np.std(of_smoother) < 0.75 * np.std(of_filter)
    # The bias hardly changes in a pass: passes are independent, epochs are not.
    for epoch in (900, 1800, 2700):
        assert_chi_square([each[epoch] for each in squared], 6)


def test_a_gap_is_bridged_from_both_sides(rng):
    truth = truth_of(orbital_rate, 4800.0)
    rows = np.concatenate([np.arange(0, 2100, 8), np.arange(2700, 4801, 8)])
    gyro, _ = gyro_of(truth, FINE, rng)
    result = filter_attitude(FINE, gyro, attitudes_of(truth, rows, (20.0, 20.0, 25.0), rng))
    smoothed = smooth(result, FINE)
    filtered_sigma, smoothed_sigma = (
        np.sqrt(np.diagonal(each.covariance[2699])[:3]) / ARCSEC
        for each in (result.history, smoothed)
    )
    assert (filtered_sigma > 4.0).all()
    assert (smoothed_sigma < 2.6).all()
    assert np.abs(attitude_errors(smoothed, truth)[2100:2700] / ARCSEC).max() < 12.0


def test_the_last_epoch_is_the_filter_s(rng):
    truth = truth_of(orbital_rate, 300.0)
    gyro, _ = gyro_of(truth, FINE, rng)
    result = filter_attitude(FINE, gyro, attitudes_of(truth, np.arange(301), (6.0, 6.0, 40.0), rng))
    smoothed = smooth(result, FINE)
    np.testing.assert_array_equal(smoothed.quaternion[-1], result.history.quaternion[-1])
    np.testing.assert_array_equal(smoothed.covariance[-1], result.history.covariance[-1])


def test_a_stretch_that_was_filtered_in_parts_is_smoothed_as_one(rng):
    truth = truth_of(slews, 1500.0)
    gyro, _ = gyro_of(truth, FINE, rng)
    attitudes = attitudes_of(truth, np.arange(0, 1501, 4), (6.0, 6.0, 40.0), rng)
    whole = filter_attitude(FINE, gyro, attitudes)
    results, state = [], None
    for begin, end in ((-1, 500), (500, 501), (501, 1500)):
        begin_ns = truth.tai_ns[begin] if begin >= 0 else 0
        given = [part_of(each, begin_ns, truth.tai_ns[end]) for each in (gyro, attitudes)]
        results.append(filter_attitude(FINE, *given, state=state))
        state = results[-1].state
    assert_same_bytes(smooth(whole, FINE), smooth(joined(results), FINE))


def test_it_does_not_go_across_a_new_start(rng):
    """A gap of the gyro of an hour: nothing is known between, and the sides stay apart."""
    truth = truth_of(orbital_rate, 5400.0)
    gyro, _ = gyro_of(truth, FINE, rng)
    keep = np.concatenate([np.arange(900), np.arange(4500, 5401)])
    rows = keep[::4]
    attitudes = attitudes_of(truth, rows, (6.0, 6.0, 40.0), rng)
    samples = GyroSamples(gyro.tai_ns[keep], gyro.rate_rad_s[keep])
    result = filter_attitude(FINE, samples, attitudes)
    assert result.starts == 2
    alone = part_of(samples, 0, truth.tai_ns[899]), part_of(attitudes, 0, truth.tai_ns[899])
    before = smooth(filter_attitude(FINE, *alone), FINE)
    both = smooth(result, FINE)
    np.testing.assert_array_equal(both.quaternion[:900], before.quaternion)
    assert (both.status[900:] == Status.GOOD).all()


def test_a_start_is_confirmed_by_what_follows(rng):
    truth = truth_of(inertial_hold, 120.0)
    gyro, _ = gyro_of(truth, FINE, rng)
    attitudes = attitudes_of(truth, np.arange(10, 121, 8), (6.0, 6.0, 40.0), rng)
    # By the usual gates chance rejects one of the first in some hundred draws.
    none_rejected = FilterSettings(gate_tail=1e-9, start_gate_tail=1e-9)
    result = filter_attitude(FINE, gyro, attitudes, settings=none_rejected)
    smoothed = smooth(result, FINE)
    assert (result.history.status[:10] == Status.NONE).all()
    assert (result.history.status[10:26] == Status.STARTING).all()
    assert (smoothed.status[:10] == Status.NONE).all()
    assert np.isnan(smoothed.quaternion[:10]).all()
    assert (smoothed.status[10:] == Status.GOOD).all()


def test_without_a_gyro_the_rate_is_smoothed_too(rng):
    truth = truth_of(orbital_rate, 1200.0)
    rows = np.arange(0, 1201, 10)
    model = ConstantRateModel(1e-8)
    attitudes = attitudes_of(truth, rows, (6.0, 6.0, 40.0), rng)
    result = filter_attitude(model, attitudes=attitudes)
    smoothed = smooth(result, model)
    off = np.abs(smoothed.rate_rad_s - truth.rate_rad_s[1]).max()
    assert off < 1e-6
    errors = attitude_errors(smoothed, truth, rows) / ARCSEC
    assert np.std(errors[:, :2]) < np.std(
        attitude_errors(result.history, truth, rows)[:, :2] / ARCSEC
    )
