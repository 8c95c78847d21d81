"""Gyro blocks over HTTP: sent once or often, refused by name, and read back."""

import csv
import io
import json
from concurrent.futures import ThreadPoolExecutor
from itertools import count

import httpx
import numpy as np
import pyarrow.parquet as parquet
import pytest

from service.gyro.blocks import SAME_TIME_NS
from service.times import parse_utc as utc
from service.times import shifted
from tests.gyro.blocks import START, body

HERE = "/api/v1/spacecraft/XTE/gyro"
TABLE = "/api/v1/spacecraft/XTE/tables/gyro"

_numbers = count(1)


@pytest.fixture
def run():
    """The name of a run that nothing else writes to."""
    return f"run-{next(_numbers)}"


def later(seconds):
    return shifted(utc(START), seconds).text


# ---- taking in -----------------------------------------------------------------------------------


def test_a_new_block_is_recorded_and_can_be_read_at_its_address(client, run, rng):
    told = body(run=run, samples=1_000, rng=rng)
    answer = client.post(HERE, json=told)
    assert answer.status_code == 201
    block = answer.json()
    assert (block["start"], block["end"], block["samples"]) == (START, later(99.9), 1_000)
    read = client.get(answer.headers["Location"]).json()
    assert {name: read[name] for name in block} == block
    assert read["rates_rad_per_s"] == told["rates_rad_per_s"]
    assert read["times_s"] == [k * 0.1 for k in range(1_000)]


def test_times_of_their_own_come_back_bit_for_bit(client, run, rng):
    times_s = [0.0, *np.cumsum(rng.uniform(0.05, 0.2, 500)).tolist()]
    told = body(run=run, times_s=times_s, rng=rng)
    answer = client.post(HERE, json=told)
    read = client.get(answer.headers["Location"]).json()
    assert read["step_s"] is None
    assert (read["times_s"], read["rates_rad_per_s"]) == (times_s, told["rates_rad_per_s"])


def test_the_same_block_again_is_answered_with_the_recorded_one(client, run):
    first = client.post(HERE, json=body(run=run))
    spelt = json.dumps(body(run=run) | {"start": "1999-060T00:00:00Z"}, indent=3)
    headers = {"Content-Type": "application/json"}
    again = client.post(HERE, content=spelt, headers=headers)
    assert (first.status_code, again.status_code) == (201, 200)
    assert again.headers["Replayed"] == "true"
    assert again.content == first.content
    assert len(client.get(HERE, params={"run": run}).json()["items"]) == 1


def test_another_body_under_the_same_name_is_refused(client, run):
    client.post(HERE, json=body(run=run)).raise_for_status()
    answer = client.post(HERE, json=body(run=run, samples=6))
    assert answer.status_code == 409
    assert answer.json()["type"] == "/problems/conflict"
    assert "block 'g1' is recorded with another body" in answer.json()["detail"]


def test_a_name_is_of_one_spacecraft_and_one_run(client, run):
    for spacecraft, named in (("XTE", run), ("SWAS", run), ("XTE", f"{run}-b")):
        answer = client.post(f"/api/v1/spacecraft/{spacecraft}/gyro", json=body(run=named))
        assert answer.status_code == 201, answer.text


def test_a_time_that_another_block_holds_is_refused_with_both_names(client, run):
    client.post(HERE, json=body("night", run=run, samples=100)).raise_for_status()
    answer = client.post(HERE, json=body("day", run=run, start=later(9.9)))
    assert answer.status_code == 409
    problem = answer.json()
    assert problem["type"] == "/problems/sample-taken"
    assert (
        "'day' has a sample at 1999-03-01T00:00:09.900Z, which block 'night'" in (problem["detail"])
    )
    assert client.post(HERE, json=body("day", run=run, start=later(10.0))).status_code == 201


