"""Drift of instruments is measured batch by batch; its alarm leads to the calibration."""

import json
import re
from itertools import combinations

import httpx
import numpy as np
import pytest

from service.acquire import acquire
from service.app.factory import open_app
from service.missions.mission import parse_mission
from service.observations.schema import submission_from_json
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.ephemeris import apparent, observer_velocity
from service.sky.model import SkyModel
from service.storage.recording.result_metrics import metrics_of
from service.trends.drift import MeanStars, alignment_offsets_arcsec, scale_offset_ppm
from service.trends.quantities import QUANTITIES
from service.vectors import unit
from service.web.app import create_app
from tests.features.calibration.wrong_file import TURNED_ARCSEC, mission_texts, true_batches
from tests.fresh_databases import sqlite_at
from tests.storage.twin import FIRST, SECOND, submission, twin
from tests.web.conformance import check
from tests.web.serving import Server, in_process_settings

BATCHES = 24
ARCSEC = np.pi / 180.0 / 3600.0
HERE = "/api/v1/spacecraft/TWO"


@pytest.fixture(scope="module")
def sky():
    return SkyModel(load_embedded(), LruCache(64 << 20))


@pytest.fixture(scope="module")
def batches(sky):
    return true_batches(sky, BATCHES)


def acquired(sky, text, batches):
    mission = parse_mission(text, "two.toml")
    return [acquire(submission_from_json(json.dumps(each)).batch, mission, sky) for each in batches]


def mean_of(found, name):
    values = [metrics_of(each)[name] for each in found]
    known = [each for each in values if each is not None]
    assert len(known) > 0.7 * len(values)
    return np.mean(known), np.std(known, ddof=1) / len(known) ** 0.5


def test_a_turn_between_trackers_shows_in_the_angle_between_them(sky, batches):
    texts = mission_texts()
    right, sigma = mean_of(acquired(sky, texts["true"], batches), "alignment_offset_arcsec")
    assert abs(right) < 4.0 * sigma
    assert sigma < 0.5
    # The trackers look along body X and Y, and the second one is turned about body Z, away from
    # the first: the assumed angle is too small.  Its bent field counts as alignment in part.
    turned, _ = mean_of(acquired(sky, texts["assumed"], batches), "alignment_offset_arcsec")
    assert turned == pytest.approx(-TURNED_ARCSEC, abs=10.0)


def test_a_longer_focal_length_shows_in_the_scale(sky, batches):
    text = mission_texts()["true"]
    right, sigma = mean_of(acquired(sky, text, batches), "scale_offset_ppm")
    assert abs(right) < 4.0 * sigma
    assert sigma < 30.0
    scaled = text.replace("[trackers.calibration]", "[trackers.calibration]\nscale = 1.0005")
    both = mean_of(acquired(sky, scaled, batches), "scale_offset_ppm")
    # The second of two trackers alone has it: of all stars, about half.
    assert 0.3 * 500.0 < both[0] - right < 0.7 * 500.0


def test_the_scale_is_that_of_all_separations_pair_by_pair(sky, batches):
    (found,) = acquired(sky, mission_texts()["assumed"], batches[:1])
    velocity = observer_velocity(found.batch.time, found.batch.velocity_km_per_s)
    of_day = found.run_catalog.direction_at(found.batch.time)
    squares = np.zeros(2)
    for each in found.trackers:
        star = each.identification.star
        seen = each.corrected.direction_body[star >= 0]
        known = apparent(of_day[star[star >= 0]], velocity, found.batch.time)
        pairs = list(combinations(range(len(seen)), 2))
        assert len(pairs) >= 3
        for k, directions in enumerate((seen, known)):
            chords = [np.linalg.norm(directions[i] - directions[j]) for i, j in pairs]
            squares[k] += np.sum(np.square(chords)) / len(seen)
    expected_ppm = 1e6 * (np.sqrt(squares[0] / squares[1]) - 1.0)
    assert metrics_of(found)["scale_offset_ppm"] == pytest.approx(expected_ppm, abs=1e-3)


def seen_by(trackers, directions, turn_arcsec=(0.0, 0.0, 0.0)):
    """One star of each tracker, so that the sums are the directions themselves."""
    means = []
    for tracker, direction, arcsec in zip(trackers, directions, turn_arcsec, strict=True):
        x, y, z = direction
        c, s = np.cos(arcsec * ARCSEC), np.sin(arcsec * ARCSEC)
        turned = np.array([c * x - s * y, s * x + c * y, z])
        means.append(MeanStars(tracker, 1, turned, np.array(direction)))
    return means


