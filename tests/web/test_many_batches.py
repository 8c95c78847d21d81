"""An array of batches: each has its own outcome, and counts like a request of its own."""

import json
from types import SimpleNamespace

import httpx
import pytest

from service.access import LEAST_BURST, Access, Caller
from service.errors import RateLimited

URL = "/api/v1/batches"
MANY = f"{URL}/many"
JSON = {"Content-Type": "application/json"}


@pytest.fixture
def batches(drawn, run):
    return [each | {"run": run} for each in drawn("XTE", 6)]


def sent(client, batches):
    answer = client.post(MANY, json=batches)
    assert answer.status_code == 200, answer.text
    return answer.json()["items"]


def statuses(items):
    return [each["status"] for each in items]


def test_every_batch_is_answered_in_its_place_as_it_is_recorded(client, batches):
    items = sent(client, batches)
    assert statuses(items) == 6 * [201]
    assert [each["answer"]["batch"] for each in items] == [each["batch"] for each in batches]
    for each in items:
        assert client.get(f"{URL}/{each['answer']['id']}").json()["answer"] == each["answer"]


def test_an_array_that_is_sent_again_gets_the_stored_answers(client, post, batches):
    alone = post(batches[2])
    first, second = sent(client, batches), sent(client, batches)
    assert statuses(first) == [201, 201, 200, 201, 201, 201]
    assert first[2]["answer"] == alone.json()
    assert statuses(second) == 6 * [200]
    assert [each["answer"] for each in second] == [each["answer"] for each in first]


def test_a_batch_that_is_there_twice_is_recorded_once(client, batches):
    one, other = sent(client, [batches[0], batches[0]])
    assert sorted(statuses([one, other])) == [200, 201]
    assert one["answer"] == other["answer"]


def test_a_refused_batch_has_the_problem_that_it_would_have_alone(client, post, batches):
    bad = [
        batches[0] | {"time": "noon", "colour": "red"},
        batches[0] | {"spacecraft": "NOPE"},
        batches[1] | {"aberration": "ignore"},
        17,
        None,
        [],
    ]
    post(batches[1])
    items = sent(client, [batches[0], *bad, batches[2]])
    assert statuses(items) == [201, 422, 422, 409, 422, 422, 422, 201]
    for body, item in zip(bad, items[1:-1], strict=True):
        alone = post(json.dumps(body).encode())
        assert item["answer"] is None
        assert item["problem"] == alone.json() | {"instance": MANY}


@pytest.mark.parametrize("text", ["NaN", "-Infinity", "1e999"])
def test_a_number_that_is_none_is_the_fault_of_its_batch_alone(client, batches, text):
    body = json.dumps([batches[0], batches[1] | {"body_rates_deg_per_s": [0, 0, "here"]}])
    answer = client.post(MANY, content=body.replace('"here"', text), headers=JSON)
    good, bad = answer.json()["items"]
    assert (good["status"], bad["status"]) == (201, 422)
    assert bad["problem"]["errors"][0]["field"] == "body_rates_deg_per_s.2"


@pytest.mark.parametrize(
    ("body", "status"),
    [
        (b"[]", 422),
        (b"{}", 422),
        (json.dumps(101 * [{}]).encode(), 422),
        (b"[{}", 400),
        (b"", 400),
        (1_000_000 * b"[", 400),
        (b"[" + 3_000_000 * b" " + b"]", 413),
    ],
    ids=["empty", "object", "101", "cut off", "nothing", "deep", "large"],
)
def test_a_body_that_is_no_array_of_one_to_a_hundred_is_refused(client, body, status):
    assert client.post(MANY, content=body, headers=JSON).status_code == status


def test_a_hundred_are_taken(client, drawn, run):
    items = sent(client, [each | {"run": run} for each in drawn("SWAS", 100)])
    assert statuses(items) == 100 * [201]


def test_a_key_belongs_to_one_batch(client, batches):
    answer = client.post(MANY, json=batches, headers={"Idempotency-Key": "a"})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["field"] == "Idempotency-Key"


