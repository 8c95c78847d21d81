"""Errors are as large as the covariance says, and aberration acts as physics says.

pytest --seed 7 tests/simulate/test_statistics.py       another draw of every pass
TEST_PASS=500 pytest tests/simulate/test_statistics.py  shorter passes, wider limits
"""

import json
import os
from dataclasses import dataclass

import numpy as np
import pytest

from service.acquire import Acquisition, acquire
from service.observations.schema import submission_from_json
from service.simulate.score import CHI_SQUARE_997
from service.simulate.stretches import NO_TROUBLES, Pass
from service.simulate.telemetry import draw_pass
from service.sky.ephemeris import apparent, observer_velocity
from service.vectors import angle_between_deg, attitude_error_arcsec, matrix_from_quaternion
from tests.chance import assert_chi_square, at_least, at_most
from tests.scale import draws

WHOLE_PASS = int(os.environ.get("TEST_PASS") or draws(600, 2000))
SHORT_PASS = WHOLE_PASS // 4
ALL = ("XTE", "SWAS", "SOHO")
ALL_OVER_S = 3000.0
"""A cadence so slow that slews between batches lead all over the sky."""


@dataclass(frozen=True)
class Result:
    acquisition: Acquisition
    truth: dict
    wrong: int

    @property
    def attitude(self):
        return matrix_from_quaternion(self.acquisition.solution.quaternion)

    @property
    def true_attitude(self):
        return matrix_from_quaternion(self.truth["quaternion"])

    @property
    def chi_square(self):
        error = attitude_error_arcsec(self.attitude, self.true_attitude)
        return error @ np.linalg.solve(self.acquisition.solution.covariance_arcsec2, error)


def flown(missions, sky, name, seed, batches, aberration="to_correct", cadence_s=None):
    """A nominal pass and what the service makes of it."""
    wanted = Pass(
        batches, seed, cadence_s=cadence_s, aberration={aberration: 1.0}, troubles=NO_TROUBLES
    )
    for each in draw_pass(missions[name], sky, wanted):
        submission = submission_from_json(json.dumps(each.batch))
        found = acquire(submission.batch, missions[name], sky)
        wrong = sum(
            star >= 0 and found.run_catalog.star_id[star] != true
            for tracker, truth in zip(found.trackers, each.truth["observations"], strict=True)
            for star, true in zip(tracker.identification.star, truth["stars"], strict=True)
        )
        yield Result(found, each.truth, wrong)


def solved(results):
    return [each for each in results if each.acquisition.solution is not None]


@pytest.mark.parametrize("name", ["XTE", pytest.param("SWAS", marks=pytest.mark.slow), "SOHO"])
def test_over_a_nominal_pass_errors_are_what_the_covariance_predicts(missions, sky, name, seed):
    """The mean of e^T P^-1 e is 3, and few are beyond its 99.73 % point.

    Attitudes that rest on a wrong star are left out here, and are few; with a
    third star to speak against it, such an attitude says itself that it is
    suspect.
    """
    results = list(flown(missions, sky, name, seed, WHOLE_PASS))
    observed = sum(each.acquisition.counts["observed"] for each in results)
    unique = sum(each.acquisition.counts["unique"] for each in results)
    wrong = sum(each.wrong for each in results)
    assert unique >= at_least(observed, 0.99)
    assert wrong <= at_most(observed, 0.001)
    for each in solved(results):
        if each.wrong and each.acquisition.counts["unique"] > 2:
            assert each.acquisition.solution.suspect
    right = np.array([each.chi_square for each in solved(results) if not each.wrong])
    assert len(right) >= at_least(WHOLE_PASS, 0.98)
    assert_chi_square(right, 3)
    assert np.sum(right > CHI_SQUARE_997) <= at_most(len(right), 0.0027)
    # The wrong ones are few enough to change little.
    every = np.array([each.chi_square for each in solved(results)])
    assert np.sum(every > CHI_SQUARE_997) <= at_most(len(every), 0.005)


@pytest.mark.parametrize("name", ALL)
def test_directions_that_were_corrected_upstream_give_the_same_statistics(
    missions, sky, name, seed
):
    results = flown(missions, sky, name, seed, SHORT_PASS, "applied_upstream")
    assert_chi_square([each.chi_square for each in solved(results) if not each.wrong], 3)


@pytest.mark.parametrize("name", ALL)
def test_ignored_aberration_turns_the_attitude_by_just_as_much(missions, sky, name, seed):
    """The boresight is off by what its stars are: up to 20.5 arcsec and the orbit's 5.2."""
    boresight = missions[name].trackers[0].body_from_tracker[:, 2]
    shifts, left = [], []
    for each in solved(flown(missions, sky, name, seed, SHORT_PASS, "ignore", ALL_OVER_S)):
        if each.wrong:
            continue
        batch = each.acquisition.batch
        found, true = each.attitude.T @ boresight, each.true_attitude.T @ boresight
        velocity = observer_velocity(batch.time, batch.velocity_km_per_s)
        shift = apparent(found, velocity, batch.time) - found
        shifts.append(angle_between_deg(found, found + shift) * 3600.0)
        # In tracker axes, where the noise of the two is alike.
        left.append(each.true_attitude @ (true - found - shift))
    left_arcsec = np.degrees(left) * 3600.0
    shifts = np.array(shifts)
    assert shifts.max() <= 26.0
    assert shifts.mean() > 10.0
    # What is left is the noise of the boresight, about 2 arcsec, around nothing.
    assert np.abs(left_arcsec.mean(axis=0)).max() <= 0.5
    assert np.median(np.linalg.norm(left_arcsec, axis=1)) <= 3.0


@pytest.mark.parametrize("name", ["XTE", "SOHO"])
def test_aberration_that_is_corrected_twice_is_as_wrong_as_none(missions, sky, name, seed):
    """The words mean something: said wrongly, the attitude is off by the aberration."""
    wanted = Pass(
        40,
        seed,
        cadence_s=ALL_OVER_S,
        aberration={"applied_upstream": 1.0},
        troubles=NO_TROUBLES,
    )
    boresight = missions[name].trackers[0].body_from_tracker[:, 2]
    off, left = [], []
    for each in draw_pass(missions[name], sky, wanted):
        body = {**each.batch, "aberration": "to_correct"}
        found = acquire(submission_from_json(json.dumps(body)).batch, missions[name], sky)
        if found.solution is not None:
            direction = matrix_from_quaternion(found.solution.quaternion).T @ boresight
            true = matrix_from_quaternion(each.truth["quaternion"]).T @ boresight
            velocity = observer_velocity(found.batch.time, found.batch.velocity_km_per_s)
            shifted = apparent(true, velocity, found.batch.time)
            off.append(angle_between_deg(direction, true) * 3600.0)
            left.append(angle_between_deg(direction, shifted) * 3600.0)
    assert np.median(left) < 3.0 < np.median(off) - 2.0
