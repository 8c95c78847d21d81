"""Histories and worst batches over HTTP: columns, a table, and what cannot be asked."""

import csv
import io
import json

import pytest

from service.times import parse_utc, shifted
from service.trends.quantities import trend_names
from tests.web.serving import ended

ROUTE = "/api/v1/spacecraft/XTE/history"


def test_a_history_shows_every_quantity_of_a_run(client, full_run):
    shown = client.get(ROUTE, params={"run": full_run}).json()
    assert sum(shown["batches"]) == 20
    assert tuple(shown["series"]) == trend_names()
    for series in shown["series"].values():
        assert len(series["mean"]) == len(shown["unix_s"])


def test_as_csv_it_holds_the_same_numbers(client, full_run):
    asked = {"run": full_run, "quantity": ["residual_ratio", "ambiguous_share"], "size": 40}
    shown = client.get(ROUTE, params=asked).json()
    answer = client.get(ROUTE, params=asked | {"format": "csv"})
    assert answer.headers["content-type"].startswith("text/csv")
    assert "attachment" in answer.headers["content-disposition"]
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert len(rows) == len(shown["unix_s"])
    for row, batches, most in zip(
        rows, shown["batches"], shown["series"]["residual_ratio"]["max"], strict=True
    ):
        assert int(row["batches"]) == batches
        assert (float(row["residual_ratio_max"]) if row["residual_ratio_max"] else None) == most


def test_the_latest_batches_as_csv_have_a_row_each(client, full_run):
    asked = {"run": full_run, "strategy": "latest", "size": 7, "format": "csv"}
    rows = list(csv.DictReader(io.StringIO(client.get(ROUTE, params=asked).text)))
    latest = client.get("/api/v1/batches", params={"run": full_run, "spacecraft": "XTE"}).json()
    assert [row["id"] for row in rows] == [each["id"] for each in latest["items"][:7]][::-1]
    for row, each in zip(rows, latest["items"][:7][::-1], strict=True):
        counts = each["counts"]
        assert float(row["ambiguous_share"]) == counts["ambiguous"] / counts["observed"]


@pytest.fixture(scope="module")
def day(client, drawn):
    """A run with a day of XTE, a batch every thirty seconds: 2,880 of them."""
    (first,) = drawn("XTE", 1, seed=6)
    start = parse_utc("1999-03-01T00:00:00Z")
    lines = [
        first | {"batch": f"day-{index:04}", "time": shifted(start, 30.0 * index).text}
        for index in range(2880)
    ]
    content = "\n".join(json.dumps(each) for each in lines)
    headers = {"Content-Type": "application/x-ndjson"}
    begun = client.post("/api/v1/replays?run=whole-day", content=content, headers=headers)
    assert ended(client, begun)["counts"]["new"] == 2880
    return "whole-day"


@pytest.mark.parametrize("asked", [{}, {"strategy": "latest"}])
def test_a_csv_has_every_batch_of_the_stretch(client, day, asked):
    answer = client.get(ROUTE, params={"run": day, "format": "csv"} | asked)
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [row["batch"] for row in rows] == [f"day-{index:04}" for index in range(2880)]
    assert all(row["unmatched_share"] for row in rows)
    assert answer.headers["thinned"] == "false"
    part = {"start": "1999-03-01T01:00:00Z", "end": "1999-03-01T20:00:00Z"}
    answer = client.get(ROUTE, params={"run": day, "format": "csv"} | asked | part)
    rows = list(csv.DictReader(io.StringIO(answer.text)))
    assert [row["batch"] for row in rows] == [f"day-{index:04}" for index in range(120, 2400)]


@pytest.mark.parametrize("strategy", ["latest", "minmax"])
def test_what_is_thinned_says_so_and_what_is_not_says_that(client, day, strategy):
    asked = {"run": day, "strategy": strategy, "size": 1500}
    assert client.get(ROUTE, params=asked).json()["thinned"] is True
    answer = client.get(ROUTE, params=asked | {"format": "csv"})
    assert answer.headers["thinned"] == "true"
    assert len(list(csv.DictReader(io.StringIO(answer.text)))) <= 1500
    hour = asked | {"start": "1999-03-01T01:00:00Z", "end": "1999-03-01T02:00:00Z"}
    assert client.get(ROUTE, params=hour).json()["thinned"] is False
    answer = client.get(ROUTE, params=hour | {"format": "csv"})
    assert answer.headers["thinned"] == "false"
    assert len(list(csv.DictReader(io.StringIO(answer.text)))) == 120


def test_a_csv_of_no_batches_has_its_header(client, run):
    answer = client.get(ROUTE, params={"run": run, "format": "csv"})
    assert answer.status_code == 200
    assert answer.text.startswith("time,batch,id,")
    assert answer.text.count("\r\n") == 1


def test_the_worst_batches_lead_to_their_batch(client, full_run):
    asked = {"run": full_run, "by": "a_priori_angle_deg", "limit": 3}
    items = client.get("/api/v1/spacecraft/XTE/worst", params=asked).json()["items"]
    angles = [each["value"] for each in items]
    assert angles == sorted(angles, reverse=True)
    record = client.get(f"/api/v1/batches/{items[0]['id']}").json()
    assert record["measures"]["a_priori_angle_deg"] == angles[0]


@pytest.mark.parametrize(
    "asked",
    [
        {"quantity": "colour"},
        {"quantity": "silence_s"},
        {"strategy": "mean"},
        {"size": 0},
        {"size": 100_000},
        {"start": "1999-03-02T00:00:00Z", "end": "1999-03-01T00:00:00Z"},
        {"format": "xlsx"},
        {"by": "ambiguous_share"},
    ],
)
def test_what_cannot_be_asked_is_refused_by_name(client, asked):
    answer = client.get(ROUTE, params=asked)
    assert answer.status_code == 422
    assert answer.json()["errors"]


@pytest.mark.slow
def test_batches_of_every_run_are_listed_together(client, full_run, post, batch):
    assert post(batch).status_code == 201
    runs, asked = set(), {"run": "*", "limit": 500}
    while not {"live", full_run} <= runs:
        page = client.get("/api/v1/batches", params=asked).json()
        runs |= {each["run"] for each in page["items"]}
        asked["cursor"] = page["next_cursor"]
        assert {"live", full_run} <= runs or asked["cursor"], "the last page, and not all seen"