def test_of_three_trackers_the_one_that_moved_has_the_largest_offset(missions):
    mission = twin(missions)
    trackers = (*mission.trackers, mission.trackers[0])
    directions = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    found = alignment_offsets_arcsec(seen_by(trackers, directions, (0.0, 30.0, 0.0)))
    assert found == pytest.approx([15.0, 15.0, 0.0], abs=1e-6)
    # About body Z the angle to the third does not change: two of its angles tell which moved.
    closer = alignment_offsets_arcsec(
        seen_by(trackers, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-0.6, 0.8, 0.0)), (0.0, 30.0, 0.0))
    )
    assert closer == pytest.approx([15.0, 0.0, -15.0], abs=1e-6)


def test_without_stars_to_compare_there_is_no_value(missions):
    mission = twin(missions)
    none = np.zeros(3)
    empty = [MeanStars(each, 0, none, none) for each in mission.trackers]
    assert alignment_offsets_arcsec(empty) == [None, None]
    assert scale_offset_ppm(empty) is None
    (alone, _) = seen_by(mission.trackers, ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (0.0, 0.0))
    assert alignment_offsets_arcsec([alone, empty[1]]) == [None, None]
    # Two stars so close together that their separation says little of a scale.
    close = np.array([np.cos(1e-3), np.sin(1e-3), 0.0])
    both = np.array([1.0, 0.0, 0.0]) + close
    assert scale_offset_ppm([MeanStars(mission.trackers[0], 2, both, both)]) is None


def test_points_in_one_place_that_tell_of_two_stars_have_a_value(missions, rng):
    """A tolerance of degrees lets them; rounding leaves less than nothing of their scatter."""
    tracker = twin(missions).trackers[0]
    for _ in range(100):
        seen, across = (unit(rng.normal(size=3)) for _ in range(2))
        other = unit(seen + rng.uniform(0.2, 5.0) * unit(np.cross(seen, across)))
        offset = scale_offset_ppm([MeanStars(tracker, 2, 2.0 * seen, seen + other)])
        assert offset == pytest.approx(-1e6, abs=1.0)


def test_both_values_of_every_tracker_are_recorded_and_have_a_history(opened, sky, missions):
    mission = twin(missions)
    app = opened(mission)
    for k in range(3):
        sent = submission(sky, mission, f"b{k}", after_s=30.0 * k, noise_arcsec=(2.0, 2.0))
        app.submissions.submit(sent)
    names = ["scale_offset_ppm", "alignment_offset_arcsec"]
    whole = app.spacecraft.history("XTE", quantities=names, strategy="latest").series
    of = {
        name: app.spacecraft.history(
            "XTE", quantities=names, strategy="latest", tracker=name
        ).series
        for name in (FIRST, SECOND)
    }
    scales = [of[name]["scale_offset_ppm"].value for name in (FIRST, SECOND)]
    assert None not in (*scales[0], *scales[1])
    for both, one, other in zip(whole["scale_offset_ppm"].value, *scales, strict=True):
        assert min(one, other) <= both <= max(one, other)
    aligned = [each["alignment_offset_arcsec"].value for each in (whole, *of.values())]
    assert aligned[1] == pytest.approx(aligned[0])
    assert aligned[2] == pytest.approx(aligned[0])
    assert 0.0 < max(map(abs, aligned[0])) < 20.0


@pytest.fixture
def client(tmp_path):
    folder = tmp_path / "missions"
    folder.mkdir()
    (folder / "two.toml").write_text(mission_texts()["assumed"], "utf-8")
    app = open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db"), missions=folder))
    with (
        Server(create_app(app)) as address,
        httpx.Client(base_url=address, timeout=60, event_hooks={"response": [check]}) as client,
    ):
        yield client


def test_an_alarm_of_drift_names_the_instrument_and_leads_to_the_calibration(client, batches):
    bounds = {"watch": {"low": -10.0, "high": 10.0}, "critical": {"low": -60.0, "high": 60.0}}
    settings = bounds | {"minimum_count": 5, "duration_s": 0.0}
    asked = {"settings": settings, "who": "J. Operator"}
    client.put(f"{HERE}/limits/alignment_offset_arcsec", json=asked).raise_for_status()
    for each in batches[:8]:
        client.post("/api/v1/batches", json=each).raise_for_status()
    raised = client.get("/api/v1/alarms?spacecraft=TWO").json()["items"]
    drifted = [each for each in raised if each["quantity"] == "alignment_offset_arcsec"]
    assert {each["tracker"] for each in drifted} == {None, "STARTRACKER_1", "SECOND"}
    assert {each["severity"] for each in drifted} == {"critical"}
    page = client.get(f"/alarms/{drifted[0]['id']}").raise_for_status().text
    text = re.sub(r"\s+", " ", page)
    cause = QUANTITIES["alignment_offset_arcsec"].cause
    assert cause.cause in text
    assert "acquire calibrate" in cause.remedy
    assert 'href="/spacecraft/TWO/calibration"' in page
    assert client.get("/spacecraft/TWO/calibration").status_code == 200
    trends = client.get("/spacecraft/TWO").raise_for_status().text
    assert "Angle between trackers, observed minus catalog" in trends
    assert "Scale offset, observed over catalog" in trends
    assert " ppm" in trends
