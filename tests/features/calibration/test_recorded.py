"""Calibrations on either database: recorded, tried, adopted, used again, and taken back."""

import json

import pytest

from service.errors import NotFound, WrongState
from service.features.calibration.estimates import CalibrationRequest
from service.features.calibration.part import Calibrations
from service.observations.schema import submission_from_json
from tests.features.calibration.wrong_file import TURNED_ARCSEC, true_batches, write_mission_files
from tests.storage.conftest import opened

__all__ = ["opened"]

BATCHES = 30
WHO = "J. Operator"


@pytest.fixture
def folder(tmp_path):
    write_mission_files(tmp_path)
    return tmp_path / "assumed"


@pytest.fixture
def app(opened, folder, sky):
    app = opened(missions=folder)
    batches = [submission_from_json(json.dumps(each)) for each in true_batches(sky, BATCHES)]
    answers = app.submissions.submit_many(batches)
    assert not any(isinstance(each, Exception) for each in answers)
    return app


def recorded(app):
    wanted = CalibrationRequest("TWO")
    return app.part(Calibrations).record(wanted, app.part(Calibrations).of_spacecraft(wanted), WHO)


def told(app, first):
    return [
        json.loads(each.data)
        for each in app.events.after(first, 1000)
        if each.kind == "calibration"
    ]


def test_what_is_recorded_is_read_again_and_tried(app):
    found = recorded(app)
    assert app.part(Calibrations).get(found.id) == found
    assert (found.version, found.state, found.who) == (1, "done", WHO)
    assert found.result.batches.used == BATCHES
    assert len(found.covariance) == len(found.result.unknowns)
    kinds = {each.kind for each in found.result.unknowns}
    assert {"alignment", "scale", "magnitude"} <= kinds
    second = recorded(app)
    assert second.version == 2
    assert [each.version for each in app.part(Calibrations).page("TWO").items] == [2, 1]
    tried = app.part(Calibrations).trial(found.id, sample=BATCHES)
    assert tried.compared == BATCHES
    assert tried.b.suspect <= 1 < tried.a.suspect


def test_each_change_is_in_force_at_once_after_a_restart_and_an_event(app, opened, folder):
    file = app.missions["TWO"].digest
    found = recorded(app)
    first = app.events.last()
    adopted = app.part(Calibrations).adopt(found.id, WHO, "after the first pass")
    assert app.missions["TWO"].digest == adopted.mission != file
    with pytest.raises(WrongState):
        app.part(Calibrations).adopt(found.id, WHO)
    app.close()
    app = opened(missions=folder)
    assert app.missions["TWO"].digest == adopted.mission
    back = app.adoptions.revert("TWO", None, WHO)
    assert app.missions["TWO"].digest == back.mission == file
    with pytest.raises(NotFound):
        app.adoptions.revert("TWO", found.id, WHO)
    again = app.adoptions.revert("TWO", adopted.id, WHO)
    assert again.mission == adopted.mission
    in_force = app.adoptions.in_force("TWO")
    assert in_force.calibration == found.id
    assert [each.id for each in in_force.history] == [again.id, back.id, adopted.id]

    events = told(app, first)
    assert [each["id"] for each in events] == [adopted.id, back.id, again.id]
    assert [each["calibration"] for each in events] == [found.id, None, found.id]
    assert [each["version"] for each in events] == [1, None, 1]
    assert events[0]["mission"] == adopted.mission
    assert (events[0]["who"], events[0]["note"]) == (WHO, "after the first pass")
    assert {each["spacecraft"] for each in events} == {"TWO"}


def test_a_start_without_the_feature_names_what_stays_in_force(app, opened, folder, caplog):
    adopted = app.part(Calibrations).adopt(recorded(app).id, WHO)
    app.close()
    app = opened(missions=folder, features_off="calibration")
    assert app.missions["TWO"].digest == adopted.mission
    assert "adopted calibrations stay in force for TWO" in caplog.text


def test_reprocessing_uses_what_was_adopted_and_the_record_stays_as_it_was(app):
    found = recorded(app)
    before = app.spacecraft.history("TWO", quantities=["suspect_share"], strategy="latest").series
    assert sum(before["suspect_share"].value) > 0.8 * BATCHES
    adopted = app.part(Calibrations).adopt(found.id, WHO)
    progress = app.runs.reprocess("calibrated", spacecraft="TWO", processes=1)
    assert (progress.recorded, progress.refused) == (BATCHES, 0)
    after = app.spacecraft.history(
        "TWO",
        run="calibrated",
        quantities=["suspect_share", "alignment_offset_arcsec"],
        strategy="latest",
    ).series
    assert sum(after["suspect_share"].value) <= 1
    offsets = after["alignment_offset_arcsec"].value
    assert abs(sum(offsets) / len(offsets)) < 0.02 * TURNED_ARCSEC
    items = app.results.page(run="calibrated").items
    assert {app.results.get(each.id).answer.provenance.mission for each in items} == {
        adopted.mission
    }
    still = app.spacecraft.history("TWO", quantities=["suspect_share"], strategy="latest").series
    assert still["suspect_share"].value == before["suspect_share"].value
