"""The pipeline without a prior, or with a wrong one: the whole sky, and the path that says so."""

import json
import math

import numpy as np
import pytest

from service.acquire import acquire
from service.acquire.result import Path
from service.attitude.solution import NoAttitude
from service.identify.hypotheses.verified import weigh_sightings
from service.missions.mission import Mission
from service.observations.schema import submission_from_json
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.storage.recording.result_metrics import metrics_of
from service.vectors import attitude_error_arcsec, matrix_from_quaternion, quaternion_from_matrix
from tests.reference.compare import answer_as_json

LOST = {"a_priori": None}


@pytest.fixture(scope="module")
def drawn(missions, sky):
    """Batches of an XTE, each with the truth beside it."""
    return list(draw_pass(missions["XTE"], sky, Pass(12, 8)))


def acquired(body, mission, sky):
    return acquire(submission_from_json(json.dumps(body)).batch, mission, sky)


def error_arcsec(acquisition, truth):
    found = matrix_from_quaternion(acquisition.solution.quaternion)
    return float(
        np.linalg.norm(attitude_error_arcsec(found, matrix_from_quaternion(truth["quaternion"])))
    )


def turned_away(body, by_deg):
    """The batch with an a priori attitude that is off by so much about body Y."""
    half = math.radians(by_deg) / 2
    q = matrix_from_quaternion(body["a_priori"]["quaternion"])
    turn = matrix_from_quaternion([0.0, math.sin(half), 0.0, math.cos(half)])
    quaternion = quaternion_from_matrix(turn @ q).tolist()
    return {**body, "a_priori": {"quaternion": quaternion}}


def test_without_a_prior_the_answer_is_that_of_a_good_prior(drawn, missions, sky):
    for each in drawn:
        about = acquired(each.batch, missions["XTE"], sky)
        lost = acquired({**each.batch, **LOST}, missions["XTE"], sky)
        assert lost.path is Path.LOST_IN_SPACE
        assert lost.prior is None
        assert lost.counts["unique"] >= about.counts["unique"] - 1
        assert error_arcsec(lost, each.truth) < 60.0
        answer = answer_as_json(lost, id=None)
        assert answer["path"] == "lost_in_space"
        assert answer["observations"][0]["zone"]["kind"] == "cap"
        assert metrics_of(lost)["a_priori_angle_deg"] is None


def test_a_wrong_prior_falls_back_to_the_whole_sky_and_says_so(drawn, missions, sky):
    for each in drawn[:6]:
        found = acquired(turned_away(each.batch, 40.0), missions["XTE"], sky)
        assert found.path is Path.ZONE_THEN_LOST_IN_SPACE
        assert error_arcsec(found, each.truth) < 60.0
        assert metrics_of(found)["a_priori_angle_deg"] == pytest.approx(40.0, abs=15.0)
        assert any(text.startswith("attitude_off_a_priori") for text in found.warnings)


def test_a_good_prior_never_asks_the_whole_sky(drawn, missions, sky):
    paths = [acquired(each.batch, missions["XTE"], sky).path for each in drawn]
    assert paths.count(Path.ZONE) >= len(drawn) - 1


def test_a_mission_may_do_without_the_fallback(drawn, missions, sky):
    mission = missions["XTE"].model_copy(update={"lost_in_space_fallback": False})
    assert isinstance(mission, Mission)
    found = acquired(turned_away(drawn[0].batch, 40.0), mission, sky)
    assert found.path is Path.ZONE
    assert found.solution is None


def test_votes_do_not_fall_back(drawn, missions, sky):
    body = {**turned_away(drawn[0].batch, 40.0), "options": {"identifier": "starid"}}
    assert acquired(body, missions["XTE"], sky).path is Path.ZONE


def test_the_identifier_lost_in_space_does_not_look_at_the_prior(drawn, missions, sky):
    body = {**turned_away(drawn[0].batch, 40.0), "options": {"identifier": "lost_in_space"}}
    found = acquired(body, missions["XTE"], sky)
    assert found.path is Path.LOST_IN_SPACE
    assert error_arcsec(found, drawn[0].truth) < 60.0


def test_a_mirrored_field_is_refused_with_every_star_unmatched(drawn, missions, sky):
    body = json.loads(json.dumps({**drawn[1].batch, **LOST}))
    for star in body["observations"][0]["stars"]:
        x, y, z = star["vector"]
        star["vector"] = [-x, y, z]
    found = acquired(body, missions["XTE"], sky)
    assert found.solution is None
    assert found.reason in (NoAttitude.NO_MATCH, NoAttitude.DOUBTFUL_MATCH)
    assert found.counts["unmatched"] == found.counts["observed"] > 0
    answer = answer_as_json(found, id=None)
    assert answer["observations"][0]["zone"] is None
    assert answer["reason"] == str(found.reason)


def test_two_stars_without_a_prior_are_refused_as_too_few(drawn, missions, sky):
    body = json.loads(json.dumps({**drawn[0].batch, **LOST}))
    stars = body["observations"][0]["stars"]
    body["observations"][0]["stars"] = stars[:2]
    assert acquired(body, missions["XTE"], sky).reason is NoAttitude.FEWER_THAN_THREE_STARS


