"""Calibrations over HTTP: estimated beside other work, tried, adopted, taken back, remembered."""

import json
import sqlite3
from contextlib import closing

import httpx
import pytest

from service.app.factory import open_app
from service.features.calibration.estimates import CalibrationRequest
from service.features.calibration.part import Calibrations
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.web.app import create_app
from tests.features.calibration.wrong_file import (
    CALIBRATION,
    TURNED_ARCSEC,
    true_batches,
    with_true_file,
    write_mission_files,
)
from tests.features.webhooks.conftest import LOOPBACK, receiver
from tests.web.conformance import check
from tests.web.serving import Server, ended, in_process_settings

__all__ = ["receiver"]

BEFORE, AFTER = 40, 20
API = "/api/v1"


def serve(folder, database=None):
    missions, database = folder / "assumed", f"sqlite:///{database or folder / 'acquire.db'}"
    return open_app(in_process_settings(database, missions=missions, webhook_networks=LOOPBACK))


@pytest.fixture
def copy(client, folder, tmp_path):
    """A copy of the database, for one service after another: the original is being written to."""
    path = tmp_path / "copy.db"
    with (
        closing(sqlite3.connect(folder / "acquire.db")) as source,
        closing(sqlite3.connect(path)) as target,
    ):
        source.backup(target)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("calibrations")
    write_mission_files(folder)
    return folder


@pytest.fixture(scope="module")
def sky():
    return SkyModel(load_embedded(), LruCache(64 << 20))


@pytest.fixture(scope="module")
def batches(sky):
    return true_batches(sky, BEFORE + AFTER)


@pytest.fixture(scope="module")
def client(folder, batches):
    with (
        Server(create_app(serve(folder))) as address,
        httpx.Client(base_url=address, timeout=60, event_hooks={"response": [check]}) as client,
    ):
        for batch in batches[:BEFORE]:
            client.post(f"{API}/batches", json=batch).raise_for_status()
        yield client


@pytest.fixture(scope="module")
def calibrated(client):
    asked = {"spacecraft": "TWO", "who": "J. Operator"}
    begun = client.post(f"{API}/calibrations", json=asked)
    assert begun.status_code == 202
    assert begun.json()["state"] in ("queued", "running")
    return ended(client, begun)


def test_a_calibration_is_a_versioned_record_of_all_that_was_found(client, calibrated):
    assert (calibrated["state"], calibrated["version"], calibrated["who"]) == (
        "done",
        1,
        "J. Operator",
    )
    assert (calibrated["done"], calibrated["total"]) == (BEFORE, BEFORE)
    found = calibrated["result"]
    own = [each for each in found["unknowns"] if each["kind"] == "magnitude"]
    assert {each["tracker"] for each in own} == {"STARTRACKER_1", "SECOND"}
    # Telemetry is drawn with the magnitudes of the catalog.
    assert all(abs(each["value"]) < 4.5 * each["sigma"] for each in own)
    (turn,) = (each for each in found["unknowns"] if each["name"] == "SECOND alignment z")
    # The bent field counts as alignment in part: see docs/calibration.md.
    assert abs(turn["value"] - TURNED_ARCSEC) < 15.0
    assert turn["sigma"] < 1.0
    assert len(calibrated["covariance"]) == len(found["unknowns"])
    at = found["unknowns"].index(turn)
    assert calibrated["covariance"][at][at] == pytest.approx(turn["sigma"] ** 2)
    assert found["not_observable"][0]["name"] == "absolute alignment"
    assert [each["degree"] for each in found["held_out"] if each["chosen"]] == [found["degree"]]
    assert {each["name"] for each in found["trackers"]} == {"STARTRACKER_1", "SECOND"}
    assert '[[trackers]]\nname = "SECOND"\nx_axis_body = [' in found["mission_file"]
    for each in found["maps"]:
        assert sum(cell["stars"] for cell in each["cells"]) > 150
        rms = [
            sum(part**2 for cell in each["cells"] for part in cell[side]) ** 0.5
            for side in ("before_arcsec", "after_arcsec")
        ]
        assert rms[1] < 0.3 * rms[0]
    (listed,) = client.get(f"{API}/calibrations?spacecraft=TWO").json()["items"]
    assert listed["id"] == calibrated["id"]
    assert listed["unknowns"] == found["unknowns"]


def test_a_trial_tells_what_an_adoption_would_do_and_changes_nothing(client, calibrated):
    before = client.get(f"{API}/spacecraft/TWO/calibration").json()
    tried = client.post(
        f"{API}/calibrations/{calibrated['id']}/trial", json={"sample": BEFORE}
    ).json()
    assert tried["compared"] == BEFORE
    assert tried["a"]["suspect"] > 0.8 * BEFORE
    assert tried["b"]["suspect"] <= 1
    assert tried["b"]["residual_ratio_mean"] < 1.5 < tried["a"]["residual_ratio_mean"]
    assert client.get(f"{API}/spacecraft/TWO/calibration").json() == before
    assert before["calibration"] is None
    assert before["history"] == []


