"""Attitudes as files over HTTP, and by the command."""

import csv
import dataclasses
import html
import io
import json
import math
import re
import threading

import httpx
import pyarrow.parquet
import pytest

from service.access import add_token, new_secret
from service.app.factory import open_app
from service.cli import main
from service.features.products.attitude_formats import (
    ATTITUDE_FORMATS,
    attitude_formats,
    file_suffix,
)
from service.storage.recording.ids import unguessable_ulid
from service.table_files.formats import TABLE_FORMATS, OutputFormat
from service.times import utc_now
from service.web.app import bare_app, create_app
from service.web.requests import exports
from tests.fresh_databases import sqlite_at
from tests.waiting import wait_until
from tests.web.serving import Server, in_process_settings

ROUTE = "/api/v1/spacecraft/XTE/attitude"
TABLES = "/api/v1/spacecraft/XTE/tables"
MOMENT = "1996-01-10T12:00:00Z"


def table_of(text):
    return list(csv.DictReader(io.StringIO(text)))


def test_attitudes_are_those_of_the_list(client, full_run):
    listed = client.get(f"{ROUTE}s", params={"run": full_run, "limit": 500}).json()["items"]
    found = client.get(ROUTE, params={"run": full_run, "status": "all"}).json()["items"]
    assert len(found) == len(listed) > 10
    for one, other in zip(found, listed, strict=True):
        assert [abs(each) for each in one["quaternion"]] == [abs(q) for q in other["quaternion"]]
        for name in ("time", "id", "batch", "status", "covariance_arcsec2", "method"):
            assert one[name] == other[name]


def test_only_good_attitudes_are_given_unless_others_are_asked_for(client, full_run):
    def found(**asked):
        items = client.get(ROUTE, params={"run": full_run} | asked).json()["items"]
        return {each["id"]: each["status"] for each in items}

    assert set(found().values()) == {"good"}
    every = found(status="all")
    assert {id for id, status in every.items() if status == "good"} == set(found())
    assert set(found(status="suspect")) == set(every) - set(found())


def test_the_newest_come_first_where_that_is_asked_for(client, full_run):
    asked = {"run": full_run, "format": "csv"}
    oldest = table_of(client.get(ROUTE, params=asked).text)
    newest = table_of(client.get(ROUTE, params=asked | {"order": "newest"}).text)
    assert [each["id"] for each in newest] == [each["id"] for each in oldest][::-1]
    rates = [[float(each["rate_z"] or "nan") for each in rows] for rows in (oldest, newest[::-1])]
    assert rates[0] == pytest.approx(rates[1], abs=1e-12, nan_ok=True)


@pytest.mark.parametrize("name", list(attitude_formats()))
def test_each_format_is_a_file_of_its_type(name, client, full_run):
    answer = client.get(ROUTE, params={"run": full_run, "format": name})
    assert answer.status_code == 200
    assert answer.headers["Content-Type"].startswith(attitude_formats()[name].media_type)
    if name != "json":
        suffix = file_suffix(name)
        wanted = f'attachment; filename="XTE-{full_run}-attitude.{suffix}"'
        assert answer.headers["Content-Disposition"] == wanted
    assert len(answer.content) > 500


@pytest.mark.parametrize(
    ("end", "days"),
    [("1999-03-02T00:00:00Z", "1999-03-01"), ("1999-03-02T00:00:01Z", "1999-03-01-1999-03-02")],
)
def test_the_name_of_a_file_has_its_days_and_its_grade(client, full_run, end, days):
    asked = {"run": full_run, "format": "csv", "start": "1999-03-01T00:00:00Z", "end": end}
    names = [
        client.get(ROUTE, params=asked | {"grade": grade}).headers["Content-Disposition"]
        for grade in ("raw", "smoothed")
    ]
    kinds = ("attitude", "attitude-smoothed")
    assert names == [f'attachment; filename="XTE-{full_run}-{kind}-{days}.csv"' for kind in kinds]


def test_a_format_from_outside_is_written_and_described(client, full_run, monkeypatch):
    def write(series):
        yield b" ".join(str(n).encode() for block in series.blocks for n in block.stretch)

    added = OutputFormat("Numbers", "text/x-numbers", write)
    monkeypatch.setitem(ATTITUDE_FORMATS, "numbers", added)
    operation = bare_app().openapi()["paths"]["/api/v1/spacecraft/{name}/attitude"]["get"]
    (parameter,) = [each for each in operation["parameters"] if each["name"] == "format"]
    assert "numbers" in parameter["schema"]["enum"]
    assert "text/x-numbers" in operation["responses"]["200"]["content"]
    # It is no table, so no history has it.
    history = bare_app().openapi()["paths"]["/api/v1/spacecraft/{name}/history"]["get"]
    assert "text/x-numbers" not in history["responses"]["200"]["content"]


