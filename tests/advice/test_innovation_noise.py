"""Noise from innovations: a filter that assumes other noise than there is, found out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.advice.innovations import LEAST, innovation_noise
from service.filtering.filter import filter_attitude
from service.filtering.gyro import GyroModel
from service.filtering.samples import AttitudeMeasurements
from service.filtering.smoother import smooth
from service.grades.innovations import innovations_of
from tests.filtering.simulated import attitudes_of, gyro_of, slews, truth_of

TRUE = GyroModel(10**0.5 * 1e-6, 10**0.5 * 1e-10)
HOURS = 6


def found_with(gyro_factor, attitude_factor, sigmas=(6.0, 6.0, 40.0), seed=3):
    """The noise that a filter's innovations show whose sigmas are so many times the true ones."""
    rng = np.random.default_rng(seed)
    seconds = HOURS * 3600
    truth = truth_of(slews, float(seconds))
    gyro, _ = gyro_of(truth, TRUE, rng)
    attitudes = attitudes_of(truth, np.arange(0, seconds + 1, 8), sigmas, rng)
    assumed = GyroModel(TRUE.sigma_v_rad_s0_5 * gyro_factor, TRUE.sigma_u_rad_s1_5)
    believed = AttitudeMeasurements(
        attitudes.tai_ns, attitudes.quaternion, attitudes.covariance_rad2 * attitude_factor**2
    )
    result = filter_attitude(assumed, gyro, believed)
    part = innovations_of(believed, result, smooth(result, assumed), 0, 1 << 62)
    return innovation_noise([part]), part


@pytest.mark.parametrize(
    ("gyro_factor", "attitude_factor"),
    [(1.0, 1.0), (0.5, 1.0), (2.0, 1.0), (1.0, 0.7), (1.0, 1.5), (0.5, 1.5)],
)
def test_both_ratios_are_found_whichever_is_wrong(gyro_factor, attitude_factor):
    noise, _ = found_with(gyro_factor, attitude_factor)
    assert noise.gyro.value * gyro_factor == pytest.approx(1.0, rel=0.12)
    assert noise.attitudes.value * attitude_factor == pytest.approx(1.0, rel=0.05)
    for found, factor in ((noise.gyro, gyro_factor), (noise.attitudes, attitude_factor)):
        # The interval is one of 95 %, its half is widened for the one seed in twenty.
        middle, half = (found.low + found.high) / 2, (found.high - found.low) / 2
        assert abs(1.0 / factor - middle) < 1.7 * half


def test_a_gyro_believed_too_good_is_found_though_chi_square_is_as_it_should_be():
    noise, part = found_with(0.5, 1.0)
    used = np.isfinite(part.nis)
    assert 0.9 < part.nis[used].mean() / 3.0 < 1.3
    assert noise.gyro.low > 1.5


def test_too_few_measurements_say_nothing():
    _, part = found_with(1.0, 1.0)
    assert innovation_noise([]) is None
    assert innovation_noise([part.taken(slice(0, LEAST))]) is None


def test_gaps_and_rejected_attitudes_do_not_count_as_noise():
    _, part = found_with(1.0, 1.0)
    kept = np.ones(len(part), bool)
    kept[1000:1200] = False
    outcome = part.outcome.copy()
    outcome[::50] = 2
    innovation = part.innovation_arcsec.copy()
    innovation[::50] += 300.0
    bent = replace(part, outcome=outcome, innovation_arcsec=innovation).taken(kept)
    # Pieces of 49 measurements: of the axis about the boresight too short to settle.
    assert innovation_noise([bent]) is None
    outcome[::50] = np.where(np.arange(len(outcome[::50])) % 10 == 0, 2, 1)
    innovation = np.where((outcome == 2)[:, None], innovation, part.innovation_arcsec)
    noise = innovation_noise(
        [replace(part, outcome=outcome, innovation_arcsec=innovation).taken(kept)]
    )
    assert noise.gyro.value == pytest.approx(1.0, rel=0.15)
    assert noise.attitudes.value == pytest.approx(1.0, rel=0.05)


def test_a_boresight_between_the_body_axes_is_no_matter():
    rng = np.random.default_rng(8)
    seconds = HOURS * 3600
    truth = truth_of(slews, float(seconds))
    gyro, _ = gyro_of(truth, TRUE, rng)
    plain = attitudes_of(truth, np.arange(0, seconds + 1, 8), (6.0, 6.0, 40.0), rng)
    turn = Rotation.from_euler("xyz", [40.0, 30.0, 20.0], degrees=True).as_matrix()
    # The same errors about other axes: A_measured = exp(-[turn theta x]) A_true.
    own = Rotation.from_quat(plain.quaternion)
    error = (own.inv() * truth.attitude[np.arange(0, seconds + 1, 8)]).as_rotvec()
    bent = truth.attitude[np.arange(0, seconds + 1, 8)] * Rotation.from_rotvec(-error @ turn.T)
    attitudes = AttitudeMeasurements(
        plain.tai_ns, bent.as_quat(), turn @ plain.covariance_rad2 @ turn.T
    )
    result = filter_attitude(TRUE, gyro, attitudes)
    part = innovations_of(attitudes, result, smooth(result, TRUE), 0, 1 << 62)
    noise = innovation_noise([part])
    assert noise.gyro.value == pytest.approx(1.0, rel=0.12)
    assert noise.attitudes.value == pytest.approx(1.0, rel=0.05)
