"""The smoother, held against a batch solution of GTSAM."""

import gtsam
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.smoother import smooth
from service.gyro.samples import GyroModel
from tests.features.definitive.simulated import attitudes_of, gyro_of, slews, truth_of
from tests.features.definitive.test_filter import CASES


def batch_solution(model, gyro, attitudes, rows, guess):
    """The attitudes and biases of GTSAM, with their covariances."""
    from gtsam.symbol_shorthand import B, X

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    params = gtsam.PreintegratedRotationParams()
    # What the bias walks within a step adds to the angle, at steps of one second.
    density = model.sigma_v_rad_s0_5**2 + model.sigma_u_rad_s1_5**2 / 3.0
    params.setGyroscopeCovariance(np.eye(3) * density)
    walk = gtsam.noiseModel.Isotropic.Sigma(3, model.sigma_u_rad_s1_5)
    first = gtsam.noiseModel.Isotropic.Sigma(3, model.bias_sigma_rad_s)
    for k, attitude in enumerate(guess.quaternion):
        values.insert(X(k), rot3(attitude))
        values.insert(B(k), guess.bias_rad_s[k])
    for k in range(1, len(guess.quaternion)):
        step = gtsam.PreintegratedAhrsMeasurements(params, guess.bias_rad_s[k - 1])
        step.integrateMeasurement(gyro.rate_rad_s[k], 1.0)
        graph.add(gtsam.AHRSFactor(X(k - 1), X(k), B(k - 1), step))
        graph.add(gtsam.BetweenFactorVector(B(k - 1), B(k), np.zeros(3), walk))
    graph.add(gtsam.PriorFactorVector(B(0), np.zeros(3), first))
    for row, q, covariance in zip(
        rows, attitudes.quaternion, attitudes.covariance_rad2, strict=True
    ):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.PriorFactorRot3(X(int(row)), rot3(q), noise))
    solved = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return solved, gtsam.Marginals(graph, solved), X, B


def rot3(quaternion):
    """GTSAM's rotations take body vectors to inertial ones, as scipy's do."""
    return gtsam.Rot3(Rotation.from_quat(quaternion).as_matrix())


@pytest.mark.parametrize("case", CASES)
def test_states_are_within_a_twentieth_of_a_sigma_and_sigmas_within_a_thousandth(case, rng):
    given, every, sigmas, _ = CASES[case]
    model = GyroModel(given.sigma_v_rad_s0_5, given.sigma_u_rad_s1_5, 5e-6)
    truth = truth_of(lambda t: slews(t + 1000.0), 600.0)
    gyro, _ = gyro_of(truth, model, rng)
    rows = np.setdiff1d(np.arange(0, 601, every), np.arange(200, 400))
    attitudes = attitudes_of(truth, rows, sigmas, rng)
    result = filter_attitude(model, gyro, attitudes)
    # A single rejected measurement would be missing in one of both solutions.
    used = result.innovations.row[result.innovations.outcome % 2 == 1]
    taken = type(attitudes)(*(value[used] for value in vars(attitudes).values()))
    smoothed = smooth(result, model)
    solved, marginals, X, B = batch_solution(model, gyro, taken, rows[used], smoothed)
    for k in range(0, 601, 20):
        attitude = Rotation.from_matrix(solved.atRot3(X(k)).matrix())
        theta = (Rotation.from_quat(smoothed.quaternion[k]).inv() * attitude).as_rotvec()
        apart = np.concatenate([theta, solved.atVector(B(k)) - smoothed.bias_rad_s[k]])
        blocks = [marginals.marginalCovariance(key(k)) for key in (X, B)]
        expected = np.sqrt(np.concatenate([np.diag(block) for block in blocks]))
        np.testing.assert_allclose(np.sqrt(np.diag(smoothed.covariance[k])), expected, rtol=1e-3)
        assert np.abs(apart / expected).max() < 0.05
