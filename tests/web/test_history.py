"""Histories and worst batches over HTTP: columns, a table, and what cannot be asked."""

import csv
import io

import pytest

ROUTE = "/api/v1/spacecraft/XTE/history"


def test_a_history_shows_every_quantity_of_a_run(client, full_run):
    shown = client.get(ROUTE, params={"run": full_run}).json()
    assert sum(shown["batches"]) == 20
    assert len(shown["series"]) == 10
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


def test_batches_of_every_run_are_listed_together(client, full_run, post, batch):
    assert post(batch).status_code == 201
    runs, asked = set(), {"run": "*", "limit": 500}
    while not {"live", full_run} <= runs:
        page = client.get("/api/v1/batches", params=asked).json()
        runs |= {each["run"] for each in page["items"]}
        asked["cursor"] = page["next_cursor"]
        assert {"live", full_run} <= runs or asked["cursor"], "the last page, and not all seen"
