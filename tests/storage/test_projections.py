"""Projections are what the record says, after each kind of change, however they came about."""

import json
import threading
import time
from itertools import cycle

import numpy as np
import pytest
from sqlalchemy import delete, func, insert, select, update

from service.app.factory import open_app
from service.errors import Busy
from service.features.alarms.part import Alarms
from service.features.alarms.tables import alarm_actions, alarms, limits, watches
from service.features.archive.archiving import PartFilter, archive, restore
from service.observations.schema import OptionsIn
from service.settings import Settings
from service.storage import progress
from service.storage.projections import projector as projecting
from service.storage.projections.projector import Projector, rebuild_trends
from service.storage.recording.results import next_seqs
from service.storage.sql.tables import (
    batches,
    catalogs,
    events,
    missions,
    projector,
    results,
    rollups_daily,
    rollups_hourly,
    runs,
    tracker_values,
)
from service.storage.store import Store
from service.storage.upkeep.forget import ForgetFilter, forget
from service.storage.upkeep.prune import prune
from service.storage.upkeep.verify import verify
from service.times import shifted
from service.trends.limits import LimitSettings
from tests.fresh_databases import sqlite_at
from tests.storage.recount import assert_equal_to_a_recount
from tests.storage.samples import START
from tests.waiting import wait_until

TIGHT = LimitSettings.model_validate(
    {"warning": {"high": 0.1}, "minimum_count": 2, "duration_s": 0, "hysteresis": 0.0}
)
OTHER = OptionsIn.model_validate({"identifier": "starid"})
RECORD = (runs, missions, catalogs, limits, batches, results, tracker_values)
"""What the projections are made of."""
OWN_IDS = ("id", "alarm_id")


def rows_of(store, table):
    with store.reading() as connection:
        return [dict(row) for row in connection.execute(select(table)).mappings()]


def alarms_of(store):
    """Alarms with what was noted of them, latest values, and changes of tracking; without ids."""
    by_id = {row["id"]: row for row in rows_of(store, alarms)}
    noted = {id: [] for id in by_id}
    for row in rows_of(store, alarm_actions):
        noted[row["alarm_id"]].append([v for name, v in row.items() if name not in OWN_IDS])
    found = [
        ([value for name, value in row.items() if name not in OWN_IDS], noted[id])
        for id, row in by_id.items()
    ]
    kept = [list(row.values()) for row in rows_of(store, watches)]
    changes = [row["data"] for row in rows_of(store, events) if row["kind"] == "tracking"]
    return sorted(map(repr, found)), sorted(map(repr, kept)), changes


def rebuilt(store, file, sizes=1):
    """A database with the same record, whose projections are made anew.

    Each turn takes so many results, by default one; `sizes` may differ from turn to turn.
    """
    made = Store(sqlite_at(file))
    copied = {table: rows_of(store, table) for table in RECORD}

    def copy(connection):
        for table, rows in copied.items():
            if rows:
                connection.execute(insert(table), sorted(rows, key=lambda row: str(row.get("id"))))

    made.writer.change(copy)
    again = Projector(made)
    for size in cycle(np.atleast_1d(sizes).tolist()):
        again._most = size
        with made.writer.projection() as connection:
            if again._step(connection).is_all:
                return made
    raise AssertionError("there is no size")


@pytest.fixture
def watched(opened):
    app = opened()
    app.part(Alarms).limits.set("XTE", "unmatched_share", TIGHT, who="jb", comment="for the test")
    return app


