"""Stars of one batch seen at different times, or by several trackers: what contradicts is said."""

import copy
import json
import math

import numpy as np
import pytest

from service.acquire import acquire
from service.acquire.contradictions import turn_of
from service.missions.mission import Mission
from service.observations.schema import submission_from_json
from service.vectors import attitude_error_arcsec
from tests.attitude.cases import field_of_stars, random_attitude, seen, solved
from tests.chance import assert_chi_square
from tests.reference import batches
from tests.reference.compare import Judge

TIME = "1996-01-10T12:00:00.000Z"
SIGMA_ARCSEC = 2.1213203
SLOW = np.array([0.0, 0.08, 0.08])
"""Rates in deg/s about the body's axes."""


def codes(found):
    return {warning.partition(":")[0] for warning in found.warnings}


class Scene:
    """Stars of an XTE of several trackers at a true attitude that the body turns away from."""

    def __init__(self, mission_files, sky, rng, trackers=2):
        self.toml = batches.with_trackers(mission_files["XTE"], trackers)
        self.judge, self.sky, self.rng = Judge(self.toml, sky), sky, rng
        self.truth = batches.quaternion_matrix(batches.random_quaternion(rng))

    def found(self, offsets_s, rates, told=(0.0, 0.0, 0.0), late_s=0.0, stars=6, mission=None):
        """The acquisition of stars seen at `offsets_s` of each tracker; the last one is late."""
        catalog = self.judge.catalog(TIME)
        observations = []
        for tracker, offset_s in zip(self.toml["trackers"], offsets_s, strict=True):
            alignment = np.column_stack([tracker[f"{axis}_axis_body"] for axis in "xyz"])
            boresight = self.truth.T @ alignment[:, 2]
            inside = np.flatnonzero(catalog.directions @ boresight > math.cos(math.radians(3.5)))
            bright = inside[np.argsort(catalog.magnitude[inside])][:stars]
            each_s = np.broadcast_to(offset_s, len(bright))
            seen_stars = []
            for row, own_s in zip(bright, each_s, strict=True):
                seen_s = own_s + (late_s if tracker is self.toml["trackers"][-1] else 0.0)
                angle_deg = float(np.linalg.norm(rates)) * seen_s
                turn = batches.rotation(rates, -angle_deg) if angle_deg else np.eye(3)
                vector = alignment.T @ turn @ self.truth @ catalog.directions[row]
                noise = self.rng.normal(size=3) * math.radians(SIGMA_ARCSEC / 3600.0)
                vector = vector + noise - (noise @ vector) * vector
                star = {"vector": (vector / np.linalg.norm(vector)).tolist()}
                star |= {"magnitude": float(catalog.magnitude[row]), "time_offset_s": float(own_s)}
                seen_stars.append(star)
            observations.append({"tracker": tracker["name"], "stars": seen_stars})
        body = {
            "spacecraft": self.toml["name"],
            "batch": "1",
            "time": TIME,
            "a_priori": {"quaternion": batches.matrix_quaternion(self.truth).tolist()},
            "body_rates_deg_per_s": list(told),
            "aberration": "ignore",
            "observations": observations,
        }
        submission = submission_from_json(json.dumps(body))
        return acquire(submission.batch, mission or self.judge.mission, self.sky)

    def error_sigmas(self, found):
        """The error of an attitude in its own sigmas, as the root of e^T P^-1 e."""
        solution = found.solution
        error = attitude_error_arcsec(solution.matrix, self.truth)
        return math.sqrt(error @ np.linalg.solve(solution.covariance_arcsec2, error))


@pytest.fixture
def scene(mission_files, sky, rng):
    return Scene(mission_files, sky, rng)


def test_stars_with_their_times_and_rates_are_good_and_nothing_is_said(scene):
    found = scene.found((0.0, 1.0), SLOW, told=SLOW)
    assert not found.solution.suspect
    assert not codes(found) & {"rates_contradicted", "motion_unknown", "trackers_disagree"}
    assert scene.error_sigmas(found) < 5.0


def test_stars_of_two_times_without_rates_say_the_rates_that_fit_them(scene):
    found = scene.found((0.0, 1.0), SLOW)
    assert found.solution.suspect
    (warning,) = [each for each in found.warnings if each.startswith("rates_contradicted")]
    numbers = warning.partition("fit rates of (")[2].partition(")")[0]
    fitted = np.array([float(each) for each in numbers.split(",")])
    assert fitted == pytest.approx(SLOW, abs=0.01)


