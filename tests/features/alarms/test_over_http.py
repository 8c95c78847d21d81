"""Limits and alarms over HTTP: what people do, who they are, and what is refused."""

import pytest
from prometheus_client.parser import text_string_to_metric_families

from tests.web.conformance import checked
from tests.web.serving import serving_in_process

LIMITS = "/api/v1/spacecraft/XTE/limits"
TIGHT = {"warning": {"high": 0.5}, "minimum_count": 1, "duration_s": 0}


@pytest.fixture(scope="module")
def service(chosen_database):
    """A service of this module's own: its limits would be in the way of other tests."""
    with serving_in_process(chosen_database()) as service:
        yield service


@pytest.fixture(scope="module")
def client(service):
    return checked(service.client)


@pytest.fixture(scope="module")
def alarm(client, service):
    """An open alarm of a run of its own."""
    asked = {"settings": TIGHT, "who": "jb"}
    assert client.put(f"{LIMITS}/no_attitude_share", json=asked).status_code == 200
    assert client.put("/api/v1/runs/watched", json={"alarms": True}).status_code == 200
    (lone,) = service.draw("XTE", 1, stars=1)
    client.post("/api/v1/batches", json=lone | {"run": "watched"}).raise_for_status()
    (found,) = client.get("/api/v1/alarms?run=watched").json()["items"]
    return found


def test_an_alarm_leads_to_the_batch_that_raised_it(client, alarm):
    record = client.get(f"/api/v1/batches/{alarm['raised']['batch_id']}").json()
    assert record["answer"]["time"] == alarm["raised"]["time"]
    shown = client.get("/api/v1/overview?run=watched").json()
    assert shown["alarms"]["open"] == 1
    xte = next(each for each in shown["items"] if each["name"] == "XTE")
    assert [each["id"] for each in xte["alarms"]] == [alarm["id"]]


def test_who_does_something_must_say_who_they_are(client, alarm):
    answer = client.post(f"/api/v1/alarms/{alarm['id']}/acknowledge", json={})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "who"


def test_what_is_done_twice_is_told_of_and_changes_nothing(client, alarm):
    here = f"/api/v1/alarms/{alarm['id']}"
    assert client.post(f"{here}/acknowledge", json={"who": "jb"}).json()["state"] == "acknowledged"
    again = client.post(f"{here}/acknowledge", json={"who": "mk"})
    assert (again.status_code, again.json()["type"]) == (409, "/problems/not-now")
    assert client.get(here).json()["acknowledged"]["who"] == "jb"


@pytest.mark.parametrize(
    ("path", "body"),
    [
        ("shelve", {"who": "jb"}),
        ("shelve", {"who": "jb", "minutes": 0}),
        ("acknowledge", {"who": "j\x00b"}),
        ("acknowledge", {"who": "jb", "comment": "a\x00b"}),
        ("comment", {"who": "jb", "comment": "a\x00b"}),
        ("shelve", {"who": "jb", "minutes": 100_000}),
        ("comment", {"who": "jb"}),
        ("comment", {"who": "jb", "comment": "x" * 3000}),
        ("acknowledge", {"who": ""}),
        ("acknowledge", {"who": "jb", "colour": "red"}),
    ],
)
def test_what_makes_no_sense_is_refused_with_its_field(client, alarm, path, body):
    answer = client.post(f"/api/v1/alarms/{alarm['id']}/{path}", json=body)
    assert answer.status_code == 422
    assert answer.json()["errors"]


@pytest.mark.parametrize(
    "settings",
    [
        {"warning": {"high": 2}, "critical": {"high": 1}},
        {"warning": {"high": "much"}},
        {"minimum_count": 0},
        {"colour": "red"},
        {"hysteresis": "1e999"},
    ],
)
def test_limits_that_make_no_sense_are_refused_with_their_field(client, settings):
    asked = {"settings": settings, "who": "jb"}
    answer = client.put(f"{LIMITS}/ambiguous_share", json=asked)
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"].startswith("settings")


def test_what_is_not_there_is_not_found(client):
    assert client.get(f"{LIMITS}/colour").status_code == 404
    assert client.get(f"{LIMITS}/batches_per_hour").status_code == 404
    assert client.get("/api/v1/spacecraft/NOPE/limits").status_code == 404
    assert client.get("/api/v1/alarms/01JD0000000000000000000001").status_code == 404
    assert (
        client.post("/api/v1/alarms/x/comment", json={"who": "a", "comment": "b"}).status_code
        == 404
    )


def test_a_limit_goes_back_to_what_was_shipped(client):
    place = f"{LIMITS}/suspect_share"
    asked = {"settings": TIGHT, "who": "jb", "comment": "try"}
    assert not client.put(place, json=asked).json()["is_default"]
    assert client.delete(place, params={"who": "mk"}).json()["is_default"]
    found = client.get(place).json()
    assert [each["who"] for each in found["history"]] == ["mk", "jb"]
    assert found["limit"]["settings"] == found["default"]


def test_live_batches_are_always_watched(client):
    answer = client.put("/api/v1/runs/live", json={"alarms": False})
    assert answer.status_code == 422


def test_live_alarms_are_counted_for_prometheus(client, service):
    """None but those of live batches, each under how bad it is and where it stands."""

    def counted():
        text = client.get("/metrics").text
        (family,) = [f for f in text_string_to_metric_families(text) if f.name == "starid_alarms"]
        of_swas = [s for s in family.samples if s.labels["spacecraft"] == "SWAS"]
        assert len(of_swas) == 9
        return {(s.labels["severity"], s.labels["state"]) for s in of_swas if s.value == 1}

    asked = {"settings": TIGHT, "who": "jb"}
    url = "/api/v1/spacecraft/SWAS/limits/no_attitude_share"
    assert client.put(url, json=asked).status_code == 200
    assert counted() == set()
    (lone,) = service.draw("SWAS", 1, stars=1)
    client.put("/api/v1/runs/apart", json={"alarms": True}).raise_for_status()
    client.post("/api/v1/batches", json=lone | {"run": "apart"}).raise_for_status()
    assert counted() == set()
    client.post("/api/v1/batches", json=lone).raise_for_status()
    assert counted() == {("warning", "open")}
    (alarm,) = client.get("/api/v1/alarms?spacecraft=SWAS").json()["items"]
    client.post(f"/api/v1/alarms/{alarm['id']}/acknowledge", json={"who": "jb"}).raise_for_status()
    assert counted() == {("warning", "acknowledged")}


def test_a_preview_sets_nothing_and_names_what_is_wrong(client, alarm):
    here = f"{LIMITS}/no_attitude_share"
    before = client.get(here).json()
    tried = {"settings": TIGHT | {"warning": {"high": 1.5}}}
    told = client.post(f"{here}/preview?run=watched", json=tried)
    assert told.status_code == 200, told.text
    assert (told.json()["proposed"]["alarms"], told.json()["in_force"]["alarms"]) == (0, 1)
    assert told.json()["in_force"]["settings"] == before["limit"]["settings"]
    assert client.get(here).json() == before
    for query, body, field in (
        ("?days=0", tried, "days"),
        ("?tracker=STARTRACKER_9", tried, "tracker"),
        ("", {"settings": {"warning": {"high": "x"}}}, "settings.warning.high"),
        ("", {}, "settings"),
    ):
        answer = client.post(f"{here}/preview{query}", json=body)
        assert answer.status_code == 422
        assert [each["field"] for each in answer.json()["errors"]] == [field]
    assert client.post(f"{LIMITS}/colour/preview", json=tried).status_code == 404