@pytest.mark.parametrize(
    ("asked", "field", "value"),
    [
        ({"format": "oem"}, "format", "'oem'"),
        ({"start": "noon"}, "start", "'noon'"),
        ({"status": "fine"}, "status", "'fine'"),
        ({"order": "random"}, "order", "'random'"),
        ({"order": "newest", "format": "aem"}, "order", "'newest'"),
        ({"largest_gap_s": "0"}, "largest_gap_s", "'0'"),
        ({"largest_gap_s": "nan"}, "largest_gap_s", "'nan'"),
        ({"naif_id": "12"}, "naif_id", "'12'"),
        ({"object_id": "a\nb"}, "object_id", "'a\\nb'"),
        ({"object_id": "x\n"}, "object_id", "'x\\n'"),
        ({"colour": "red"}, "colour", "'red'"),
    ],
)
def test_a_bad_parameter_is_named_with_its_value(client, asked, field, value):
    answer = client.get(ROUTE, params=asked)
    assert answer.status_code == 422
    (fault,) = answer.json()["errors"]
    assert (fault["field"], fault["value"]) == (field, value)


def test_an_end_before_the_start_names_both(client):
    asked = {"start": "1996-01-11T00:00:00Z", "end": "1996-01-10T00:00:00Z"}
    answer = client.get(ROUTE, params=asked)
    assert answer.status_code == 422
    assert "1996-01-11T00:00:00.000Z must not be after end 1996-01-10" in answer.json()["detail"]


def test_an_unknown_spacecraft_is_not_found(client):
    assert client.get("/api/v1/spacecraft/NOPE/attitude").status_code == 404


def test_a_period_without_attitudes_is_empty_as_a_table_and_refused_as_a_message(client):
    asked = {"run": "full", "end": "1980-01-01T00:00:00Z"}
    assert client.get(ROUTE, params=asked).json()["items"] == []
    assert table_of(client.get(ROUTE, params=asked | {"format": "csv"}).text) == []
    answer = client.get(ROUTE, params=asked | {"format": "aem"})
    assert answer.status_code == 404
    assert "good attitudes of XTE in run full to before 1980-01-01" in answer.json()["detail"]


def test_a_package_that_is_missing_is_named_with_the_command_that_installs_it(client, monkeypatch):
    missing = OutputFormat(
        "Absent",
        "text/x-absent",
        lambda series: iter(()),
        extra="spice",
        package="no_such_package",
    )
    monkeypatch.setitem(ATTITUDE_FORMATS, "absent", missing)
    answer = client.get(ROUTE, params={"run": "full", "format": "absent"})
    assert answer.status_code == 422
    assert answer.json()["type"] == "/problems/not-available"
    assert "pip install 'attitude-acquisition[spice]'" in answer.json()["detail"]


def test_the_command_writes_what_the_api_answers(app, client, full_run, tmp_path, capsysbinary):
    where = ["--spacecraft", "XTE", "--run", full_run, "--database", app.settings.database]
    assert main(["export", "attitude", *where, "--status", "all"]) == 0
    asked = {"run": full_run, "format": "csv", "status": "all"}
    assert capsysbinary.readouterr().out == client.get(ROUTE, params=asked).content
    file = tmp_path / "xte.aem"
    chosen = ["--format", "aem", "--object-id", "1995-074A", "--largest-gap", "5"]
    assert main(["export", "attitude", *where, *chosen, "--output", str(file)]) == 0
    text = file.read_text()
    assert "OBJECT_ID     = 1995-074A" in text
    assert "Largest gap within a segment 5.0 s" in text


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--naif-id", "7"], "naif_id: must be from -2000000 to -1 (got 7)"),
        (["--largest-gap", "1e9"], "largest_gap_s: must be above 0 and at most 86400"),
        (["--object-id", "a,b"], "object_id: must match"),
        (["--format", "aem", "--order", "newest"], "order: must be oldest for the format aem"),
        (["--format", "aem", "--start", "2090-01-01T00:00:00Z"], "none, and CCSDS AEM cannot"),
        (["--start", "noon"], "--start: must be UTC"),
    ],
)
def test_the_command_names_a_bad_argument_and_leaves_no_file(
    app, full_run, tmp_path, capsys, arguments, told
):
    file = tmp_path / "attitude"
    where = ["--spacecraft", "XTE", "--run", full_run, "--database", app.settings.database]
    assert main(["export", "attitude", *where, "--output", str(file), *arguments]) == 2
    assert told in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_a_period_with_more_batches_than_a_format_takes_is_refused(client, full_run, monkeypatch):
    few = dataclasses.replace(ATTITUDE_FORMATS["aem"], most_batches=5)
    monkeypatch.setitem(ATTITUDE_FORMATS, "aem", few)
    answer = client.get(ROUTE, params={"run": full_run, "format": "aem"})
    assert answer.status_code == 422
    assert "more than the 5 batches" in answer.json()["detail"]