def test_without_magnitudes_it_is_found_as_well(drawn, missions, sky):
    right = 0
    for each in drawn:
        body = json.loads(json.dumps({**each.batch, **LOST}))
        for star in body["observations"][0]["stars"]:
            del star["magnitude"]
        found = acquired(body, missions["XTE"], sky)
        right += found.solution is not None and error_arcsec(found, each.truth) < 60.0
    assert right >= len(drawn) - 1


def test_stars_found_without_their_magnitudes_are_weighed_by_the_same_kernel(drawn, missions, sky):
    """Another would be compiled in the way of the post, for a minute."""
    acquired(drawn[0].batch, missions["XTE"], sky)
    known = set(weigh_sightings.signatures)
    body = json.loads(json.dumps({**drawn[0].batch, **LOST}))
    for star in body["observations"][0]["stars"]:
        star["magnitude"] += 5.0
    found = acquired(body, missions["XTE"], sky)
    assert any(text.startswith("magnitudes_not_used") for text in found.warnings)
    assert set(weigh_sightings.signatures) == known


@pytest.mark.parametrize("offset_mag", [0.0, 1.5, 2.0, 5.0, -17.5])
@pytest.mark.parametrize("identifier", ["verified", "starid"])
def test_magnitudes_off_by_any_constant_do_no_harm_and_the_answer_tells_it(
    drawn, missions, sky, offset_mag, identifier
):
    right = without = told = 0
    for each in drawn:
        body = json.loads(json.dumps({**each.batch, **LOST, "options": {"identifier": identifier}}))
        stars = body["observations"][0]["stars"]
        for star in stars:
            star["magnitude"] += offset_mag
        found = acquired(body, missions["XTE"], sky)
        good = found.solution is not None and not found.solution.suspect
        right += good and error_arcsec(found, each.truth) < 60.0
        warned = [text for text in found.warnings if text.startswith("magnitudes_not_used")]
        for text in warned:
            told += 1
            assert float(text.split()[-2]) == pytest.approx(offset_mag, abs=0.5)
        # The answer shows the magnitudes as they were sent.
        seen = found.trackers[0].corrected.magnitude_mag
        assert seen.tolist() == [star["magnitude"] for star in stars]
        for star in stars:
            del star["magnitude"]
        found = acquired(body, missions["XTE"], sky)
        good = found.solution is not None and not found.solution.suspect
        without += good and error_arcsec(found, each.truth) < 60.0
        assert not any(text.startswith("magnitudes_not_used") for text in found.warnings)
    assert right >= without >= len(drawn) - 2
    if offset_mag == 0.0:
        assert told == 0
    if abs(offset_mag) >= 2.0:
        assert told >= right


def test_of_two_trackers_one_finds_the_attitude_for_both(drawn, missions, sky):
    """A second tracker that looks along body Y sees two stars, which alone say nothing."""
    settings = missions["XTE"].model_dump(mode="json")
    second = {
        **settings["trackers"][0],
        "name": "STARTRACKER_2",
        "x_axis_body": [0.0, 0.0, 1.0],
        "y_axis_body": [1.0, 0.0, 0.0],
        "z_axis_body": [0.0, 1.0, 0.0],
    }
    mission = Mission.model_validate({**settings, "trackers": [*settings["trackers"], second]})
    body = {**drawn[0].batch, **LOST, "aberration": "ignore"}
    attitude = matrix_from_quaternion(drawn[0].truth["quaternion"])
    run_catalog = sky.run_catalog(mission, submission_from_json(json.dumps(body)).batch.time)
    axes = mission.trackers[1].body_from_tracker
    seen = run_catalog.direction @ attitude.T @ axes
    row = np.flatnonzero(seen[:, 2] > math.cos(math.radians(3.0)))[:2]
    stars = [
        {"vector": seen[k].tolist(), "magnitude": float(run_catalog.magnitude_mag[k])} for k in row
    ]
    body["observations"] = [{"tracker": "STARTRACKER_2", "stars": stars}, *body["observations"]]
    found = acquired(body, mission, sky)
    assert found.path is Path.LOST_IN_SPACE
    assert found.trackers[0].identification.star.tolist() == row.tolist()
    assert found.solution is not None


def test_a_band_mission_is_found_without_its_sun(missions, sky):
    right = asked = 0
    for each in draw_pass(missions["SOHO"], sky, Pass(12, 5)):
        found = acquired({**each.batch, **LOST}, missions["SOHO"], sky)
        asked += 1
        if found.solution is not None:
            assert error_arcsec(found, each.truth) < 300.0
            right += 1
    assert right >= asked // 2


def test_an_attitude_that_the_zone_cannot_confirm_is_kept_with_its_own_stars(drawn, missions, sky):
    """Votes within a tolerance of next to nothing identify no star about the right attitude."""
    tight = {"identifier": "starid", "tolerances": {"separation_deg": 1e-6}}
    for each in drawn[:4]:
        body = {**each.batch, **LOST, "options": tight}
        found = acquired(body, missions["XTE"], sky)
        assert found.solution is not None
        assert error_arcsec(found, each.truth) < 60.0
        assert any(text.startswith("zone_without_attitude") for text in found.warnings)
        assert found.counts["unique"] >= 3
