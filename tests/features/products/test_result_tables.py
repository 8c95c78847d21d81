"""Batches and stars as tables: what the API tells of each, with units, on both databases."""

import csv
import io
import json

import duckdb
import pyarrow.parquet
import pytest

from service.app.factory import open_app
from service.cli import main
from service.features.products import result_tables
from service.features.products.part import Products
from service.settings import Settings
from service.storage.sql.tables import MEASURED
from service.table_files.formats import write_table
from service.times import parse_utc
from service.trends.quantities import QUANTITIES
from tests.storage.samples import KINDS, submission

pytestmark = pytest.mark.both_databases

N = 11


@pytest.fixture
def app(database, sky, missions):
    app = open_app(Settings(database=database, replay_processes=0))
    for number in range(N):
        sent = submission(
            sky, missions, f"b{number}", kind=KINDS[number % len(KINDS)], after_s=100.0 - number
        )
        app.submissions.submit(sent)
    yield app
    app.close()


def rows_of(table):
    return [
        dict(zip(table.names, row, strict=True))
        for page in table.pages
        for row in zip(*page, strict=False)
    ]


@pytest.mark.parametrize("page", [1, 4, 100])
def test_batches_are_those_of_the_list_with_their_quantities(app, monkeypatch, page):
    monkeypatch.setattr(result_tables, "BATCHES", page)
    rows = rows_of(app.part(Products).table("XTE", "batches"))
    listed = {each.id: each for each in app.results.page(spacecraft="XTE", limit=100).items}
    assert [each["tai_ns"] for each in rows] == sorted(each["tai_ns"] for each in rows)
    assert {each["id"] for each in rows} == set(listed)
    for row in rows:
        other = listed[row["id"]]
        assert (row["batch"], row["time"], row["status"]) == (
            other.batch,
            other.time,
            other.status,
        )
        assert row["unique"] == other.counts.unique
        assert row["reason"] == other.reason


@pytest.mark.parametrize("page", [1, 4, 100])
def test_stars_are_those_of_the_answers(app, monkeypatch, page):
    monkeypatch.setattr(result_tables, "BATCHES_OF_STARS", page)
    rows = rows_of(app.part(Products).table("XTE", "stars"))
    wanted = []
    for summary in reversed(app.results.page(spacecraft="XTE", limit=100).items):
        for tracker in app.results.get(summary.id).answer.observations:
            for star in tracker.stars:
                known = None if star.star is None else star.star.id
                wanted.append((summary.id, tracker.tracker, star.outcome, known, star.votes))
    assert len(rows) == len(wanted) > 40
    names = ("id", "tracker", "outcome", "star_id", "votes")
    assert [tuple(each[name] for name in names) for each in rows] == wanted


def test_a_period_and_a_run_are_kept_to(app):
    start, end = parse_utc("1996-01-10T12:01:35Z"), parse_utc("1996-01-10T12:01:38Z")
    rows = rows_of(app.part(Products).table("XTE", "batches", start=start, end=end))
    assert [each["batch"] for each in rows] == ["b5", "b4", "b3"]
    assert rows_of(app.part(Products).table("XTE", "stars", run="other")) == []


@pytest.mark.parametrize("kind", ["batches", "stars"])
def test_parquet_tells_units_and_duckdb_reads_the_same_floats(app, kind, tmp_path):
    file = tmp_path / "t.parquet"
    file.write_bytes(b"".join(write_table("parquet", app.part(Products).table("XTE", kind))))
    schema = pyarrow.parquet.read_schema(file)
    assert schema.metadata[b"spacecraft"] == b"XTE"
    if kind == "batches":
        for name in MEASURED:
            unit = schema.field(name).metadata.get(b"unit", b"").decode()
            assert unit == QUANTITIES[name].unit
    else:
        assert schema.field("residual_arcsec").metadata[b"unit"] == b"arcsec"
    rows = rows_of(app.part(Products).table("XTE", kind))
    name = "residual_rms_arcsec" if kind == "batches" else "residual_arcsec"
    found = duckdb.sql(f"SELECT {name} FROM '{file}'").fetchall()
    assert [each for (each,) in found] == [each[name] for each in rows]


def test_the_commands_write_the_tables(app, database, capsysbinary):
    for kind, count in (("batches", N), ("stars", None)):
        assert main(["export", kind, "--spacecraft", "XTE", "--database", database]) == 0
        lines = list(csv.DictReader(io.StringIO(capsysbinary.readouterr().out.decode())))
        assert len(lines) == (count or len(rows_of(app.part(Products).table("XTE", kind))))
    assert main(["export", "stars", "--spacecraft", "X", "--database", database]) != 0


def test_the_attitude_at_a_moment_is_read_from_the_records(app, database, capsys):
    # Batches are a second apart; one kind of four has no good attitude.
    where = ["--spacecraft", "XTE", "--database", database]
    told = ["export", "attitude-at", "1996-01-10T12:01:36.2Z", *where, "--method", "nearest"]
    assert main(told) == 0
    found = json.loads(capsys.readouterr().out)
    listed = {each.id: each for each in app.spacecraft.attitudes("XTE", limit=100).items}
    good = [each for each in listed.values() if each.status == "good"]
    moment = parse_utc("1996-01-10T12:01:36.2Z").tai_ns
    nearest = min(good, key=lambda each: abs(parse_utc(each.time).tai_ns - moment))
    assert found["ids"] == [nearest.id]
    assert found["quaternion"] == nearest.quaternion
    assert main(["export", "attitude-at", "2001-01-01T00:00:00Z", *where]) == 2
    assert "none is within the largest gap (60 s)" in capsys.readouterr().err
