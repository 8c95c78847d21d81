"""Reprocessing with tracking: batches in order of time, each predicted from the one before."""

import json

import pytest

from service.app.factory import open_app
from service.errors import BadBatch
from service.features.archive.part import Reprocessings
from service.gyro.blocks import block_from_json
from service.ingest.reprocess import ReprocessProgress
from service.missions.mission import load_missions
from service.missions.motion import GyroSettings
from service.settings import Settings
from service.storage.queries.results import read_result
from service.storage.upkeep.verify import verify
from service.vectors import quaternion_from_matrix
from tests.tracking.conftest import send
from tests.tracking.passes import tracked

ANSWERED = ("counts", "attitude", "reason", "path", "tracking")


def answers_of(app, run):
    """The answers of a run by batch; results that are named are named by their batches."""
    ids = {each.id: each.batch for each in app.results.page(run=run, limit=100).items}
    found = {}
    for id, batch in sorted(ids.items(), key=lambda each: each[1]):
        with app.store.reading() as connection:
            answer = json.loads(read_result(connection, id)["answer"])
        answer.setdefault("tracking", None)
        prediction = (answer["tracking"] or {}).get("prediction")
        if prediction is not None:
            prediction["result"] = ids[prediction["result"]]
        found[batch] = {name: answer[name] for name in ANSWERED}
    return found


def test_late_batches_are_tracked_in_order_of_time(app, flown):
    for k in (0, 1, 4, 3, 2, 5, 6, 7, 8, 9):
        send(app, flown[k].body)
    in_order = {
        batch: answer["tracking"]["prediction"]["result"]
        for batch, answer in answers_of(app, "live").items()
        if answer["tracking"]["prediction"]
    }
    assert in_order["b00004"] == "b00001"
    for each in flown:
        send(app, each.body, run="in-order")
    progress = app.runs.reprocess("tracked", track=True)
    compared = app.runs.compare("live", "tracked")
    assert (progress.total, progress.recorded, progress.refused) == (10, 10, 0)
    assert compared.batches == 10
    assert answers_of(app, "tracked") == answers_of(app, "in-order")
    assert verify(app.settings.database) == []


def test_what_was_stopped_goes_on_as_if_it_had_not_been(app, flown, monkeypatch):
    for each in flown:
        send(app, each.body)
    app.runs.reprocess("whole", track=True)
    monkeypatch.setattr("service.ingest.reprocess.CHUNK", 4)

    class Stopped(Exception):
        pass

    def stop(progress: ReprocessProgress) -> None:
        if progress.recorded:
            raise Stopped

    with pytest.raises(Stopped):
        app.runs.reprocess("parts", track=True, step=stop)
    with pytest.raises(BadBatch, match="was begun with --track"):
        app.runs.reprocess("parts", processes=1)
    progress = app.runs.reprocess("parts", track=True)
    assert (progress.before, progress.recorded) == (4, 6)
    assert answers_of(app, "parts") == answers_of(app, "whole")


def test_a_run_without_tracking_does_not_continue_with_it(app, flown, tmp_path):
    for each in flown[:3]:
        send(app, each.body)
    app.runs.reprocess("again", processes=1)
    with pytest.raises(BadBatch, match="was begun without --track"):
        app.runs.reprocess("again", track=True)
    app.runs.reprocess("tracked", track=True)
    with pytest.raises(BadBatch, match="was begun with --track"):
        app.part(Reprocessings).reprocess("tracked", tmp_path, processes=1)
    # Without a name the two are two runs.
    assert (
        len({app.runs.reprocess(None, track=track, processes=1).run for track in (False, True)})
        == 2
    )
    assert len(app.runs.all()) == 5


def test_knowledge_of_the_batch_counts_where_nothing_can_be_predicted(app, flown):
    known = {"quaternion": quaternion_from_matrix(flown[0].attitude).tolist()}
    for each in flown[:3]:
        send(app, each.body, a_priori=known)
    app.runs.reprocess("tracked", track=True)
    first, second, third = answers_of(app, "tracked").values()
    assert (first["tracking"], first["path"]) == (None, "zone")
    assert second["tracking"]["prediction"]["result"] == "b00000"
    assert third["tracking"]["prediction"]["result"] == "b00001"
    assert verify(app.settings.database) == []


@pytest.fixture
def with_gyro(database):
    gyro = GyroSettings(sigma_v_rad_s0_5=1e-6, sigma_u_rad_s1_5=1e-9, bias_sigma_rad_s=1e-6)
    mission = tracked(load_missions()["XTE"]).model_copy(update={"gyro": gyro})
    app = open_app(Settings(database=database, replay_processes=0), mission)
    yield app
    app.close()


def test_the_gyro_is_that_of_the_run_that_is_read(with_gyro, flown):
    app = with_gyro
    rates = [flown[k // 30].rate_rad_s.tolist() for k in range(61)]
    body = {"block": "g", "start": flown[0].body["time"], "step_s": 1.0, "rates_rad_per_s": rates}
    app.gyro.record(block_from_json(json.dumps(body), "XTE"))
    for each in flown[:3]:
        send(app, each.body)
    app.runs.reprocess("tracked", track=True)
    answers = answers_of(app, "tracked")
    assert [each["tracking"]["prediction"]["rate"] for each in list(answers.values())[1:]] == [
        "gyro",
        "gyro",
    ]
    assert answers == answers_of(app, "live")
