"""Spacecraft, zones, runs and replays over HTTP."""

import json
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest

from tests.web.serving import ended

API = "/api/v1"
NDJSON = {"Content-Type": "application/x-ndjson"}

# ---- spacecraft ----------------------------------------------------------------------------------


def test_every_shipped_mission_is_listed(client):
    names = [each["name"] for each in client.get(f"{API}/spacecraft").json()["items"]]
    assert {"XTE", "SWAS", "SOHO"} <= set(names)


def test_a_spacecraft_shows_its_settings_their_history_and_its_state(client, post, batch):
    id = post(batch | {"time": "2019-01-10T12:00:00.000Z"}).json()["id"]
    state = client.get(f"{API}/spacecraft/XTE").json()
    assert state["mission"]["settings"]["zone"]["radius_deg"] == 10.66
    assert state["history"][-1]["digest"] == state["mission"]["digest"]
    assert state["latest_batch"]["id"] == id
    assert state["state"] == (state["latest_batch"]["status"] or "no_attitude")


def test_a_failed_solve_is_the_present_state_and_no_older_attitude_stands_in_for_it(
    client, post, batch
):
    post(batch | {"time": "2020-01-10T12:00:00.000Z"})
    lone = batch["observations"][0] | {"stars": batch["observations"][0]["stars"][:1]}
    failed = batch | {"time": "2021-01-10T12:00:00.000Z", "observations": [lone]}
    post(failed | {"batch": batch["batch"] + "-failed"})
    state = client.get(f"{API}/spacecraft/XTE").json()
    assert state["state"] == "no_attitude"
    assert state["latest_batch"]["reason"] == "fewer_than_two_unique_stars"
    assert state["attitude"] is None
    assert state["last_attitude"]["time"] < state["latest_batch"]["time"]


def test_attitudes_come_oldest_first_in_pages(client, full_run):
    seen, url = [], f"{API}/spacecraft/XTE/attitudes?run={full_run}&limit=6"
    while url:
        page = client.get(url)
        seen += page.json()["items"]
        url = page.links["next"]["url"] if "next" in page.links else None
    times = [each["time"] for each in seen]
    assert len({each["id"] for each in seen}) == len(seen) > 10
    assert times == sorted(times)


@pytest.mark.parametrize("bucket", ["hour", "day"])
def test_rates_add_up_to_the_batches_they_are_of(client, full_run, bucket):
    query = {"run": full_run, "bucket": bucket}
    rates = client.get(f"{API}/spacecraft/SOHO/rates", params=query).json()["items"]
    query = {"run": full_run, "spacecraft": "SOHO", "limit": 500}
    batches = client.get(f"{API}/batches", params=query).json()["items"]
    for outcome in ("observed", "unique", "ambiguous", "unmatched"):
        listed = sum(each["counts"][outcome] for each in batches)
        assert sum(each[outcome] for each in rates) == listed
    assert sum(each["batches"] for each in rates) == len(batches) == 20


# ---- zones ---------------------------------------------------------------------------------------


def test_zones_are_warmed_met_and_dropped(client, post, batch):
    client.delete(f"{API}/zones")
    asked = {"spacecraft": "XTE", "time": batch["time"], "a_priori": [batch["a_priori"]]}
    (warmed,) = client.post(f"{API}/zones", json=asked).json()["items"]
    (cached,) = client.get(f"{API}/zones").json()["items"]
    assert (cached["stars"], cached["spacecraft"]) == (warmed["stars"], "XTE")
    assert post(batch).json()["observations"][0]["zone"]["cached"] is True
    assert client.delete(f"{API}/zones?spacecraft=SOHO").json() == {"dropped": 0}
    assert client.delete(f"{API}/zones?spacecraft=XTE").json() == {"dropped": 1}
    assert (
        post(batch | {"run": batch["batch"]}).json()["observations"][0]["zone"]["cached"] is False
    )


def test_fifty_first_requests_at_once_build_the_zone_once(client, address, batch, run):
    client.delete(f"{API}/zones")
    before = client.get(f"{API}/zones").json()["misses"]

    def send(number):
        with httpx.Client(base_url=address, timeout=60) as own:
            body = batch | {"run": run, "batch": f"b{number}"}
            return own.post(f"{API}/batches", json=body).status_code

    with ThreadPoolExecutor(50) as pool:
        assert set(pool.map(send, range(50))) == {201}
    state = client.get(f"{API}/zones").json()
    assert state["misses"] == before + 1
    assert len(state["items"]) == 1


