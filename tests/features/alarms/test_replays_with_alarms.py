"""`acquire replay --alarms`: the sample raises an alarm, whichever way the file goes."""

import pytest

from service.app.factory import open_app
from service.cli import main
from service.features.alarms.part import Alarms
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.web.serving import Server, in_process_settings

SAMPLE = ["simulate", "telemetry", "--spacecraft", "XTE", "--batches", "160", "--seed"]


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("sample") / "sample.ndjson"
    assert main([*SAMPLE, "3", str(path)]) == 0
    return path


@pytest.fixture
def app(tmp_path):
    return open_app(in_process_settings(sqlite_at(tmp_path / "acquire.db")))


def raised(app, run):
    return {each.quantity for each in app.part(Alarms).page(run=run, state="all").items}


@pytest.mark.parametrize("way", [(), ("--concurrency", "4")], ids=["as a file", "batch by batch"])
@pytest.mark.slow
def test_through_a_server(app, file, way):
    with Server(create_app(app)) as url:
        for run, alarms in (("quiet", ()), ("loud", ("--alarms",))):
            assert main(["replay", str(file), "--url", url, "--run", run, *way, *alarms]) == 0
        assert raised(app, "quiet") == set()
        assert "a_priori_angle_deg" in raised(app, "loud")


def test_in_process(file, tmp_path):
    database = sqlite_at(tmp_path / "acquire.db")
    asked = ["replay", str(file), "--in-process", "--database", database, "--run", "loud"]
    assert main([*asked, "--alarms"]) == 0
    again = open_app(in_process_settings(database))
    before = again.part(Alarms).page(run="loud", state="all").items
    again.close()
    assert "a_priori_angle_deg" in {each.quantity for each in before}
    # A second time adds nothing, and raises nothing anew.
    assert main([*asked, "--alarms"]) == 0
    again = open_app(in_process_settings(database))
    assert again.part(Alarms).page(run="loud", state="all").items == before
    again.close()