def test_rates_of_the_opposite_sign_are_contradicted_by_stars_of_two_times(scene):
    found = scene.found((-0.5, 0.5), SLOW, told=-SLOW)
    assert found.solution.suspect
    assert "rates_contradicted" in codes(found)


def test_stars_of_one_tracker_at_many_times_tell_the_rates_too(mission_files, sky, rng):
    scene = Scene(mission_files, sky, rng, trackers=1)
    found = scene.found((np.linspace(-0.05, 0.05, 6),), SLOW, told=-SLOW)
    assert "rates_contradicted" in codes(found)


@pytest.mark.parametrize(("offset_s", "is_said"), [(0.0, False), (1e-4, False), (1.0, True)])
def test_stars_all_seen_later_without_rates_say_that_the_motion_is_unknown(
    mission_files, sky, rng, offset_s, is_said
):
    scene = Scene(mission_files, sky, rng, trackers=1)
    found = scene.found((offset_s,), SLOW)
    assert ("motion_unknown" in codes(found)) == is_said
    # Nothing in the batch tells that the attitude is off.
    assert not found.solution.suspect
    assert (scene.error_sigmas(found) > 5.0) == (offset_s > 0.1)


def test_a_mission_that_stands_still_is_not_warned(mission_files, sky, rng):
    scene = Scene(mission_files, sky, rng, trackers=1)
    still = Mission.model_validate({**scene.toml, "motion": {"rate_sigma_rad_s": 1e-7}})
    found = scene.found((1.0,), np.array([0.0, 0.0, 1e-9]), mission=still)
    assert "motion_unknown" not in codes(found)


def test_many_stars_of_two_trackers_tell_of_a_misalignment_below_the_bound_of_taste(
    mission_files, sky, rng
):
    """Of fields of many stars, the sum of all residuals hides what two trackers disagree by."""
    scene = Scene(mission_files, sky, rng)
    bent = copy.deepcopy(scene.toml)
    last = bent["trackers"][-1]
    aside = np.cross(last["z_axis_body"], bent["trackers"][0]["z_axis_body"])
    for axis in "xyz":
        key = f"{axis}_axis_body"
        last[key] = (batches.rotation(aside, 9.0 / 3600.0) @ np.array(last[key])).tolist()
    mission = Mission.model_validate(bent)
    found = scene.found((0.0, 0.0), SLOW, stars=60, mission=mission)
    assert found.solution.suspect
    assert "trackers_disagree" in codes(found)
    assert "trackers_disagree" not in codes(scene.found((0.0, 0.0), SLOW, stars=60))


def test_a_misidentified_star_is_not_called_a_turn(rng):
    truth = random_attitude(rng)
    stars = np.vstack([field_of_stars(rng, rng.normal(size=3), 4.0, 6) for _ in range(2)])
    body = seen(rng, truth, stars, 2.0)
    body[7] = batches.rotation(rng.normal(size=3), 0.02) @ body[7]
    solution = solved(body, stars, 2.0)
    share = np.repeat([0.0, 1.0], 6)
    sigma = np.full(12, math.radians(2.0 / 3600.0))
    assert not turn_of(body, stars, sigma, solution.quest, share).contradicts(solution)


@pytest.mark.parametrize("kind", ["tracker", "time"])
def test_the_turn_of_noise_is_distributed_as_chi_square_says(kind, rng):
    squares = np.empty(600)
    sigma = np.full(10, math.radians(2.0 / 3600.0))
    for k in range(len(squares)):
        truth = random_attitude(rng)
        stars = np.vstack([field_of_stars(rng, rng.normal(size=3), 4.0, 5) for _ in range(2)])
        body = seen(rng, truth, stars, 2.0)
        share = np.repeat([0.0, 1.0], 5) if kind == "tracker" else rng.uniform(-1.0, 1.0, 10)
        squares[k] = turn_of(body, stars, sigma, solved(body, stars, 2.0).quest, share).chi_square
    assert_chi_square(squares, 3)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_matched_stars_than_an_attitude_needs_contradict_nothing(count, rng):
    """As of a batch with a rival attitude, whose stars are ambiguous."""
    truth = random_attitude(rng)
    stars = field_of_stars(rng, rng.normal(size=3), 4.0, 6)
    body = seen(rng, truth, stars, 2.0)
    sigma, share = np.full(count, math.radians(2.0 / 3600.0)), np.full(count, 0.1)
    turn = turn_of(body[:count], stars[:count], sigma, solved(body, stars, 2.0).quest, share)
    assert turn.chi_square == pytest.approx(0.0, abs=1e-6)
    assert np.isfinite(turn.rad).all()