def test_trends_are_tables_with_units(client, full_run, tmp_path):
    asked = {"run": full_run, "format": "parquet", "quantity": "residual_rms_arcsec"}
    file = tmp_path / "trend.parquet"
    file.write_bytes(client.get("/api/v1/spacecraft/XTE/history", params=asked).content)
    table = pyarrow.parquet.read_table(file)
    assert table.num_rows == 20
    assert table.schema.field("residual_rms_arcsec").metadata[b"unit"] == b"arcsec"
    buckets = client.get("/api/v1/spacecraft/XTE/history", params=asked | {"size": 5}).content
    file.write_bytes(buckets)
    assert {"bucket_s", "residual_rms_arcsec_max"} <= set(
        pyarrow.parquet.read_table(file).column_names
    )


def test_the_console_links_the_attitudes_of_the_range_in_every_format(client, full_run):
    page = client.get("/spacecraft/XTE/files", params={"run": full_run}).text
    links = [html.unescape(each) for each in re.findall(r'href="([^"]+/attitude\?[^"]+)"', page)]
    shown = {httpx.URL(each).params["format"]: each for each in links}
    assert list(shown) == list(attitude_formats())
    for name in ("json", "aem"):
        assert httpx.URL(shown[name]).params["run"] == full_run
        assert client.get(shown[name]).status_code == 200


def test_the_console_links_the_tables_of_the_range(client, full_run):
    page = client.get("/spacecraft/XTE/files", params={"run": full_run}).text
    for kind in ("batches", "stars"):
        found = re.findall(rf'href="([^"]+/tables/{kind}\?[^"]+)"', page)
        links = {httpx.URL(html.unescape(each)) for each in found}
        assert {each.params["format"] for each in links} == set(TABLE_FORMATS)
        for each in links:
            assert client.get(each).status_code == 200


# ---- tables and the attitude at a moment ---------------------------------------------------------


@pytest.mark.parametrize("kind", ["batches", "stars"])
def test_a_table_is_what_the_command_writes(app, client, full_run, tmp_path, capsysbinary, kind):
    where = ["--spacecraft", "XTE", "--run", full_run, "--database", app.settings.database]
    assert main(["export", kind, *where]) == 0
    answer = client.get(f"{TABLES}/{kind}", params={"run": full_run})
    assert answer.content == capsysbinary.readouterr().out
    assert answer.headers["Content-Disposition"] == (
        f'attachment; filename="XTE-{full_run}-{kind}.csv"'
    )
    rows = table_of(answer.text)
    file = tmp_path / "table.parquet"
    asked = {"run": full_run, "format": "parquet"}
    file.write_bytes(client.get(f"{TABLES}/{kind}", params=asked).content)
    assert pyarrow.parquet.read_table(file)["id"].to_pylist() == [each["id"] for each in rows]


def test_a_table_holds_the_batches_of_the_period(client, full_run):
    of_run = {"run": full_run, "spacecraft": "XTE", "limit": 500}
    listed = client.get("/api/v1/batches", params=of_run).json()["items"]
    times = sorted(each["time"] for each in listed)
    asked = {"run": full_run, "start": times[3], "end": times[-2]}
    rows = table_of(client.get(f"{TABLES}/batches", params=asked).text)
    assert [each["time"] for each in rows] == times[3:-2]


@pytest.mark.parametrize(
    ("path", "asked", "field", "value"),
    [
        (f"{TABLES}/planets", {}, "kind", "'planets'"),
        (f"{TABLES}/stars", {"format": "json"}, "format", "'json'"),
        (f"{TABLES}/stars", {"format": "aem"}, "format", "'aem'"),
        (f"{TABLES}/stars", {"end": "noon"}, "end", "'noon'"),
        (f"{TABLES}/stars", {"order": "newest"}, "order", "'newest'"),
        (f"{ROUTE}/at", {}, "time", None),
        (f"{ROUTE}/at", {"time": "noon"}, "time", "'noon'"),
        (f"{ROUTE}/at", {"time": MOMENT, "method": "best"}, "method", "'best'"),
        (f"{ROUTE}/at", {"time": MOMENT, "largest_gap_s": "-1"}, "largest_gap_s", "'-1'"),
        (f"{ROUTE}/at", {"time": MOMENT, "end": MOMENT}, "end", f"'{MOMENT}'"),
    ],
)
def test_a_bad_parameter_of_a_table_or_a_moment_is_named(client, path, asked, field, value):
    answer = client.get(path, params=asked)
    assert answer.status_code == 422
    (fault,) = answer.json()["errors"]
    assert (fault["field"], fault.get("value")) == (field, value)


