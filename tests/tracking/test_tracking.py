"""Tracking: each batch is searched about the prediction from the last good attitude."""

import json
import time
from concurrent.futures import Future
from itertools import pairwise

import numpy as np
import pytest

from service.acquire import acquire
from service.app.factory import open_app
from service.errors import BadBatch
from service.gyro.blocks import block_from_json
from service.missions.mission import load_missions
from service.missions.motion import GyroSettings
from service.observations.csv_rows import batch_cells, batch_fields
from service.observations.schema import (
    BatchIn,
    OptionsIn,
    submission_from_json,
)
from service.settings import Settings
from service.storage.queries.results import read_result
from service.storage.upkeep.verify import verify
from service.vectors import (
    attitude_error_arcsec,
    matrix_from_quaternion,
)
from tests.tracking.conftest import send
from tests.tracking.passes import fly, tracked

KEPT = ("observations", "counts", "attitude", "reason", "warnings", "path", "tracking")


def kept(answer):
    """What depends on the batch alone."""
    return {name: answer[name] for name in KEPT} | {
        # A zone may have been in the cache.
        "observations": [
            each | {"zone": each["zone"] and each["zone"] | {"cached": None}}
            for each in answer["observations"]
        ]
    }


def test_the_prediction_is_recorded_and_gives_the_same_again(app, flown):
    answers = [send(app, each.body) for each in flown[:4]]
    assert [each["tracking"]["state"] for each in answers] == ["acquiring", *["tracking"] * 3]
    for before, answer in pairwise(answers):
        assert answer["tracking"]["prediction"]["result"] == before["id"]
        assert answer["tracking"]["prediction"]["age_s"] == pytest.approx(30.0)
    assert [each["tracking"]["prediction"]["rate"] for each in answers[1:]] == [
        "unknown",
        "attitudes",
        "attitudes",
    ]
    again = app.submissions.submit(submission_from_json(json.dumps(flown[2].body)))
    assert again.replayed
    assert json.loads(again.body) == answers[2]
    # The record explains the answer, whatever is recorded later.
    recorded = app.results.get(answers[2]["id"]).input
    assert recorded["a_priori"]["prediction"]["result"] == answers[1]["id"]
    told = app.results.what_if(answers[2]["id"], OptionsIn(), record=False, adopt=False)
    assert kept(json.loads(told.body)) == kept(answers[2])


def test_a_late_batch_changes_no_answer_and_is_predicted_from_before_itself(app, flown):
    for k in (0, 1, 3):
        send(app, flown[k].body)
    third = app.results.get(_id(app, "b00003")).answer
    late = send(app, flown[2].body)
    assert late["tracking"]["prediction"]["result"] == _id(app, "b00001")
    assert app.results.get(_id(app, "b00003")).answer == third


def _id(app, batch):
    (found,) = [each.id for each in app.results.page(limit=50).items if each.batch == batch]
    return found


def test_a_suspect_attitude_predicts_nothing(app, flown):
    first = send(app, flown[0].body)
    body = json.loads(json.dumps(flown[1].body))
    star = body["observations"][0]["stars"][0]["vector"]
    star[0] += 1.2e-4
    suspect = send(app, body, a_priori={"quaternion": first["attitude"]["quaternion"]})
    assert suspect["attitude"]["status"] == "suspect"
    assert send(app, flown[2].body)["tracking"]["prediction"]["result"] == first["id"]


def test_what_waits_together_is_computed_in_order_of_time(app, flown):
    send(app, flown[0].body)
    futures = {
        k: app.submissions.queued(
            submission_from_json(json.dumps(flown[k].body)), None, None, Future()
        )
        for k in (1, 5, 3, 2, 4)
    }
    answers = {k: json.loads(each.result(60).body) for k, each in futures.items()}
    for k in (2, 3, 4, 5):
        assert answers[k]["tracking"]["prediction"]["result"] == answers[k - 1]["id"]


def test_a_flip_is_said_and_its_states_are_events(app, flown):
    first = app.events.last()
    answers = [send(app, each.body) for each in flown]
    assert [each["path"] for each in answers] == [
        "lost_in_space",
        *["zone"] * 5,
        "zone_then_lost_in_space",
        *["zone"] * 3,
    ]
    assert any("rolled by 17" in each or "rolled by 180" in each for each in answers[6]["warnings"])
    app.store.progress.catch_up()
    events = [
        json.loads(each.data) for each in app.events.after(first, 100) if each.kind == "tracking"
    ]
    assert [(each["batch"], each["before"], each["state"]) for each in events] == [
        ("b00000", None, "acquiring"),
        ("b00001", "acquiring", "tracking"),
        ("b00006", "tracking", "acquiring"),
        ("b00007", "acquiring", "tracking"),
    ]
    assert app.spacecraft.state("XTE").tracking == "tracking"


