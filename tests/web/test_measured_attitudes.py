"""Attitudes that trackers measured themselves, over HTTP: sent, repeated, shown, exported."""

import json

import pytest

from tests.web.test_bulk import replayed

URL = "/api/v1/batches"
QUATERNION = [0.1, 0.2, 0.3, 0.9273618495495703]
NULLS = (
    "residual_rms_arcsec",
    "predicted_rms_arcsec",
    "taste",
    "triad",
    "quest",
    "triad_quest_angle_arcsec",
)


@pytest.fixture
def measured(run):
    """A batch of XTE that holds an attitude, in a run of its own."""
    return {
        "spacecraft": "XTE",
        "batch": f"q-{run}",
        "run": run,
        "time": "1996-01-10T12:00:00Z",
        "measurement": {"quaternion": QUATERNION, "sigma_arcsec": [6.0, 6.0, 40.0]},
        "a_priori": None,
    }


def test_it_is_recorded_as_a_good_attitude_without_stars(post, client, measured):
    answer = post(measured)
    assert answer.status_code == 201, answer.text
    told = answer.json()
    assert (told["path"], told["observations"], told["counts"]["observed"]) == ("measured", [], 0)
    attitude = told["attitude"]
    assert (attitude["method"], attitude["status"]) == ("measured", "good")
    assert attitude["quaternion"] == pytest.approx(QUATERNION)
    assert [attitude[name] for name in NULLS] == [None] * 6
    record = client.get(answer.headers["Location"]).json()
    assert record["answer"] == told
    assert record["input"]["measurement"] == measured["measurement"]
    assert record["measures"]["residual_rms_arcsec"] is None
    again = client.post(f"{URL}/{told['id']}/what-if", json={})
    assert again.json()["attitude"] == attitude
    refused = client.post(f"{URL}/{told['id']}/what-if", json={"options": {"solver": "triad"}})
    assert refused.status_code == 422
    assert refused.json()["errors"][0]["field"] == "options"


def test_the_same_again_gives_the_stored_answer_and_another_is_a_conflict(post, measured):
    first, second = post(measured), post(measured)
    assert (first.status_code, second.status_code) == (201, 200)
    assert second.headers["Replayed"] == "true"
    assert second.content == first.content
    other = measured["measurement"] | {"sigma_arcsec": [7.0, 6.0, 40.0]}
    assert post(measured | {"measurement": other}).status_code == 409


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("quaternion", [0.0, 0.0, 0.0, 1.002], "measurement.quaternion"),
        ("quaternion", [float("nan"), 0.0, 0.0, 1.0], "measurement.quaternion.0"),
        ("sigma_arcsec", [6.0, 6.0, -1.0], "measurement.sigma_arcsec.2"),
        ("tracker", "NO_SUCH", "measurement.tracker"),
    ],
)
def test_a_bad_one_is_refused_by_field_and_nothing_is_recorded(
    post, client, measured, run, field, value, named
):
    answer = post(measured | {"measurement": measured["measurement"] | {field: value}})
    assert answer.status_code == 422
    assert named in {each["field"] for each in answer.json()["errors"]}
    assert client.get(URL, params={"run": run}).json()["items"] == []


def test_one_without_measurement_and_stars_is_refused(post, measured):
    answer = post({name: value for name, value in measured.items() if name != "measurement"})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "observations"


def test_options_are_compared_and_advice_given_although_some_batches_are_measured(
    post, client, measured, batch, run
):
    for body in (measured, batch | {"run": run}):
        assert post(body).status_code == 201
    asked = {"spacecraft": "XTE", "run": run, "b": {"solver": "triad"}}
    answer = client.post("/api/v1/compare", json=asked)
    assert answer.status_code == 200, answer.text
    told = answer.json()
    assert (told["compared"], told["attitudes"]["both"]) == (2, 2)
    assert measured["batch"] not in {each["batch"] for each in told["changed"]}
    advice = client.get("/api/v1/spacecraft/XTE/advice", params={"run": run})
    assert advice.status_code == 200, advice.text
    assert advice.json()["batches_sampled"] == 2


def test_its_page_says_that_there_are_no_stars(post, client, measured):
    id = post(measured).json()["id"]
    page = client.get(f"/batches/{id}")
    assert page.status_code == 200
    assert "no stars to show" in page.text
    assert "MEASURED (used)" in page.text
    for path in ("/batches", f"/spacecraft/XTE?run={measured['run']}"):
        assert client.get(path).status_code == 200


def test_it_is_exported_and_listed_as_a_raw_attitude(post, client, measured, run):
    id = post(measured).json()["id"]
    asked = {"run": run, "format": "json"}
    (row,) = client.get("/api/v1/spacecraft/XTE/attitude", params=asked).json()["items"]
    assert (row["method"], row["residual_rms_arcsec"]) == ("measured", None)
    assert row["quaternion"] == pytest.approx(QUATERNION)
    (listed,) = client.get("/api/v1/spacecraft/XTE/attitude", params={"run": run}).json()["items"]
    assert listed["id"] == id
    for form in ("acm", "aem", "csv", "fits", "parquet"):
        text = client.get("/api/v1/spacecraft/XTE/attitude", params={"run": run, "format": form})
        assert text.status_code == 200, (form, text.text)


def test_lines_of_a_telemetry_file_may_hold_them(client, measured, batch, run):
    lines = [measured, batch | {"run": run}, measured | {"batch": "q-2", "measurement": {}}]
    state = replayed(client, run, "\n".join(map(json.dumps, lines)).encode())
    assert state["counts"]["new"] == 2
    assert state["errors"][0]["line"] == 3