def test_what_was_lost_can_be_sent_into_the_gap(client, run):
    client.post(HERE, json=body("a", run=run, times_s=[0.0, 1.0, 8.0, 9.0])).raise_for_status()
    late = body("b", run=run, start=later(2.0), step_s=1.0, samples=6)
    assert client.post(HERE, json=late).status_code == 201
    one_more = body("c", run=run, start=later(2.5), step_s=1.0, samples=7)
    assert client.post(HERE, json=one_more).status_code == 201
    touching = body("d", run=run, start=later(7.2), times_s=[0.0, 0.8])
    assert "'a' holds" in client.post(HERE, json=touching).json()["detail"]


def test_blocks_are_taken_as_comparing_every_two_samples_says(client, run, rng):
    """Random blocks near one another, taken or refused in the order they come."""
    held, taken, refused = [], 0, 0
    for k in range(60):
        offset_us = int(rng.integers(0, 700))
        steps_us = rng.integers(1, 60, int(rng.integers(1, 6)))
        times_us = np.concatenate([[0], np.cumsum(steps_us)])
        told = body(f"b{k}", run=run, start=later(offset_us * 1e-6), times_s=times_us * 1e-6)
        own_ns = (offset_us + times_us) * 1_000
        shares = any(abs(int(a) - b) < SAME_TIME_NS for a in own_ns for b in held)
        answer = client.post(HERE, json=told)
        assert answer.status_code == (409 if shares else 201), answer.text
        taken, refused = taken + (not shares), refused + shares
        if not shares:
            held += own_ns.tolist()
    assert min(taken, refused) > 5