# ---- runs and replays ----------------------------------------------------------------------------


def test_a_replay_goes_on_after_a_bad_line_and_reports_its_number(client, drawn, run):
    lines = [json.dumps(each) for each in drawn("XTE", 4)]
    lines[1:1] = ['{"truncated', "", json.dumps(drawn("XTE", 1)[0] | {"spacecraft": "NOPE"})]
    content = "\n".join(lines).encode()
    answer = client.post(f"{API}/replays?run={run}", content=content, headers=NDJSON)
    assert answer.status_code == 202
    state = ended(client, answer)
    assert (state["state"], state["lines"]["done"], state["lines"]["refused"]) == ("done", 7, 2)
    assert [each["line"] for each in state["errors"]] == [2, 4]
    assert len(client.get(f"{API}/batches?run={run}").json()["items"]) == 4
    (row,) = [each for each in client.get(f"{API}/runs").json()["items"] if each["run"] == run]
    assert row["batches"] == 4


def test_a_replay_run_twice_records_once(client, drawn, run):
    content = "\n".join(json.dumps(each) for each in drawn("SOHO", 3)).encode()
    for _ in range(2):
        answer = client.post(f"{API}/replays?run={run}", content=content, headers=NDJSON)
        state = ended(client, answer)
        assert (state["lines"]["done"], state["lines"]["refused"]) == (3, 0)
    assert len(client.get(f"{API}/batches?run={run}").json()["items"]) == 3


def test_a_replay_can_be_sent_as_plain_bytes(client, drawn, run):
    """As a generated client sends it, which knows no type of lines."""
    content = "\n".join(json.dumps(each) for each in drawn("XTE", 2)).encode()
    headers = {"Content-Type": "application/octet-stream"}
    answer = client.post(f"{API}/replays?run={run}", content=content, headers=headers)
    assert answer.status_code == 202
    assert ended(client, answer)["lines"]["done"] == 2


def test_a_line_without_end_is_one_bad_line(client, drawn, run):
    good = json.dumps(drawn("XTE", 1)[0]).encode()
    content = b"\n".join([good, b'{"a": "' + b"x" * 5_000_000, good])
    answer = client.post(f"{API}/replays?run={run}", content=content, headers=NDJSON)
    state = ended(client, answer)
    assert [each["line"] for each in state["errors"]] == [2]
    assert state["lines"]["done"] == 3


@pytest.mark.parametrize(
    ("query", "content", "headers", "status", "field"),
    [
        ("", b"{}", NDJSON, 422, "run"),
        ("?run=a/b", b"{}", NDJSON, 422, "run"),
        ("?run=a&speed=2", b"{}", NDJSON, 422, "speed"),
        ("?run=a", b"", NDJSON, 422, "body"),
        ("?run=a", b"\x00\xff\xfe\nnot json\n", NDJSON, 422, "body"),
        ("?run=a", b"{\n}\n", NDJSON, 422, "body"),
        ("?run=a", b"{}", {"Content-Type": "text/csv"}, 422, "body"),
        ("?run=a", b"{}", {"Content-Type": "text/plain"}, 415, None),
        ("?run=a", b"{}", NDJSON | {"Content-Encoding": "br"}, 415, None),
    ],
)
def test_a_replay_that_cannot_begin_is_refused(client, query, content, headers, status, field):
    answer = client.post(f"{API}/replays{query}", content=content, headers=headers)
    assert answer.status_code == status
    assert field is None or answer.json()["errors"][0]["field"] == field


def test_lines_that_are_no_telemetry_are_refused_line_by_line(client, run):
    content = b"{\x00\xff\xfe\nnot json\n\xef\xbb\xbf{}\n[1, 2]\n"
    answer = client.post(f"{API}/replays?run={run}", content=content, headers=NDJSON)
    state = ended(client, answer)
    assert [each["line"] for each in state["errors"]] == [1, 2, 3, 4]


@pytest.mark.parametrize(
    ("body", "lines"), [(b"{}\n{}\n", 2), (b"{}\n{}", 2), (b"\n\n{}\n", 3), (b"{}", 1)]
)
def test_the_lines_of_a_replay_are_counted_beforehand(client, run, body, lines):
    headers = {"Content-Type": "application/x-ndjson"}
    begun = client.post(f"{API}/replays?run={run}", content=body, headers=headers)
    assert begun.json()["lines"]["total"] == lines
    assert ended(client, begun)["lines"]["done"] == lines
