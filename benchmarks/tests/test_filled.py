"""Tests of the filled database: rows as from the writer, and no page that reads all of it."""

import re

import pytest
from sqlalchemy import event

from benchmarks.speed.fill_database import fill
from service.app.factory import open_app
from service.features.alarms.part import Alarms
from service.settings import Settings
from service.times import parse_utc, shifted
from tests.storage.recount import assert_equal_to_a_recount

LARGE = ("results", "batches", "solutions", "star_results", "events", "rollups_hourly")


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    file = tmp_path_factory.mktemp("filled") / "filled.db"
    fill(file, total=6000, seed=1, newest=2)
    app = open_app(Settings(database=f"sqlite:///{file}"))
    yield app
    app.close()


def test_its_trends_are_those_of_a_recount(filled):
    with filled.store.reading() as connection:
        assert_equal_to_a_recount(connection)
        assert connection.exec_driver_sql("PRAGMA foreign_key_check").all() == []
        assert connection.exec_driver_sql("PRAGMA integrity_check").scalar() == "ok"
    assert sum(each.batches for each in filled.runs.all()) == 6006
    (xte,) = (each for each in filled.spacecraft.overview().items if each.name == "XTE")
    assert xte.last_hour.batches == 120


def pages(app):
    latest = parse_utc(app.spacecraft.overview().as_of)
    stretch = {"start": shifted(latest, -86400), "end": latest}
    newest = app.results.page(limit=1).items[0].id
    return {
        "overview": app.spacecraft.overview,
        "default run": app.runs.default,
        "day": lambda: app.spacecraft.history("XTE", **stretch),
        "all": lambda: app.spacecraft.history("XTE", start=shifted(latest, -3e7), size=50),
        "latest": lambda: app.spacecraft.history("XTE", strategy="latest", size=20),
        "worst": lambda: app.spacecraft.ranking("XTE", by="residual_ratio", **stretch),
        "offset": lambda: app.spacecraft.ranking("XTE", by="magnitude_offset_mag", **stretch),
        "state": lambda: app.spacecraft.state("SOHO"),
        "batches": lambda: app.results.page(limit=10),
        "of one": lambda: app.results.page(spacecraft="XTE", limit=10, **stretch),
        "across runs": lambda: app.results.page(run="*", limit=10),
        "one": lambda: app.results.get(newest),
        "attitudes": lambda: app.spacecraft.attitudes("XTE", limit=10, **stretch),
        "alarms": app.part(Alarms).page,
        "limits": lambda: app.part(Alarms).limits.all("XTE"),
        "events": lambda: app.events.after(0, 10),
        "last event": app.events.last,
    }


def test_no_page_reads_a_large_table_from_end_to_end(filled):
    asked = pages(filled)
    seen, asking = [], []

    def note(driver, _record, _proxy):
        # Of SQLite itself: what is prepared does not pass through SQLAlchemy.
        driver.set_trace_callback(lambda statement: seen.append((asking[-1], statement)))

    engine = filled.store._readers
    event.listen(engine, "checkout", note)
    for page, ask in asked.items():
        asking.append(page)
        ask()
    event.remove(engine, "checkout", note)
    statements = [each for each in seen if each[1].lstrip().upper().startswith("SELECT")]
    assert {page for page, _ in statements} == set(asked)
    with filled.store.reading() as connection:
        driver = connection.connection.driver_connection
        driver.set_trace_callback(None)
        for page, statement in statements:
            plan = driver.execute(f"EXPLAIN QUERY PLAN {statement}").fetchall()
            for *_, step in plan:
                scanned = re.match(r"SCAN (\w+)", step)
                # From its newest end an index is read as far as the page goes.
                to_the_end = scanned and not (page == "across runs" and "by_time" in step)
                assert not (to_the_end and scanned[1] in LARGE), f"{page}: {step}: {statement}"