def test_of_blocks_sent_at_once_that_share_a_time_one_is_recorded(client, run):
    def send(k):
        told = body(f"at once {k // 2}", run=run, start=later(0.1 * (k // 2)), samples=50)
        return client.post(HERE, json=told)

    with ThreadPoolExecutor(8) as pool:
        statuses = [answer.status_code for answer in pool.map(send, range(16))]
    assert statuses.count(201) == 1
    assert statuses.count(200) == 1
    assert statuses.count(409) == 14
    assert len(client.get(HERE, params={"run": run}).json()["items"]) == 1


def test_an_event_tells_of_each_new_block(client, run):
    block = client.post(HERE, json=body(run=run)).json()
    client.post(HERE, json=body(run=run)).raise_for_status()
    address = client.base_url.join(f"/api/v1/events?last_event_id=0&run={run}")
    found = []
    # Without the check of the other answers, which would read the stream to its end.
    with httpx.stream("GET", address, timeout=10) as stream:
        for line in stream.iter_lines():
            found.append(line)
            if line.startswith("data: ") and "g1" in line:
                break
    assert "event: gyro" in found
    assert json.loads(found[-1].removeprefix("data: ")) == block


# ---- bad input -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "status", "field"),
    [
        (b"", 400, "body"),
        (b'{"block": "g1"', 400, None),
        (b"[]", 422, "body"),
        (
            json.dumps(body() | {"rates_rad_per_s": [[0, 0, float("nan")]]}),
            422,
            "rates_rad_per_s.0.2",
        ),
        (json.dumps(body()).replace("0.001", "1e999", 1), 422, "rates_rad_per_s.0.0"),
        (json.dumps(body() | {"rates_rad_per_s": [[0, 100.0, 0]]}), 422, "rates_rad_per_s.0.1"),
        (json.dumps(body() | {"rates_rad_per_s": []}), 422, "rates_rad_per_s"),
        (json.dumps(body(samples=10_001)), 422, "rates_rad_per_s"),
        (json.dumps(body(times_s=[0.0, 2.0, 1.0])), 422, "times_s.2"),
        (json.dumps(body() | {"spacecraft": "XTE"}), 422, "spacecraft"),
    ],
)
def test_bad_input_is_named_and_records_nothing(client, run, content, status, field):
    content = (
        content if isinstance(content, bytes) else content.replace('"live"', f'"{run}"').encode()
    )
    headers = {"Content-Type": "application/json"}
    answer = client.post(HERE, content=content, headers=headers)
    assert answer.status_code == status, answer.text
    named = [each["field"] for each in answer.json()["errors"]]
    assert field is None or named == [field]
    assert client.get(HERE, params={"run": run}).json()["items"] == []


def test_a_spacecraft_without_a_mission_file_is_not_found(client):
    assert client.post("/api/v1/spacecraft/NOPE/gyro", json=body()).status_code == 404
    assert client.get("/api/v1/spacecraft/NOPE/gyro").status_code == 404


def test_a_key_and_a_parameter_are_refused_since_they_would_be_ignored(client, run):
    told = body(run=run)
    answer = client.post(HERE, json=told, headers={"Idempotency-Key": "1"})
    assert answer.json()["errors"][0]["field"] == "Idempotency-Key"
    assert client.post(f"{HERE}?run={run}", json=told).json()["errors"][0]["field"] == "run"


@pytest.mark.parametrize("id", ["x", "01JD0000000000000000000000"])
def test_a_block_that_is_not_there_is_not_found(client, id):
    assert client.get(f"{HERE}/{id}").status_code == 404


def test_a_block_of_another_spacecraft_is_not_found(client, run):
    id = client.post(HERE, json=body(run=run)).json()["id"]
    assert client.get(f"/api/v1/spacecraft/SWAS/gyro/{id}").status_code == 404


# ---- reading -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def night(client):
    """A run with twelve blocks of ten seconds, one after another, sent in another order."""
    for k in np.random.default_rng(0).permutation(12):
        told = body(f"block {k:02d}", run="night", start=later(10.0 * k), step_s=0.5, samples=20)
        client.post(HERE, json=told).raise_for_status()
    return "night"


def test_the_blocks_of_a_period_come_page_by_page_the_earliest_first(client, night):
    named, address = [], f"{HERE}?run={night}&limit=5"
    pages = 0
    while address:
        page = client.get(address)
        named += [each["block"] for each in page.json()["items"]]
        address = page.links.get("next", {}).get("url")
        pages += 1
    assert named == [f"block {k:02d}" for k in range(12)]
    assert pages == 3


def test_a_period_has_the_blocks_that_touch_it(client, night):
    asked = {"run": night, "start": later(29.5), "end": later(40.0)}
    found = [each["block"] for each in client.get(HERE, params=asked).json()["items"]]
    assert found == ["block 02", "block 03"]
    asked |= {"start": later(29.6)}
    found = [each["block"] for each in client.get(HERE, params=asked).json()["items"]]
    assert found == ["block 03"]


def test_a_cursor_of_another_list_is_refused(client, night):
    answer = client.get(HERE, params={"run": night, "cursor": "abc"})
    assert (answer.status_code, answer.json()["errors"][0]["field"]) == (422, "cursor")


def test_the_samples_of_a_period_are_a_table(client, night):
    asked = {"run": night, "start": later(9.5), "end": later(20.5)}
    answer = client.get(TABLE, params=asked)
    assert "night-gyro-1999-03-01.csv" in answer.headers["Content-Disposition"]
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [row["time"] for row in rows] == [later(9.5 + 0.5 * k) for k in range(22)]
    assert [row["block"] for row in rows] == ["block 00"] + ["block 01"] * 20 + ["block 02"]
    assert [int(row["tai_ns"]) for row in rows] == [utc(row["time"]).tai_ns for row in rows]
    expected = [19, *range(20), 0]
    assert [float(row["rate_2_rad_per_s"]) for row in rows] == [-2e-5 * k for k in expected]


def test_the_table_is_the_same_as_parquet(client, night):
    answer = client.get(TABLE, params={"run": night, "format": "parquet"})
    table = parquet.read_table(io.BytesIO(answer.content))
    assert table.num_rows == 240
    rates = [f"rate_{axis}_rad_per_s" for axis in (1, 2, 3)]
    assert table.column_names == ["time", "tai_ns", "block", *rates, "timestamp"]


def test_a_table_without_samples_has_the_names_of_its_columns(client, run):
    text = client.get(TABLE, params={"run": run}).text
    assert text.splitlines() == [
        "time,tai_ns,block,rate_1_rad_per_s,rate_2_rad_per_s,rate_3_rad_per_s"
    ]
