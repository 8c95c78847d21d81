"""What is refused, and that the message names field, row and value."""

import numpy as np
import pytest

from service.errors import BadInput
from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.inputs import (
    AttitudeMeasurements,
    ConstantRateModel,
    DirectionMeasurements,
    FilterSettings,
)
from service.features.definitive.kernels.result import joined
from service.gyro.samples import GyroModel, GyroSamples

TIMES = np.arange(4, dtype=np.int64) * 10**9
RATES = np.zeros((4, 3))
QUATERNIONS = np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
COVARIANCES = np.tile(np.eye(3) * 1e-9, (4, 1, 1))
AXES = np.tile([0.0, 0.0, 1.0], (4, 1))
SIGMAS = np.full(4, 1e-5)
MODEL = GyroModel(1e-7, 1e-10)


def changed(array, place, value):
    copy = array.copy()
    copy[place] = value
    return copy


@pytest.mark.parametrize(
    ("times", "rates", "said"),
    [
        (TIMES, changed(RATES, (2, 1), np.nan), "gyro.rate_rad_s[2]: must be finite numbers"),
        (TIMES, changed(RATES, (1, 0), np.inf), "gyro.rate_rad_s[1]: must be finite numbers"),
        (TIMES, RATES[:, :2], "gyro.rate_rad_s: must have the shape (4, 3) (got (4, 2))"),
        (TIMES, "much", "gyro.rate_rad_s"),
        (TIMES[::-1], RATES, "gyro.tai_ns[1]: must be later than the one before; 3 rows in all"),
        (changed(TIMES, 2, TIMES[1]), RATES, "gyro.tai_ns[2]: must be later than the one before"),
        (TIMES.astype(float), RATES, "gyro.tai_ns: must be whole nanoseconds"),
        (TIMES[None], RATES, "gyro.tai_ns: must be whole nanoseconds"),
    ],
)
def test_gyro_samples_that_are_none_are_refused(times, rates, said):
    with pytest.raises(BadInput) as refused:
        GyroSamples(times, rates)
    assert said in str(refused.value)


def test_rates_in_the_wrong_unit_are_refused():
    with pytest.raises(BadInput) as refused:
        filter_attitude(MODEL, GyroSamples(TIMES, changed(RATES, 3, 100.0)))
    assert "gyro.rate_rad_s[3]: must be at most 0.174533 rad/s in each axis" in str(refused.value)
    assert "got [100.0, 100.0, 100.0]" in str(refused.value)


@pytest.mark.parametrize(
    ("field", "place", "value", "said"),
    [
        ("quaternion", (1, 2), np.nan, "attitudes.quaternion[1]: must be finite numbers"),
        ("quaternion", (1, 3), 2.0, "attitudes.quaternion[1]: must have length 1"),
        ("covariance_rad2", (0, 0, 1), 1e-9, "attitudes.covariance_rad2[0]: must be symmetric"),
        ("covariance_rad2", (2, 1, 1), 0.0, "covariance_rad2[2]: must be positive definite"),
        ("covariance_rad2", (2, 1, 1), 4.0, "covariance_rad2[2]: must be at most 1 rad2"),
        ("tai_ns", 1, 10**12, "attitudes.tai_ns[2]: must be no earlier than the one before"),
    ],
)
def test_attitudes_that_are_none_are_refused(field, place, value, said):
    given = {"tai_ns": TIMES, "quaternion": QUATERNIONS, "covariance_rad2": COVARIANCES}
    with pytest.raises(BadInput) as refused:
        AttitudeMeasurements(**given | {field: changed(given[field], place, value)})
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("field", "place", "value", "said"),
    [
        ("body", (1, 2), 1.1, "directions.body[1]: must have length 1"),
        ("inertial", (0, 0), np.nan, "directions.inertial[0]: must be finite numbers"),
        ("sigma_rad", 3, 0.0, "directions.sigma_rad[3]: must be more than 0 and at most 1 rad"),
        ("sigma_rad", 3, 20.0, "directions.sigma_rad[3]: must be more than 0 and at most 1 rad"),
    ],
)
def test_directions_that_are_none_are_refused(field, place, value, said):
    given = {"tai_ns": TIMES, "body": AXES, "inertial": AXES, "sigma_rad": SIGMAS}
    with pytest.raises(BadInput) as refused:
        DirectionMeasurements(**given | {field: changed(given[field], place, value)})
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("kind", "given", "said"),
    [
        (GyroModel, {"sigma_v_rad_s0_5": -1.0, "sigma_u_rad_s1_5": 0.0}, "sigma_v_rad_s0_5"),
        (GyroModel, {"sigma_v_rad_s0_5": 0.0, "sigma_u_rad_s1_5": float("nan")}, "sigma_u"),
        (
            GyroModel,
            {"sigma_v_rad_s0_5": 0.0, "sigma_u_rad_s1_5": 0.0, "largest_step_s": 0.0},
            "largest_step_s",
        ),
        (FilterSettings, {"gate_tail": 0.0}, "filter.gate_tail"),
        (FilterSettings, {"confirmations": 0}, "filter.confirmations"),
        (FilterSettings, {"reset_after_s": float("inf")}, "filter.reset_after_s"),
    ],
)
def test_models_and_settings_that_make_no_sense_are_refused(kind, given, said):
    with pytest.raises(BadInput) as refused:
        kind(**given)
    assert said in str(refused.value)


def test_what_is_earlier_than_the_state_is_refused():
    attitudes = AttitudeMeasurements(TIMES, QUATERNIONS, COVARIANCES)
    state = filter_attitude(MODEL, GyroSamples(TIMES, RATES), attitudes).state
    with pytest.raises(BadInput) as refused:
        filter_attitude(MODEL, GyroSamples(TIMES, RATES), state=state)
    assert "gyro.tai_ns[0]: must be after 3000000000 (got 0)" in str(refused.value)
    later = GyroSamples(TIMES + 4 * 10**9, RATES)
    with pytest.raises(BadInput) as refused:
        filter_attitude(MODEL, later, attitudes, state=state)
    assert "attitudes.tai_ns[0]: must be no earlier than the state" in str(refused.value)


def test_a_stretch_needs_a_gyro_or_a_constant_rate_and_one_sample():
    attitudes = AttitudeMeasurements(TIMES, QUATERNIONS, COVARIANCES)
    empty = GyroSamples(TIMES[:0], RATES[:0])
    for given in (
        (MODEL, None, attitudes),
        (MODEL, empty, attitudes),
        (ConstantRateModel(1e-9), GyroSamples(TIMES + 1, RATES), attitudes),
        (ConstantRateModel(1e-9), None, None),
    ):
        with pytest.raises(BadInput, match="gyro"):
            filter_attitude(*given)


def test_results_that_do_not_follow_one_another_are_not_joined():
    parts = [filter_attitude(MODEL, GyroSamples(TIMES + begin, RATES)) for begin in (4 * 10**9, 0)]
    with pytest.raises(BadInput, match="in order"):
        joined(parts)
    with pytest.raises(BadInput, match="at least one"):
        joined([])