def test_no_attitude_is_carried_through_a_declared_flip(opened, flown):
    time_of = [each.body["time"] for each in flown]
    app = opened(flips=[{"start": time_of[2], "end": time_of[3]}])
    reasons = [send(app, each.body)["tracking"]["reason"] for each in flown[:6]]
    assert reasons == ["no_good_attitude", None, None, "flip", None, None]


def test_a_mission_tracks_batches_without_a_priori_knowledge(opened, flown):
    app = opened(default=True)
    bodies = [each.body | {"a_priori": None} for each in flown[:2]]
    answers = [send(app, body) for body in bodies]
    assert [each["tracking"]["by_default"] for each in answers] == [True, True]
    assert answers[1]["tracking"]["state"] == "tracking"
    assert app.submissions.submit(submission_from_json(json.dumps(bodies[1]))).replayed


def test_a_replay_that_is_stopped_and_begun_anew_gives_the_same_record(app, flown, database):
    lines = [json.dumps(each.body).encode() + b"\n" for each in flown]
    single = [send(app, each.body) for each in flown]
    for part in (lines[:4], lines):
        replay = app.replays.start(part, "pass-1")
        give_up = time.monotonic() + 60
        while app.replays.get(replay).finished is None and time.monotonic() < give_up:
            time.sleep(0.01)
        assert app.replays.get(replay).state == "done"
    many = app.submissions.submit_many(
        [submission_from_json(json.dumps(each.body), run="pass-2") for each in flown]
    )
    page = app.results.page(run="pass-1", limit=50).items
    ids = {each.batch: each.id for each in page}
    for one, together in zip(single, many, strict=True):
        replayed = json.loads(_answer(app, ids[one["batch"]]))
        for other in (replayed, json.loads(together.body)):
            assert _unnamed(kept(other)) == _unnamed(kept(one))
    assert verify(database) == []


def _answer(app, id):
    with app.store.reading() as connection:
        return read_result(connection, id)["answer"]


def _unnamed(answer):
    """Without the ids of results, which differ from run to run."""
    prediction = answer["tracking"]["prediction"]
    told = prediction and prediction | {"result": None}
    return answer | {"tracking": answer["tracking"] | {"prediction": told}}


def test_predictions_are_checked_where_they_are_sent(app, flown):
    prediction = {"quaternion": [0, 0, 0, 1.0], "margin_deg": 1.0}
    prediction["covariance_arcsec2"] = [[1, 0, 0], [0, -1, 0], [0, 0, 1]]
    body = flown[0].body | {"a_priori": {"from": "last", "prediction": prediction}}
    with pytest.raises(BadBatch, match="positive definite"):
        submission_from_json(json.dumps(body))
    for prior in ({"from": "first"}, {"from": "last", "quaternion": [0, 0, 0, 1]}):
        with pytest.raises(BadBatch):
            submission_from_json(json.dumps(flown[0].body | {"a_priori": prior}))
    batch = submission_from_json(json.dumps(flown[0].body)).batch
    with pytest.raises(BadBatch, match="needs the record"):
        acquire(batch, load_missions()["XTE"], app.context.sky)


def test_a_recorded_batch_is_sent_again_with_its_prediction(app, flown):
    answers = [send(app, each.body) for each in flown[:3]]
    recorded = app.results.get(answers[2]["id"]).input
    again = app.submissions.submit(submission_from_json(json.dumps(recorded)))
    assert again.replayed
    elsewhere = send(app, recorded, run="elsewhere")
    assert kept(elsewhere) == kept(answers[2])


def test_reprocessing_uses_the_recorded_prediction_and_gives_the_same_answers(app, flown):
    # The third comes late: what would be predicted now for those after it is something else.
    answers = [send(app, flown[k].body) for k in (0, 1, 3, 4, 2)]
    app.runs.reprocess("again", processes=1)
    page = app.results.page(run="again", limit=50).items
    ids = {each.batch: each.id for each in page}
    assert len(ids) == 5
    for one in answers:
        again = json.loads(_answer(app, ids[one["batch"]]))
        # The results that are named are those of the first run.
        assert kept(again) == kept(one)
    assert verify(app.settings.database) == []


def test_csv_says_that_the_last_attitude_is_asked_for(flown):
    model = BatchIn.model_validate_json(json.dumps(flown[0].body))
    cells = batch_cells(model)
    assert cells["a_priori_from"] == "last"
    assert batch_fields(cells)["a_priori"] == {"from": "last"}


