"""Predictions of an attitude, against scipy's rotations and simulated random walks."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.attitude.prediction import (
    Known,
    derived_rate,
    given_rate,
    predict_at_rate,
    predict_by_gyro,
    unknown_rate,
)
from service.gyro.samples import GyroModel, GyroSamples
from tests.features.definitive.simulated import slews, truth_of

MODEL = GyroModel(1e-6, 1e-9, bias_sigma_rad_s=1e-6)


def known_of(truth, k, covariance=None):
    covariance = np.diag([1e-10, 1e-10, 4e-10]) if covariance is None else covariance
    return Known(int(truth.tai_ns[k]), truth.attitude[k].as_quat(), covariance)


def angle_between(quaternion, attitude):
    return (Rotation.from_quat(quaternion).inv() * attitude).magnitude()


def test_gyro_samples_carry_an_attitude_through_a_slew():
    truth = truth_of(slews, 1700.0)
    samples = GyroSamples(truth.tai_ns, truth.rate_rad_s)
    for first, last in ((0, 1700), (1200, 1500), (1230, 1231)):
        predicted = predict_by_gyro(
            known_of(truth, first), int(truth.tai_ns[last]), MODEL, samples, 1e-6
        )
        # Rates that change within a sample leave less than an arcsecond.
        assert angle_between(predicted.quaternion, truth.attitude[last]) < 5e-6
        assert (np.linalg.eigvalsh(predicted.covariance_rad2) > 1e-10).all()
    # Between two samples, from one moment to another.
    known = known_of(truth, 1300)
    half = predict_by_gyro(known, int(truth.tai_ns[1300]) + 500_000_000, MODEL, samples, 1e-6)
    whole = predict_by_gyro(half, int(truth.tai_ns[1301]), MODEL, samples, 1e-6)
    assert angle_between(whole.quaternion, truth.attitude[1301]) < 5e-6


def test_the_covariance_turns_with_the_body():
    turn = given_rate([np.array([0.0, 0.0, math.pi / 200.0])], 0.0, 100.0)
    known = Known(0, np.array([0.0, 0.0, 0.0, 1.0]), np.diag([1e-8, 4e-8, 9e-8]))
    predicted = predict_at_rate(known, 100 * 10**9, turn, 0.0)
    assert predicted.quaternion == pytest.approx([0, 0, math.sqrt(0.5), math.sqrt(0.5)])
    # After a quarter of a turn about Z the axis X points where Y did.
    assert predicted.covariance_rad2 == pytest.approx(np.diag([4e-8, 1e-8, 9e-8]), abs=1e-20)


@pytest.mark.parametrize("missing", [slice(500, 600), slice(0, 500), slice(1400, 1701)])
def test_a_gap_of_the_gyro_predicts_nothing(missing):
    truth = truth_of(slews, 1700.0)
    kept = np.ones(1701, bool)
    kept[missing] = False
    samples = GyroSamples(truth.tai_ns[kept], truth.rate_rad_s[kept])
    known = known_of(truth, 100)
    assert predict_by_gyro(known, int(truth.tai_ns[1500]), MODEL, samples, 1e-6) is None


def test_the_walk_of_a_rate_gives_the_variances_that_are_stated(rng):
    """Of many walks: the angle less what is predicted of it, about one axis."""
    q, h, passed, step, walks = 1e-4, 40.0, 30.0, 0.1, 4000
    before, after = round(h / step), round(passed / step)
    rate = np.cumsum(rng.normal(0.0, q * math.sqrt(step), (walks, before + after)), axis=1)
    angle = np.hstack([np.zeros((walks, 1)), np.cumsum(rate, axis=1) * step])
    start = angle[:, before]
    end = angle[:, -1] - start
    mean = start / h
    first, last = rate[:, before - 1], rate[:, -1]
    known, earlier = (
        Known(int(s * 1e9), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros((3, 3))) for s in (h, 0.0)
    )
    rates = [np.zeros(3)]
    for error, stated in (
        (end - mean * passed, derived_rate(earlier, known, passed)),
        (end - first * passed, given_rate(rates, 0.0, passed)),
        (end - 0.5 * (first + last) * passed, given_rate(rates * 2, 0.0, passed)),
        (end - first * passed, unknown_rate(0.0, passed)),
    ):
        assert np.var(error) == pytest.approx(q**2 * stated.walk_s3, rel=0.1)