def test_a_table_with_more_batches_than_its_format_takes_is_refused(client, full_run, monkeypatch):
    few = dataclasses.replace(TABLE_FORMATS["fits"], most_batches=5)
    monkeypatch.setitem(TABLE_FORMATS, "fits", few)
    answer = client.get(f"{TABLES}/stars", params={"run": full_run, "format": "fits"})
    assert answer.status_code == 422
    assert "more than the 5 batches" in answer.json()["detail"]


def test_tables_and_moments_of_an_unknown_spacecraft_are_not_found(client):
    for path in ("tables/stars", f"attitude/at?time={MOMENT}"):
        assert client.get(f"/api/v1/spacecraft/NOPE/{path}").status_code == 404


def test_the_attitude_at_a_moment_is_that_of_the_series(client, full_run):
    items = client.get(ROUTE, params={"run": full_run}).json()["items"]
    first = items[0]
    found = client.get(f"{ROUTE}/at", params={"run": full_run, "time": first["time"]}).json()
    assert found["ids"] == [first["id"]]
    assert found["quaternion"] == first["quaternion"]
    assert (found["offset_s"], found["motion_arcsec"]) == (0.0, 0.0)


@pytest.mark.parametrize("rate_deg_per_s", [0.5, 24.0])
def test_between_batches_a_body_is_turned_by_the_rates_that_they_carry(client, run, rate_deg_per_s):
    """Twenty-four degrees a second, a batch every ten seconds: the shorter way is the wrong one."""
    for k in range(4):
        half = math.radians(10.0 * k * rate_deg_per_s) / 2.0
        quaternion = [0.0, 0.0, math.sin(half), math.cos(half)]
        answer = client.post(
            "/api/v1/batches",
            json={
                "spacecraft": "XTE",
                "run": run,
                "batch": f"{run}-{k}",
                "time": f"1999-03-02T00:00:{10 * k:02d}Z",
                "a_priori": None,
                "body_rates_deg_per_s": [0.0, 0.0, rate_deg_per_s],
                "measurement": {"quaternion": quaternion, "sigma_arcsec": [5.0, 5.0, 5.0]},
            },
        )
        assert answer.status_code == 201, answer.text
    for seconds in (5, 12, 25):
        asked = {"run": run, "time": f"1999-03-02T00:00:{seconds:02d}Z"}
        found = client.get(f"{ROUTE}/at", params=asked).json()
        turned_deg = 2.0 * math.degrees(math.atan2(*found["quaternion"][2:]))
        off_deg = (turned_deg - rate_deg_per_s * seconds + 180.0) % 360.0 - 180.0
        assert abs(off_deg) < 1e-6


def test_a_moment_outside_every_stretch_is_not_found(client, full_run):
    answer = client.get(f"{ROUTE}/at", params={"run": full_run, "time": "2090-01-01T00:00:00Z"})
    assert answer.status_code == 404
    assert "none is within the largest gap (60 s)" in answer.json()["detail"]


# ---- how many at once ----------------------------------------------------------------------------


@pytest.fixture
def slow_format(monkeypatch):
    """A format that is written until the test lets go."""
    let_go = threading.Event()

    def write(series):
        yield b"begun\n"
        let_go.wait(20)

    monkeypatch.setitem(ATTITUDE_FORMATS, "slow", OutputFormat("Slow", "text/plain", write))
    yield let_go
    let_go.set()


def test_a_token_may_have_two_exports_at_once_and_another_when_one_has_ended(
    tmp_path, slow_format, monkeypatch
):
    monkeypatch.setattr(exports, "MAX_EXPORTS", 3)
    app = open_app(in_process_settings(sqlite_at(tmp_path / "exports.db")))
    secrets = {}
    for name in ("one", "other"):
        secrets[name] = new_secret()
        token = {
            "id": unguessable_ulid(),
            "name": name,
            "secret": secrets[name],
            "scopes": ("read",),
            "spacecraft": None,
            "rate_per_s": None,
            "created": utc_now().text,
            "expires": "2099-01-01T00:00:00.000Z",
        }
        app.context.change(lambda connection, token=token: add_token(connection, **token))

    def stream(client, name):
        bearer = {"Authorization": f"Bearer {secrets[name]}"}
        return client.stream("GET", f"{ROUTE}?format=slow", headers=bearer)

    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=30) as client:
        with stream(client, "one") as first, stream(client, "one") as second:
            assert (first.status_code, second.status_code) == (200, 200)
            with stream(client, "one") as third:
                assert third.status_code == 429
                assert third.headers["Retry-After"] == "5"
                assert "one has 2 exports under way" in json.loads(third.read())["detail"]
            with stream(client, "other") as of_another:
                assert of_another.status_code == 200
                with stream(client, "other") as one_too_many:
                    assert one_too_many.status_code == 503
            slow_format.set()

        def has_room():
            with stream(client, "one") as again:
                return again.status_code == 200

        wait_until(has_room)
