"""Noise from innovations: a filter that assumes other noise than there is, found out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from service.features.advice.innovations import (
    LEAST,
    InnovationNoise,
    innovation_findings,
    innovation_noise,
)
from service.features.advice.trackers import NoiseFinding
from service.features.definitive.day import innovations_of
from service.features.definitive.kernels.filter import filter_attitude
from service.features.definitive.kernels.inputs import AttitudeMeasurements
from service.features.definitive.kernels.smoother import smooth
from service.gyro.samples import GyroModel
from service.intervals import Interval
from tests.features.definitive.passes import GYRO, mission_with
from tests.features.definitive.simulated import attitudes_of, gyro_of, slews, truth_of
from tests.missions.without_gyro import mission_without_gyro

TRUE = GyroModel(10**0.5 * 1e-6, 10**0.5 * 1e-10)
HOURS = 6
FITTING = Interval(1.0, 0.95, 1.05)


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
    [(1.0, 1.0), (0.5, 1.0), (2.0, 1.0), (1.0, 0.8), (1.0, 1.5), (0.5, 1.5)],
)
def test_both_ratios_are_found_whichever_is_wrong(gyro_factor, attitude_factor):
    noise, _ = found_with(gyro_factor, attitude_factor)
    assert noise.gyro.value * gyro_factor == pytest.approx(1.0, rel=0.2)
    assert noise.attitudes.value * attitude_factor == pytest.approx(1.0, rel=0.05)
    for found, factor in ((noise.gyro, gyro_factor), (noise.attitudes, attitude_factor)):
        # The interval is one of 95 %; it is widened for the one seed in twenty.
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


@pytest.fixture
def xte(missions):
    return mission_with(missions["XTE"], gyro=GYRO)


def said(xte, gyro, attitudes=FITTING, trackers=()):
    return innovation_findings(InnovationNoise(gyro, attitudes, 2700), xte, trackers)


def test_a_noisier_gyro_gets_a_line_for_the_mission_file(xte):
    gyro, _ = said(xte, Interval(2.0, 1.8, 2.2))
    assert gyro.statement.action == "correct"
    (change,) = gyro.statement.changes
    assert change.table == "gyro"
    assert change.line.split(" #")[0].strip() == "sigma_v_rad_s0_5 = 6.32e-07"
    assert "2.00 (1.80 to 2.20) times" in gyro.statement.text


@pytest.mark.parametrize(
    ("ratio", "action"),
    [
        (Interval(1.1, 0.9, 1.3), "keep"),
        (Interval(0.9, 0.88, 0.93), "keep"),
        (Interval(0.5, 0.0, 0.9), "wait"),
        (Interval(0.5, 0.45, 0.55), "correct"),
    ],
)
def test_a_ratio_that_holds_one_or_is_uncertain_changes_nothing(xte, ratio, action):
    gyro, _ = said(xte, ratio)
    assert gyro.statement.action == action
    assert bool(gyro.statement.changes) == (action == "correct")


def test_attitudes_that_are_worse_than_said_point_to_the_trackers(xte):
    worse = Interval(1.5, 1.45, 1.55)
    unknown = NoiseFinding("STARTRACKER_1", 2.0, None, 0, "no_verdict")
    _, attitudes = said(xte, Interval(1.0, 0.9, 1.1), worse, (unknown,) * len(xte.trackers))
    assert [each.table for each in attitudes.statement.changes] == ["trackers"] * len(xte.trackers)
    # Where residuals judge the trackers themselves, they alone give lines.
    fits = replace(unknown, verdict="fits")
    _, attitudes = said(xte, Interval(1.0, 0.9, 1.1), worse, (fits,) * len(xte.trackers))
    assert attitudes.statement.action == "correct"
    assert attitudes.statement.changes == ()


def test_without_innovations_the_command_is_named_and_without_a_gyro_nothing_is_said(xte):
    (only,) = innovation_findings(None, xte, ())
    assert only.statement.action == "wait"
    assert "acquire smooth XTE" in only.statement.text
    assert innovation_findings(None, mission_without_gyro("XTE"), ()) == []
