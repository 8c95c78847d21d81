"""APM and ACM files, read by Orekit."""

import dataclasses
import math

import numpy as np
import pytest

from service.features.products.attitudes import SeriesTracker
from service.missions.mission import load_missions
from service.times import parse_utc
from tests.features.products.series import (
    ABOUT,
    GOLDEN,
    START,
    random_quaternions,
    rows,
    slew,
    written,
)

RATE = np.array([0.4, -0.5, 0.76])
XTE = load_missions()["XTE"].trackers[0]
TRACKER = SeriesTracker(XTE.name, tuple(map(tuple, XTE.body_from_tracker.tolist())), 2.1)
OTHER = dataclasses.replace(TRACKER, name="OTHER")


def apart(one, other):
    sign = np.sign(np.sum(one * other, axis=1))[:, None]
    return np.abs(one - sign * other).max()


@pytest.fixture
def read(orekit, tmp_path):
    def read(kind, *pages, about=ABOUT, shift_s=0.0):
        (tmp_path / "x").write_bytes(written(kind, *pages, about=about))
        return orekit.read(kind, tmp_path / "x", shift_s)

    return read


def test_an_apm_holds_the_last_attitude_with_its_rate(read):
    q = slew(10, rate_deg_per_s=RATE)
    found = read("apm", rows([GOLDEN], "1996-01-01T00:00:00Z"), rows(q))
    assert apart(np.array([found["quaternion"]]), q[-1:]) < 1e-15
    assert found["from"] == "EME2000"
    assert np.degrees(found["rate_rad_per_s"]) == pytest.approx(RATE, abs=1e-12)
    assert found["tai_s"] == pytest.approx(parse_utc(START).tai_ns * 1e-9 + 9.0, abs=1e-6)


def test_an_apm_of_a_lone_attitude_has_no_rate(read):
    found = read("apm", rows([GOLDEN]))
    assert found["quaternion"] == pytest.approx(GOLDEN, abs=1e-15)
    assert found["rate_rad_per_s"] is None


def test_an_acm_s_states_are_those_of_the_series(read, rng):
    q = random_quaternions(rng, 500)
    found = read("acm", rows(q), rows([GOLDEN], "1996-01-10T13:00:00.123456789Z"))
    first, second = found["stretches"]
    assert apart(np.array([each["quaternion"] for each in first]), q) < 1e-12
    assert second[0]["quaternion"] == pytest.approx(GOLDEN, abs=1e-15)
    seconds = parse_utc("1996-01-10T13:00:00.123456789Z").tai_ns * 1e-9
    assert second[0]["tai_s"] == pytest.approx(seconds, abs=1e-6)


def test_an_acm_s_rates_are_of_the_body_in_body_axes(read):
    found = read("acm", rows(slew(200, rate_deg_per_s=RATE)), shift_s=0.5)
    middles = slew(400, step_s=0.5, rate_deg_per_s=RATE)[1::2]
    (states,) = found["stretches"]
    assert apart(np.array([each["quaternion"] for each in states]), middles) < 1e-12


def test_an_acm_across_a_leap_second_counts_it(read):
    found = read("acm", rows(slew(10), "2016-12-31T23:59:55Z"))
    begin = parse_utc("2016-12-31T23:59:55Z").tai_ns * 1e-9
    seconds = [each["tai_s"] for each in found["stretches"][0]]
    assert seconds == pytest.approx([begin + k for k in range(10)], abs=1e-6)


def test_covariances_of_one_tracker_are_of_its_axes_and_of_several_of_the_body_s(read):
    p = np.array([[1.5, 0.1, 0.2], [0.1, 2.5, 0.3], [0.2, 0.3, 30.0]])
    in_tracker = XTE.body_from_tracker.T @ p @ XTE.body_from_tracker
    square = math.radians(1.0 / 3600.0) ** 2
    for trackers, frame, wanted in (
        ((TRACKER,), "STARTRACKER", in_tracker),
        ((TRACKER, OTHER), "SC_BODY", p),
    ):
        about = dataclasses.replace(ABOUT, trackers=trackers)
        found = read("acm", rows(slew(5)), rows(slew(2), "1996-01-11T00:00:00Z"), about=about)
        first, second = found["covariances"]
        assert frame in first["frame"]
        assert [len(each["states"]) for each in (first, second)] == [5, 2]
        # Orekit's own matrix is in rad^2.
        assert first["states"][0] == pytest.approx(np.diag(wanted) * square, rel=1e-9)


def test_an_acm_says_how_the_attitudes_were_determined(read):
    about = dataclasses.replace(ABOUT, trackers=(TRACKER, OTHER))
    found = read("acm", rows(slew(10)), about=about)
    assert found["method"] == "QUEST"
    # Orekit reads an underscore as a blank.
    assert [each["name"] for each in found["sensors"]] == ["STARTRACKER 1", "OTHER"]
    sigma = math.radians(2.1 / 3600.0)
    assert found["sensors"][0]["sigma_rad"] == pytest.approx([sigma, sigma], rel=1e-12)
    assert found["user"] == {
        "STARS_OBSERVED": "90",
        "STARS_UNIQUE": "60",
        "STARS_AMBIGUOUS": "20",
        "STARS_UNMATCHED": "10",
    }
