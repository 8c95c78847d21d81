"""The bulk path is the single path repeated: as strict, as complete, in bounded memory."""

import copy
import gzip
import io
import json

import pytest
import zstandard

from tests.storage.samples import without_accidents
from tests.web.serving import ended
from tests.web.test_bad_input import WRONG, changed

API = "/api/v1"
PACKED = {
    "identity": lambda data: data,
    "gzip": gzip.compress,
    "zstd": zstandard.compress,
    "two zstd frames": lambda data: zstandard.compress(data[:99]) + zstandard.compress(data[99:]),
}


def replayed(client, run, data, coding="identity"):
    headers = {"Content-Type": "application/x-ndjson", "Content-Encoding": coding}
    begun = client.post(f"{API}/replays?run={run}", content=data, headers=headers)
    return ended(client, begun)


def test_both_paths_take_and_refuse_the_same_lines_for_the_same_reasons(client, drawn, run):
    """Every mistake there is a test for, between good batches of three missions."""
    good = [
        each | {"batch": f"{name}-{index}"}
        for name in ("XTE", "SWAS", "SOHO")
        for index, each in enumerate(drawn(name, 8, seed=3))
    ]
    bodies = [copy.deepcopy(each) for each in good]
    for index, (where, value, *_) in enumerate(WRONG.values()):
        bad = changed(drawn("XTE", 1)[0] | {"batch": f"bad-{index}"}, where, value)
        bodies.insert(index * 2 % len(bodies), bad)
    bodies = [{"run": f"{run}-single"} | each for each in bodies]
    lines = [json.dumps(each).encode() for each in bodies] + [b'{"cut', b"[]", b'"text"', b"\xff"]

    single, refused_singly = {}, {}
    headers = {"Content-Type": "application/json"}
    for number, line in enumerate(lines, start=1):
        answer = client.post(f"{API}/batches", content=line, headers=headers)
        if answer.status_code == 201:
            single[answer.json()["batch"]] = without_accidents(answer.json())
        else:
            refused_singly[number] = answer.json().get("errors")
    state = replayed(client, f"{run}-bulk", b"\n".join(lines))

    refused_in_bulk = {each["line"]: each["problem"].get("errors") for each in state["errors"]}
    assert refused_in_bulk.keys() == refused_singly.keys()
    for number, faults in refused_in_bulk.items():
        named = [(each["field"], each["message"]) for each in refused_singly[number]]
        assert [(each["field"], each["message"]) for each in faults] == named[: len(faults)]
    assert state["counts"]["new"] == len(single) == len(good)
    items = client.get(f"{API}/batches?run={run}-bulk&limit=500").json()["items"]
    for item in items:
        answer = client.get(f"{API}/batches/{item['id']}").json()["answer"]
        expected = single[item["batch"]]
        assert without_accidents(answer) | {"run": expected["run"]} == expected
    stars = [each["counts"] for each in single.values()]
    for outcome in ("observed", "unique", "ambiguous", "unmatched"):
        assert state["counts"][outcome] == sum(each[outcome] for each in stars)
    solved = sum(each["attitude"] is not None for each in single.values())
    assert state["counts"]["attitudes"] == solved


@pytest.mark.parametrize("packing", PACKED)
def test_a_packed_file_is_the_file(client, drawn, run, packing):
    data = b"".join(json.dumps(each).encode() + b"\n" for each in drawn("XTE", 12))
    coding = "zstd" if "zstd" in packing else packing
    state = replayed(client, run, PACKED[packing](data), coding)
    assert (state["state"], state["lines"]["done"], state["counts"]["new"]) == ("done", 12, 12)
    again = replayed(client, run, data)
    assert (again["counts"]["new"], again["counts"]["repeated"]) == (0, 12)


@pytest.mark.parametrize("coding", ["gzip", "zstd"])
@pytest.mark.slow("zstd")
def test_a_damaged_file_is_recorded_up_to_the_damage_and_says_so(client, drawn, run, coding):
    data = b"".join(json.dumps(each).encode() + b"\n" for each in drawn("XTE", 700, seed=2))
    packed = PACKED[coding](data)
    state = replayed(client, run, packed[: len(packed) * 9 // 10], coding)
    assert state["state"] == "failed"
    assert f"the {coding} data are damaged" in state["errors"][-1]["problem"]["detail"]
    assert 0 < state["counts"]["new"] == state["lines"]["done"] < 700


def test_what_is_no_packing_at_all_is_refused_in_words(client, run):
    state = replayed(client, run, b"this is no gzip", "gzip")
    assert state["state"] == "failed"
    assert "the gzip data are damaged" in state["errors"][0]["problem"]["detail"]
    answer = client.post(
        f"{API}/replays?run={run}",
        content=b"x",
        headers={"Content-Type": "application/x-ndjson", "Content-Encoding": "br"},
    )
    assert answer.status_code == 415
    assert "identity, gzip, zstd" in answer.json()["detail"]
    packed = gzip.compress(b"{}")
    headers = {"Content-Type": "application/json", "Content-Encoding": "gzip"}
    assert client.post(f"{API}/batches", content=packed, headers=headers).status_code == 415


def test_a_line_without_end_is_refused_without_being_held(client, batch, run, resident_mb):
    """200 MB in one line that a hundred kilobytes unpack to, and a good batch after it."""
    packed = io.BytesIO()
    with gzip.GzipFile(fileobj=packed, mode="wb") as text:
        for _ in range(200):
            text.write(b" " * (1 << 20))
        text.write(b"\n" + json.dumps(batch).encode() + b"\n")
    before = resident_mb()
    state = replayed(client, run, packed.getvalue(), "gzip")
    assert resident_mb() - before < 50
    assert (state["counts"]["new"], state["lines"]["done"]) == (1, 2)


def test_wrong_lines_are_not_held_once_they_are_refused(client, run, resident_mb):
    """pydantic's errors hold what was sent, and of a cycle through one Python frees nothing."""
    wrong = [json.dumps({"k" * 300_000 + str(number): 1}).encode() for number in range(300)]
    packed = gzip.compress(b"\n".join(wrong))
    before = resident_mb()
    state = replayed(client, run, packed, "gzip")
    assert state["lines"]["refused"] == 300
    assert resident_mb() - before < 200
