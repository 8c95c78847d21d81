"""Batches over HTTP: submitted, read, listed, and tried with other options."""

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import httpx
import pytest

URL = "/api/v1/batches"
OTHER = {"options": {"identifier": "starid", "tolerances": {"separation_deg": 0.02}}}


def what_if(client, id, **asked):
    return client.post(f"{URL}/{id}/what-if", json=asked)


def test_a_batch_is_answered_with_201_and_its_address(post, batch, client):
    answer = post(batch)
    assert answer.status_code == 201
    assert answer.headers["Location"] == f"{URL}/{answer.json()['id']}"
    assert answer.json()["counts"]["unique"] == 5
    assert answer.json()["attitude"]["status"] == "good"


def test_what_is_recorded_is_what_was_answered_and_what_was_sent(post, batch, client):
    answer = post(batch)
    record = client.get(answer.headers["Location"]).json()
    assert record["answer"] == answer.json()
    assert record["current"] is True
    assert record["input"]["observations"] == batch["observations"]


def test_the_same_body_again_gives_the_stored_bytes_and_says_so(post, batch):
    first, second = post(batch), post(batch)
    assert (first.status_code, second.status_code) == (201, 200)
    assert "Replayed" not in first.headers
    assert second.headers["Replayed"] == "true"
    assert second.content == first.content


def test_white_space_and_the_order_of_keys_make_no_other_body(post, batch):
    first = post(batch)
    turned = json.dumps(dict(reversed(batch.items())), indent=3).encode()
    again = post(turned)
    assert (again.status_code, again.content) == (200, first.content)


def test_another_body_under_the_same_batch_id_is_a_conflict(post, batch):
    post(batch)
    other = post(batch | {"aberration": "ignore"})
    assert (other.status_code, other.json()["type"]) == (409, "/problems/conflict")
    assert batch["batch"] in other.json()["detail"]


def test_a_key_with_the_same_body_gives_the_first_answer_again(post, batch):
    first = post(batch, Idempotency_Key="k-same-" + batch["batch"])
    again = post(batch, Idempotency_Key="k-same-" + batch["batch"])
    assert (again.status_code, again.content) == (200, first.content)


def test_a_key_with_another_body_is_refused_before_the_batch_id_is_looked_at(post, batch):
    key = "k-other-" + batch["batch"]
    post(batch, Idempotency_Key=key)
    other = post(batch | {"aberration": "ignore"}, Idempotency_Key=key)
    assert (other.status_code, other.json()["type"]) == (422, "/problems/key-reused")


@pytest.mark.parametrize("key", [{}, {"Idempotency-Key": "fifty-at-once"}])
def test_fifty_repeats_at_once_record_one_batch(address, client, batch, run, key):
    body = batch | {"run": run}

    def send(own):
        return own.post(URL, json=body, headers={k: v + run for k, v in key.items()})

    with ExitStack() as open_ones, ThreadPoolExecutor(50) as pool:
        # Made before the burst, so that the posts come at once.
        clients = [
            open_ones.enter_context(httpx.Client(base_url=address, timeout=60)) for _ in range(50)
        ]
        answers = list(pool.map(send, clients))
    assert [each.json()["detail"] for each in answers if each.is_error] == []
    assert sorted(each.status_code for each in answers) == [200] * 49 + [201]
    assert len({each.content for each in answers}) == 1
    assert len(client.get(URL, params={"run": run}).json()["items"]) == 1


def test_batches_of_a_named_run_do_not_show_among_live_ones(post, batch, run, client):
    post(batch | {"run": run})
    live = client.get(URL, params={"limit": 500}).json()["items"]
    assert batch["batch"] not in {each["batch"] for each in live}
    named = client.get(URL, params={"run": run}).json()["items"]
    assert [each["batch"] for each in named] == [batch["batch"]]


@pytest.mark.parametrize("limit", [1, 3, 7, 500])
def test_pages_hold_every_batch_once_newest_first(client, full_run, limit):
    seen, url = [], f"{URL}?run={full_run}&limit={limit}"
    while url:
        page = client.get(url)
        seen += page.json()["items"]
        assert len(page.json()["items"]) <= limit
        url = page.links["next"]["url"] if "next" in page.links else None
        assert (url is None) == (page.json()["next_cursor"] is None)
    times = [each["time"] for each in seen]
    assert len({each["id"] for each in seen}) == len(seen) == 40
    assert times == sorted(times, reverse=True)


def test_a_batch_recorded_between_two_pages_disturbs_neither(client, post, drawn, run):
    for each in drawn("XTE", 6):
        post(each | {"run": run})
    first = client.get(URL, params={"run": run, "limit": 3})
    post(drawn("XTE", 1, start="1999-03-02T00:00:00Z")[0] | {"run": run, "batch": "late"})
    second = client.get(first.links["next"]["url"])
    ids = [each["id"] for each in first.json()["items"] + second.json()["items"]]
    assert len(set(ids)) == 6


