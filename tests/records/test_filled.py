"""The database that pages are measured on: as the writer would make it, never read whole."""

import re

import pytest
from sqlalchemy import event

from benchmarks.fill_database import fill
from service.operations import Operations
from service.settings import Settings
from service.times import parse_utc, shifted
from tests.records.recount import assert_equal_to_a_recount

LARGE = ("results", "batches", "solutions", "star_results", "events", "rollups_hourly")


@pytest.fixture(scope="module")
def filled(tmp_path_factory):
    file = tmp_path_factory.mktemp("filled") / "filled.db"
    fill(file, total=6000, seed=1, newest=2)
    operations = Operations.open(Settings(database=f"sqlite:///{file}"))
    yield operations
    operations.close()


def test_its_trends_are_those_of_a_recount(filled):
    with filled.store.reading() as connection:
        assert_equal_to_a_recount(connection)
        assert connection.exec_driver_sql("PRAGMA foreign_key_check").all() == []
        assert connection.exec_driver_sql("PRAGMA integrity_check").scalar() == "ok"
    assert sum(each["batches"] for each in filled.runs()) == 6006
    (xte,) = (each for each in filled.overview()["items"] if each["name"] == "XTE")
    assert xte["last_hour"]["batches"] == 120


def pages(operations):
    latest = parse_utc(operations.overview()["as_of"])
    stretch = {"start": shifted(latest, -86400), "end": latest}
    newest = operations.batches(limit=1).items[0]["id"]
    return {
        "overview": operations.overview,
        "default run": operations.default_run,
        "day": lambda: operations.history("XTE", **stretch),
        "all": lambda: operations.history("XTE", start=shifted(latest, -3e7), size=50),
        "latest": lambda: operations.history("XTE", strategy="latest", size=20),
        "worst": lambda: operations.worst_batches("XTE", by="residual_ratio", **stretch),
        "offset": lambda: operations.worst_batches("XTE", by="magnitude_offset_mag", **stretch),
        "state": lambda: operations.spacecraft_state("SOHO"),
        "batches": lambda: operations.batches(limit=10),
        "of one": lambda: operations.batches(spacecraft="XTE", limit=10, **stretch),
        "across runs": lambda: operations.batches(run="*", limit=10),
        "one": lambda: operations.batch(newest),
        "attitudes": lambda: operations.attitudes("XTE", limit=10, **stretch),
        "alarms": operations.alarms,
        "limits": lambda: operations.limits("XTE"),
        "events": lambda: operations.events_after(0, 10),
        "last event": operations.last_event,
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