def test_they_equal_a_rebuild_after_each_kind_of_change(
    watched, opened, make, tmp_path, missions, monkeypatch
):
    url, place = watched.settings.database, tmp_path / "archive"
    place.mkdir()

    def assert_right(app, what, *, alarms_again=True):
        with app.store.reading() as connection:
            assert_equal_to_a_recount(connection)
        assert verify(url) == [], what
        if alarms_again:
            again = rebuilt(app.store, tmp_path / f"{what}.db")
            assert alarms_of(app.store) == alarms_of(again), what
            with again.reading() as connection:
                assert_equal_to_a_recount(connection)
            again.close()

    def many(tag, kinds, start_s=0.0, **wanted):
        made = [
            make(f"{tag}{k}", kind=kind, after_s=start_s + 900.0 * k, **wanted)
            for k, kind in enumerate(kinds)
        ]
        return [each.id for each in watched.submissions.submit_many(made)]

    ids = [watched.submissions.submit(make("one")).id]
    assert_right(watched, "a batch")
    ids += many("a", ["good", "spurious", "spurious", "good", "good", "suspect"], 60.0)
    many("r", ["good", "one_star"], 3_000.0, run="r")
    assert_right(watched, "many")
    many("late", ["spurious", "good", "spurious"], 30.0)
    assert_right(watched, "late")
    watched.results.what_if(ids[1], OTHER, record=True)
    watched.results.what_if(ids[2], OTHER, adopt=True)
    # Two for one batch: the first of them is superseded before it is projected, or after.
    for _ in range(2):
        watched.results.what_if(ids[3], OTHER, adopt=True)
    assert_right(watched, "adopted")
    watched.close()

    changed = missions["XTE"].model_copy(update={"description": "calibrated anew"})
    watched = opened(mission=changed)
    many("b", ["good", "spurious"], 8_000.0)
    assert_right(watched, "other settings")

    before = alarms_of(watched.store)
    prune(watched.store, shifted(START, 1_000.0))
    assert_right(watched, "pruned", alarms_again=False)
    archive(watched.store, place, shifted(START, 5_000.0))
    assert_right(watched, "archived", alarms_again=False)
    restore(watched.store, place, PartFilter())
    assert_right(watched, "restored", alarms_again=False)
    forget(watched.store, ForgetFilter("r"), place)
    assert_right(watched, "forgotten", alarms_again=False)
    assert alarms_of(watched.store) == before

    def spoil(connection):
        connection.execute(update(rollups_hourly).values(batches=7))
        connection.execute(delete(rollups_daily))

    watched.store.writer.change(spoil)
    assert verify(url) != []
    rebuild_trends(watched.store, lambda done, total: None)
    assert_right(watched, "counted anew", alarms_again=False)


def assert_passed(connection):
    newest = select(func.max(results.c.seq)).scalar_subquery()
    assert connection.scalar(select(projector.c.seq == newest))


def held_up(connection, new):
    raise Busy("held up")


def test_alarms_are_the_same_however_results_are_grouped(opened, make, tmp_path, rng):
    """Batches come in any order, in limits and out of them, in single steps and in one."""
    app = opened()
    for name, high in (
        ("unmatched_share", 0.1),
        ("ambiguous_share", 0.05),
        ("no_attitude_share", 0.3),
    ):
        wanted = {"warning": {"high": high}, "critical": {"high": 3 * high}, "hysteresis": 0.02}
        wanted |= {"minimum_count": int(rng.integers(1, 5)), "duration_s": 60.0}
        limits = LimitSettings.model_validate(wanted)
        app.part(Alarms).limits.set("XTE", name, limits, who="jb", comment="for the test")
    kinds = rng.choice(["good", "suspect", "one_star", "spurious"], 40, p=[0.4, 0.1, 0.2, 0.3])
    places = np.arange(40) + rng.normal(0.0, 2.0, 40)
    for k in np.argsort(places):
        app.submissions.submit(make(f"b{k}", kind=kinds[k], after_s=30.0 * float(k)))
    expected = alarms_of(rebuilt(app.store, tmp_path / "single.db"))
    assert alarms_of(app.store) == expected
    assert expected[0], "no alarm was raised"
    for trial, most in enumerate((3, 10, 40)):
        sizes = rng.integers(1, most + 1, 40)
        again = rebuilt(app.store, tmp_path / f"groups-{trial}.db", sizes)
        assert alarms_of(again) == expected, sizes