def test_filters_keep_what_they_say(client, full_run):
    def asked(**query):
        return client.get(URL, params={"run": full_run, "limit": 500} | query).json()["items"]

    everything = asked()
    ambiguous, none = asked(outcome="ambiguous"), asked(status="none")
    assert 0 < len(ambiguous) < len(everything)
    assert all(each["counts"]["ambiguous"] for each in ambiguous)
    assert all(each["status"] is None and each["reason"] for each in none)
    assert {each["spacecraft"] for each in asked(spacecraft="SOHO")} == {"SOHO"}
    start, end = "1999-060T00:05:00Z", "1999-03-01T01:00:00Z"
    times = [each["time"] for each in asked(start=start, end=end)]
    assert times
    assert all("1999-03-01T00:05:00.000Z" <= time < "1999-03-01T01:00:00.000Z" for time in times)
    assert {e["id"] for e in asked(start=end)} | {e["id"] for e in asked(end=end)} == {
        each["id"] for each in everything
    }


def test_a_what_if_answers_and_leaves_no_trace(post, batch, client):
    id = post(batch).json()["id"]
    before = client.get(f"{URL}/{id}").json()
    tight = {"identifier": "starid", "tolerances": {"separation_deg": 1e-7}}
    answer = what_if(client, id, options=tight)
    assert answer.status_code == 200
    assert "Location" not in answer.headers
    assert (answer.json()["id"], answer.json()["parent"]) == (None, id)
    assert answer.json()["counts"]["unmatched"] == 5
    assert client.get(f"{URL}/{id}").json() == before


def test_a_setting_that_changes_nothing_is_refused_by_name_and_not_offered(
    post, batch, run, client
):
    id = post(batch | {"run": run}).json()["id"]
    idle = {"tests": {"fov_rotation": True}, "tolerances": {"separation_deg": 1e-6}}
    compared = {"spacecraft": batch["spacecraft"], "run": run, "b": idle}
    answers = {
        "options": what_if(client, id, options=idle),
        "b": client.post("/api/v1/compare", json=compared),
    }
    for field, answer in answers.items():
        assert answer.status_code == 422
        for name in ("tests.fov_rotation", "tolerances.separation_deg"):
            assert f"{field}.{name}" in answer.text
        assert "is not used by the identifier verified" in answer.text
    page = client.get(f"/batches/{id}").text
    assert 'name="tolerances.pair_separation_max_deg"' in page
    for left_out in ("tolerances.separation_deg", "tests.fov_rotation", "zone_grid_deg"):
        assert f'name="{left_out}"' not in page
    assert 'name="tolerances.separation_deg"' in client.get(f"/batches/{id}?identifier=starid").text


def test_a_recorded_what_if_stands_beside_the_first_result(post, batch, client):
    id = post(batch).json()["id"]
    answer = what_if(client, id, **OTHER, record=True)
    assert answer.status_code == 201
    record = client.get(answer.headers["Location"]).json()
    assert (record["parent"], record["current"]) == (id, False)
    first = client.get(f"{URL}/{id}").json()
    assert first["current"] is True
    assert [each["id"] for each in first["what_ifs"]] == [answer.json()["id"]]


def test_an_adopted_what_if_becomes_current_and_both_are_kept(post, batch, run, client):
    id = post(batch | {"run": run}).json()["id"]
    adopted = what_if(client, id, **OTHER, adopt=True).json()["id"]
    assert client.get(f"{URL}/{id}").json()["current"] is False
    assert client.get(f"{URL}/{adopted}").json()["current"] is True
    other = post(batch | {"run": run, "batch": "other"}).json()["id"]
    listed = client.get(URL, params={"run": run}).json()["items"]
    assert {each["id"]: each["parent"] for each in listed} == {adopted: id, other: None}
    listed = client.get(URL, params={"run": run, "adopted": True}).json()["items"]
    assert [each["id"] for each in listed] == [adopted]


def test_a_repeat_after_an_adopted_what_if_still_gets_the_first_answer(post, batch, client):
    first = post(batch)
    what_if(client, first.json()["id"], **OTHER, adopt=True)
    assert post(batch).content == first.content


def test_a_failed_solve_says_why_and_shows_no_attitude(post, batch):
    lone = batch["observations"][0] | {"stars": batch["observations"][0]["stars"][:1]}
    answer = post(batch | {"observations": [lone]})
    assert answer.status_code == 201
    assert answer.json()["attitude"] is None
    assert answer.json()["reason"] == "fewer_than_two_unique_stars"