def test_an_array_counts_as_many_requests_as_it_has_batches():
    access = Access(reading=None, change=None, loopback=False, now=None)
    caller = Caller("pipeline", frozenset({"submit"}), token_id="1", rate_per_s=0.5)
    access.count_request(caller)
    access.count_request(caller, 99)
    with pytest.raises(RateLimited) as refused:
        access.count_request(caller)
    # A hundred at one in two seconds, less the burst.
    assert refused.value.retry_after_s == pytest.approx((100 - LEAST_BURST + 1) / 0.5, abs=2)


def test_a_burst_comes_at_once_and_no_request_more(monkeypatch):
    monkeypatch.setattr("service.access.time", SimpleNamespace(monotonic=lambda: 1000.0))
    access = Access(reading=None, change=None, loopback=False, now=None)
    caller = Caller("pipeline", frozenset({"submit"}), token_id="1", rate_per_s=0.5)
    for _ in range(int(LEAST_BURST)):
        access.count_request(caller)
    with pytest.raises(RateLimited):
        access.count_request(caller)


def test_an_array_waits_for_the_burst():
    access = Access(reading=None, change=None, loopback=False, now=None)
    caller = Caller("pipeline", frozenset({"submit"}), token_id="1", rate_per_s=0.5)
    access.count_request(caller)
    access.count_request(caller)
    with pytest.raises(RateLimited):
        access.count_request(caller, 99)
    access.count_request(caller, 2)


# ---- the newest result, and the one of a batch id ------------------------------------------------


def test_the_latest_result_is_that_of_the_newest_batch_time(client, batches):
    run = batches[0]["run"]
    items = sent(client, [batches[-1], *batches[:-1]])
    answer = client.get("/api/v1/spacecraft/XTE/latest", params={"run": run})
    assert answer.json()["answer"] == items[0]["answer"]
    assert answer.headers["Content-Location"] == f"{URL}/{items[0]['answer']['id']}"
    asked = {"options": {"solver": "triad"}, "adopt": True}
    adopted = client.post(f"{answer.headers['Content-Location']}/what-if", json=asked).json()
    again = client.get("/api/v1/spacecraft/XTE/latest", params={"run": run}).json()
    assert again["answer"]["id"] == adopted["id"]


@pytest.mark.parametrize("path", ["XTE/latest?run=nothing-yet", "NOPE/latest"])
def test_without_a_batch_there_is_no_latest_result(client, path):
    assert client.get(f"/api/v1/spacecraft/{path}").status_code == 404


def test_a_result_is_found_by_the_batch_id_of_its_sender(client, batches):
    odd = batches[0] | {"batch": "pass 7/é#1?&=+"}
    items = sent(client, [*batches, odd])
    elsewhere = odd | {"run": f"{odd['run']}-2"}
    (other,) = sent(client, [elsewhere])

    def found(**asked):
        query = {"spacecraft": "XTE", "batch": odd["batch"]} | asked
        return [each["id"] for each in client.get(URL, params=query).json()["items"]]

    assert found(run=odd["run"]) == [items[-1]["answer"]["id"]]
    assert sorted(found(run="*")) == sorted([items[-1]["answer"]["id"], other["answer"]["id"]])
    assert found(run=odd["run"], spacecraft="SWAS") == []
    assert found(run=odd["run"], batch="another") == []
    assert found(run=odd["run"], start="2090-001T00:00:00Z") == []


def test_a_batch_id_alone_is_refused(client):
    answer = client.get(URL, params={"batch": "one"})
    assert answer.status_code == 422
    assert "needs spacecraft" in answer.json()["detail"]


def test_arrays_side_by_side_record_each_batch_once(address, client, batches):
    """The same batches in another order, while the first are computed."""
    with httpx.Client(base_url=address, timeout=60) as other:
        assert {each["status"] for each in sent(client, batches)} == {201}
        assert {each["status"] for each in sent(other, batches[::-1])} == {200}