def test_new_batches_are_as_good_as_with_the_true_file_until_it_is_taken_back(
    client, calibrated, batches, sky, receiver
):
    hook = {"name": "changes", "url": receiver.url, "kinds": ["calibration"]}
    client.post(f"{API}/webhooks", json=hook).raise_for_status()
    here = f"{API}/calibrations/{calibrated['id']}/adopt"
    signed = {"who": "J. Operator", "note": "after the first pass"}
    unsigned = client.post(here, json={})
    assert unsigned.status_code == 422
    adopted = client.post(here, json=signed).json()
    assert client.post(here, json=signed).status_code == 409
    in_force = client.get(f"{API}/spacecraft/TWO/calibration").json()
    assert in_force["calibration"] == calibrated["id"]
    assert (in_force["history"][0]["who"], in_force["history"][0]["version"]) == ("J. Operator", 1)

    sent = [client.post(f"{API}/batches", json=each).json() for each in batches[BEFORE:]]
    assert {each["provenance"]["mission"] for each in sent} == {adopted["mission"]}
    poor, ambiguous = with_true_file(sky, batches[BEFORE:])
    attitudes = [each["attitude"] for each in sent]
    assert sum(each is None or each["status"] == "suspect" for each in attitudes) <= poor + 1
    assert sum(each["counts"]["ambiguous"] for each in sent) <= ambiguous + 1

    back = {"who": "J. Operator", "to": None}
    reverted = client.post(f"{API}/spacecraft/TWO/calibration/revert", json=back).json()
    assert reverted["mission"] == calibrated["mission"]
    unknown = client.post(
        f"{API}/spacecraft/TWO/calibration/revert", json=back | {"to": calibrated["id"]}
    )
    assert unknown.status_code == 404
    again = back | {"to": adopted["id"]}
    put_back = client.post(f"{API}/spacecraft/TWO/calibration/revert", json=again).json()
    assert put_back["mission"] == adopted["mission"]
    sent_on = [json.loads(receiver.next().body) for _ in range(3)]
    assert [each["type"] for each in sent_on] == ["calibration"] * 3
    changes = [adopted, reverted, put_back]
    assert [each["data"]["id"] for each in sent_on] == [each["id"] for each in changes]
    assert [each["data"]["mission"] for each in sent_on] == [each["mission"] for each in changes]
    actions = [each["action"] for each in client.get(f"{API}/audit").json()["items"]]
    assert actions[:2] == ["revert_calibration", "revert_calibration"]
    assert actions.count("adopt_calibration") == 3  # two were refused


def test_it_holds_after_a_restart_until_the_file_is_changed(client, calibrated, copy, folder):
    in_force = client.get(f"{API}/spacecraft/TWO/calibration").json()
    app = serve(folder, copy)
    try:
        assert app.missions["TWO"].digest == in_force["mission"]
    finally:
        app.close()
    file = folder / "assumed" / "two.toml"
    text = file.read_text("utf-8")
    try:
        file.write_text(
            text.replace("pair_separation", "# other tolerances\npair_separation"), "utf-8"
        )
        app = serve(folder, copy)
        digest = app.missions["TWO"].digest
        app.close()
        assert digest == in_force["mission"]
        file.write_text(text + CALIBRATION, "utf-8")
        app = serve(folder, copy)
        changed, file_holds = app.missions["TWO"].digest, app.adoptions.in_force("TWO")
        app.close()
        assert changed not in (in_force["mission"], calibrated["mission"])
        assert file_holds.overridden
        assert file_holds.calibration is None
    finally:
        file.write_text(text, "utf-8")


@pytest.mark.parametrize(
    ("more", "field"),
    [
        ({"trackers": ["THIRD"]}, "trackers"),
        ({"degree": 9}, "degree"),
        ({"degree": 0, "alignment": False, "scale": False}, "degree"),
        ({"sample": 0}, "sample"),
        ({"start": "1999-061T00:00:00Z", "end": "1999-060T00:00:00Z"}, "start"),
        ({"spacecraft": "NONE"}, None),
        ({"who": None}, "who"),
    ],
)
def test_mistakes_are_named_before_anything_begins(client, calibrated, more, field):
    asked = {"spacecraft": "TWO", "who": "J. Operator"} | more
    answer = client.post(f"{API}/calibrations", json=asked)
    assert answer.status_code == (404 if field is None else 422)
    assert field is None or field in answer.text
    assert len(client.get(f"{API}/calibrations").json()["items"]) == 1


def test_too_few_stars_end_it_as_failed_and_it_cannot_be_adopted(client):
    asked = {"spacecraft": "TWO", "who": "J. Operator", "run": "empty"}
    location = client.post(f"{API}/calibrations", json=asked).headers["Location"]
    failed = ended(client, location)
    assert failed["state"] == "failed"
    assert "have no identified stars" in failed["fault"]
    assert client.post(f"{location}/adopt", json={"who": "J. Operator"}).status_code == 409
    assert client.post(f"{location}/trial", json={}).status_code == 409


def test_a_stopping_service_leaves_none_that_looks_unfinished(copy, folder):
    app = serve(folder, copy)
    begun = app.part(Calibrations).start(CalibrationRequest("TWO"), "J. Operator")
    app.close()
    app = serve(folder, copy)
    app.part(Calibrations).interrupt()
    left = app.part(Calibrations).get(begun.id)
    app.close()
    assert left.state == "interrupted"
    assert left.ended is not None
    assert left.result is None