def test_changes_beside_what_is_not_projected_yet_count_nothing_twice(app, make, monkeypatch):
    """What is deleted or replaced first, the projector comes to later, or never."""
    with monkeypatch.context() as patch:
        patch.setattr(projecting, "PROJECTIONS", (held_up,))
        patch.setattr(progress, "WAIT_S", 0.1)
        some = [make(f"b{k}", after_s=900.0 * k) for k in range(8)]
        ids = [each.id for each in app.submissions.submit_many(some)]
        app.results.what_if(ids[7], OTHER, adopt=True)
        forget(app.store, ForgetFilter("live", batches=("b0", "b1")), None)
        assert verify(app.settings.database) == []
        assert app.store.progress.lag().results == 7
    wait_until(lambda: app.store.progress.lag().results == 0)
    with app.store.reading() as connection:
        assert_equal_to_a_recount(connection)
        assert_passed(connection)
    assert sum(each.batches for each in app.spacecraft.rates("XTE")) == 6


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_a_transaction_that_commits_late_is_neither_left_out_nor_projected_twice(
    database, opened, make
):
    """Another process takes a place in the record, and others commit before it does."""
    app = opened()
    app.submissions.submit(make("first"))
    with app.store.reading() as connection:
        assert_passed(connection)
    sleeping, go_on = threading.Event(), threading.Event()
    other = Store(database)

    def record_slowly(connection):
        (place,) = next_seqs(connection, 1)
        sleeping.set()
        go_on.wait(30)
        id = "0" * 26
        batch = dict(connection.execute(select(batches)).mappings().first())
        row = dict(connection.execute(select(results)).mappings().first())
        connection.execute(insert(batches), batch | {"id": id, "batch": "slow"})
        own = {"id": id, "batch_id": id, "seq": place}
        connection.execute(insert(results), row | own)

    slow = other.writer.later(lambda: other.writer.change(record_slowly))
    assert sleeping.wait(30)
    app.submissions.submit_many([make(f"b{k}", after_s=60.0 * k) for k in range(3)])
    # Three looks of the projector, at least, at what it can see of the record.
    time.sleep(3 * projecting.EVERY_S + 0.1)
    assert app.store.progress.lag().results == 3
    go_on.set()
    slow.result(30)
    other.close()
    app.submissions.submit(make("last", after_s=500.0))
    (rates,) = app.spacecraft.rates("XTE")
    assert rates.batches == 6
    with app.store.reading() as connection:
        assert_equal_to_a_recount(connection)
    noted = [json.loads(row["data"]) for row in rows_of(app.store, events)]
    assert sum(each["batches"] for each in noted) == 6


def test_a_result_that_cannot_be_projected_holds_up_no_other(app, make, monkeypatch, caplog):
    taken = []

    def spoiled(connection, new):
        if any(each.result["batch"] == "b1" for each in new):
            raise ZeroDivisionError
        taken.extend(each.result["batch"] for each in new)

    monkeypatch.setattr(projecting, "PROJECTIONS", (*projecting.PROJECTIONS, spoiled))
    app.submissions.submit_many([make(f"b{k}", after_s=60.0 * k) for k in range(3)])
    with app.store.reading() as connection:
        assert_passed(connection)
    assert taken == ["b0", "b2"]
    assert "could not be projected" in caplog.text
    # The others have it.
    (rates,) = app.spacecraft.rates("XTE")
    assert rates.batches == 3
    noted = [json.loads(row["data"]) for row in rows_of(app.store, events)]
    assert sum(each["batches"] for each in noted) == 3


def test_a_projection_whose_statement_is_wrong_holds_up_no_other(app, make, monkeypatch):
    def of_a_missing_column(connection, new):
        connection.exec_driver_sql("UPDATE projector SET no_such_column = 1")

    monkeypatch.setattr(projecting, "PROJECTIONS", (of_a_missing_column, *projecting.PROJECTIONS))
    app.submissions.submit_many([make(f"b{k}", after_s=60.0 * k) for k in range(3)])
    (rates,) = app.spacecraft.rates("XTE")
    assert rates.batches == 3


def test_projections_go_on_after_a_turn_that_could_not_read_the_record(
    app, make, monkeypatch, caplog
):
    with monkeypatch.context() as patch:
        patch.setattr(projecting, "recorded_after", lambda *_: 1 / 0)
        app.submissions.submit(make("first"))
        wait_until(lambda: "the record could not be projected" in caplog.text, 30.0)
    app.submissions.submit(make("second", after_s=60.0))
    wait_until(lambda: [each.batches for each in app.spacecraft.rates("XTE")] == [2], 30.0)


def test_what_is_left_when_the_service_ends_is_projected_by_the_next(database, make, monkeypatch):
    settings = Settings(database=database, replay_processes=0)
    with monkeypatch.context() as patch:
        patch.setattr(projecting, "PROJECTIONS", (held_up,))
        app = open_app(settings)
        app.submissions.submit(make())
        app.close()
    app = open_app(settings)
    try:
        (rates,) = app.spacecraft.rates("XTE")
        assert rates.batches == 1
        assert [each.kind for each in app.events.after(0, 10)] == ["batches"]
    finally:
        app.close()