def test_the_covariance_of_the_prediction_is_right(app, sky):
    """Errors of predictions against the truth: chi-square with three degrees of freedom."""
    mission = load_missions()["XTE"]
    weighted = []
    for flown in fly(mission, sky, 25, 5):
        prediction = send(app, flown.body)["tracking"]["prediction"]
        if prediction is not None and prediction["rate"] == "attitudes":
            error = attitude_error_arcsec(
                matrix_from_quaternion(prediction["quaternion"]), flown.attitude
            )
            covariance = np.array(prediction["covariance_arcsec2"])
            weighted.append(error @ np.linalg.solve(covariance, error))
    # The mission's walk of the rate is twice the simulated one, and there is the floor.
    assert len(weighted) > 15
    assert max(weighted) < 30.0
    assert 0.0 < np.mean(weighted) < 3.0


def test_the_recorded_gyro_predicts_where_it_reaches(database, sky):
    mission = tracked(load_missions()["XTE"])
    gyro = GyroSettings(sigma_v_rad_s0_5=1e-6, sigma_u_rad_s1_5=1e-9, bias_sigma_rad_s=1e-6)
    app = open_app(
        Settings(database=database, replay_processes=0), mission.model_copy(update={"gyro": gyro})
    )
    flown = list(fly(load_missions()["XTE"], sky, 4, 3))
    try:
        send(app, flown[0].body)
        # The gyro's samples of the first two intervals are there before the batches at their ends.
        rates = [each.rate_rad_s.tolist() for each in flown[:2] for _ in range(30)]
        block = {"block": "g1", "start": flown[0].body["time"], "step_s": 1.0}
        block["rates_rad_per_s"] = [rates[0], *rates]
        app.gyro.record(block_from_json(json.dumps(block), "XTE"))
        answers = [send(app, each.body) for each in flown[1:]]
    finally:
        app.close()
    predictions = [each["tracking"]["prediction"] for each in answers]
    assert [each["rate"] for each in predictions] == ["gyro", "gyro", "attitudes"]
    for flight, prediction in zip(flown[1:3], predictions, strict=False):
        error = attitude_error_arcsec(
            matrix_from_quaternion(prediction["quaternion"]), flight.attitude
        )
        # That of the attitude before, for the gyro of this test measures without errors.
        assert np.linalg.norm(error) < 150.0


def test_gyro_rates_beyond_what_the_mission_names_now_predict_nothing(database, flown):
    mission = tracked(load_missions()["XTE"])
    gyro = GyroSettings(sigma_v_rad_s0_5=1e-6, sigma_u_rad_s1_5=1e-9, bias_sigma_rad_s=1e-6)
    rates = [each.rate_rad_s.tolist() for each in flown[:2] for _ in range(30)]
    block = {"block": "g1", "start": flown[0].body["time"], "step_s": 1.0}
    block["rates_rad_per_s"] = [rates[0], *rates]
    less_deg_s = 0.5 * np.degrees(np.abs(rates).max())
    told = []
    for settings in (gyro, gyro.model_copy(update={"largest_rate_deg_per_s": less_deg_s})):
        named = mission.model_copy(update={"gyro": settings})
        app = open_app(Settings(database=database, replay_processes=0), named)
        try:
            if not told:
                app.gyro.record(block_from_json(json.dumps(block), "XTE"))
                send(app, flown[0].body)
            answer = send(app, flown[len(told) + 1].body)
            told.append(answer["tracking"]["prediction"]["rate"])
        finally:
            app.close()
    assert told == ["gyro", "attitudes"]


@pytest.mark.parametrize(
    ("bias_rad_s", "source"), [(1e-4, "gyro"), (1e-6, "body_rates")], ids=["at rest", "turning"]
)
def test_zeros_of_a_gyro_stand_unless_the_attitudes_turn(database, sky, bias_rad_s, source):
    """One batch carries the noise of a body at rest as its rates.

    The attitudes turn by minutes of arc; with a bias of 20 arcsec/s that may be a body at rest.
    """
    mission = tracked(load_missions()["XTE"])
    gyro = GyroSettings(sigma_v_rad_s0_5=1e-6, sigma_u_rad_s1_5=1e-9, bias_sigma_rad_s=bias_rad_s)
    app = open_app(
        Settings(database=database, replay_processes=0), mission.model_copy(update={"gyro": gyro})
    )
    flown = list(fly(load_missions()["XTE"], sky, 3, 3))
    rates = {"body_rates_deg_per_s": [0.0, 0.02, 0.0]}
    try:
        block = {"block": "g1", "start": flown[0].body["time"], "step_s": 1.0}
        block["rates_rad_per_s"] = [[0.0, 0.0, 0.0]] * 61
        app.gyro.record(block_from_json(json.dumps(block), "XTE"))
        answers = [
            send(app, each.body | more) for each, more in zip(flown, ({}, {}, rates), strict=True)
        ]
    finally:
        app.close()
    predictions = [each["tracking"]["prediction"] for each in answers[1:]]
    assert [each["rate"] for each in predictions] == ["gyro", source]
