"""The app over a database: submissions, observers, readiness, zones."""

import asyncio
import json
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from threading import get_ident

import pytest
from sqlalchemy import event, select

from service.acquire import kernel_build, pipeline
from service.acquire.kernel_build import KernelBuild
from service.app.factory import open_app
from service.errors import AcquisitionError, BadBatch, BadConfiguration, BadInput, Busy, Conflict
from service.ingest import solver_pool, submit
from service.observations.schema import OptionsIn, QuaternionIn, submission_from_json
from service.settings import Settings
from service.storage.sql.columns import metadata
from service.times import parse_utc, utc_now
from tests.storage.samples import KINDS, QUATERNION, without_accidents


def told(outcome):
    if isinstance(outcome, Exception):
        return type(outcome), str(outcome)
    return outcome.replayed, without_accidents(json.loads(outcome.body))


@pytest.mark.both_databases
def test_many_at_once_give_what_each_by_itself_gives(app, make):
    """The bulk path is the single path repeated: answers, refusals and repeats alike."""
    wrong = json.loads(make("b4").text)
    wrong["observations"][0]["tracker"] = "NO_SUCH"
    unknown = json.loads(make("b5").text) | {"spacecraft": "HST"}
    one_run = [
        make("b0"),
        *(make(f"b{i}", kind=kind, after_s=60.0 * i) for i, kind in enumerate(KINDS, start=1)),
        submission_from_json(json.dumps(wrong | {"batch": "w"})),
        submission_from_json(json.dumps(unknown)),
        make("b0"),
        make("b0", stars=4),
        make("b9", spacecraft="SWAS"),
    ]
    other_run = [submission_from_json(each.text, run="bulk") for each in one_run]
    app.submissions.submit(one_run[-1])
    app.submissions.submit(other_run[-1])

    def single(submission):
        try:
            return app.submissions.submit(submission)
        except Exception as error:
            return error

    singly = [told(single(each)) for each in one_run]
    at_once = [told(each) for each in app.submissions.submit_many(other_run)]
    assert [first for first, _ in singly] == [first for first, _ in at_once]
    assert [first for first, _ in at_once] == [
        *[False] * 5,
        BadInput,
        BadBatch,
        True,
        Conflict,
        True,
    ]
    for (_, alone), (_, together) in zip(singly, at_once, strict=True):
        if isinstance(alone, dict):
            assert together == alone | {"run": "bulk"}
        else:
            assert together == alone.replace("run live", "run bulk")
    live, bulk = (app.spacecraft.rates("XTE", run=run) for run in ("live", "bulk"))
    assert live == bulk


MADE_LATER = ("record_facts", "record_heads")
"""The chain of the record follows it in its own time."""


def everything(app):
    """Every row of every table."""
    with app.store.reading() as connection:
        return {
            table.name: sorted(map(str, connection.execute(select(table))))
            for table in metadata.sorted_tables
            if table.name not in MADE_LATER
        }


def test_batches_run_to_warm_up_are_not_kept(app, make, caplog):
    app.submissions.submit(make("b1", kind="suspect"))
    app.submissions.submit(make("s1", spacecraft="SWAS"))
    before, counted = everything(app), app.submissions.counts.batches.total()
    app.service.ready()
    assert everything(app) == before
    assert app.submissions.counts.batches.total() == counted
    assert "could not be run again" not in caplog.text
    assert not app.submissions.submit(make("b2")).replayed


def test_single_posts_go_before_bulk(app, make, monkeypatch):
    """Between the portions of a bulk load whatever came one by one is computed and recorded."""
    monkeypatch.setattr(submit, "YIELD_S", 10.0)
    monkeypatch.setattr(submit, "PORTION", 2)
    acquired, order, first_at_work = solver_pool.acquired, [], threading.Event()

    def noting(batches, *rest, **how):
        order.extend(each.batch for each in batches)
        if batches[0].batch == "m0":
            first_at_work.set()
            time.sleep(0.5)
        return acquired(batches, *rest, **how)

    monkeypatch.setattr(solver_pool, "acquired", noting)
    bulk = [make(f"m{k}", run="bulk") for k in range(4)]
    single = make("b1")
    with ThreadPoolExecutor(1) as threads:
        many = threads.submit(app.submissions.submit_many, bulk)
        assert first_at_work.wait(30)
        app.submissions.submit(single)
        assert len(many.result(30)) == 4
    assert order == ["m0", "m1", "b1", "m2", "m3"]


def test_what_may_take_long_is_solved_by_itself(app, make, monkeypatch):
    portions, acquired = [], solver_pool.acquired

    def noting(batches, *rest, **how):
        portions.append([each.batch for each in batches])
        return acquired(batches, *rest, **how)

    monkeypatch.setattr(solver_pool, "acquired", noting)
    monkeypatch.setattr(submit, "may_take_long", lambda batch: batch.batch == "b2")
    monkeypatch.setattr(submit, "PORTION", 2)
    app.submissions.submit_many([make(f"b{k}") for k in range(7)])
    assert portions == [["b0", "b1"], ["b2"], ["b3", "b4"], ["b5", "b6"]]


def test_nothing_at_once_is_nothing(app):
    assert app.submissions.submit_many([]) == []


def test_every_new_batch_is_counted_once_and_neither_repeats_nor_what_ifs(app, make):
    first = app.submissions.submit(make("b1"))
    app.submissions.submit(make("b1"))
    app.results.what_if(first.id, OptionsIn(), adopt=True)
    app.submissions.submit_many([make("b1"), make("b2"), make("b2"), make("b3")])
    assert app.submissions.counts.batches == {("XTE", True, True): 3}


def test_a_warm_service_stays_warm(app, monkeypatch):
    app.service.ready()
    monkeypatch.setattr("service.app.service.prewarm_kernels", lambda *_: 1 / 0)
    app.service.ready()


def test_while_one_caller_warms_up_another_is_told_to_wait(app, monkeypatch):
    begun, go_on = threading.Event(), threading.Event()
    monkeypatch.setattr(
        "service.app.service.prewarm_kernels", lambda *_: begun.set() or go_on.wait(30)
    )
    with ThreadPoolExecutor(1) as threads:
        first = threads.submit(app.service.ready)
        assert begun.wait(30)
        with pytest.raises(Busy, match="warming up"):
            app.service.ready()
        go_on.set()
        first.result(30)


def test_it_is_ready_for_zones_while_other_kernels_are_compiled(make, monkeypatch, tmp_path):
    begun, go_on = threading.Event(), threading.Event()

    def run(build, missions, zones_built, whole_sky_built, build_files):
        build.zones_needed = False
        zones_built()
        begun.set()
        assert go_on.wait(30)
        whole_sky_built()
        build.is_needed = build.whole_sky_needed = False

    monkeypatch.setattr(kernel_build, "_marker", lambda: Path("/none"))
    monkeypatch.setattr(KernelBuild, "run", run)
    settings = Settings(database=f"sqlite:///{tmp_path}/served.db", replay_processes=0)
    app = open_app(settings, serving=True)
    with pytest.raises(Busy, match="compiling"):
        asyncio.run(app.submissions.answered(make("b0").text.encode()))
    with ThreadPoolExecutor(1) as threads:
        first = threads.submit(app.service.ready)
        assert begun.wait(30)
        app.service.ready()
        assert [each.split()[0] for each in app.service.being_compiled()] == [
            "searches",
            "what-ifs,",
        ]
        answer = asyncio.run(app.submissions.answered(make("b1").text.encode()))
        assert json.loads(answer.body)["path"] == "zone"
        lost = json.loads(make("b2").text) | {"a_priori": None}
        for asked in (
            lambda: asyncio.run(app.submissions.answered(json.dumps(lost).encode())),
            lambda: app.results.what_if(answer.id, OptionsIn()),
        ):
            with pytest.raises(Busy, match="compiling"):
                asked()
        replay = app.replays.start([make("b3").text.encode()], "early")
        time.sleep(0.5)
        early = app.replays.get(replay)
        assert (early.state, early.lines.done) == ("running", 0)
        go_on.set()
        first.result(60)
    until = time.monotonic() + 60.0
    while app.replays.get(replay).state == "running" and time.monotonic() < until:
        time.sleep(0.1)
    late = app.replays.get(replay)
    assert (late.state, late.lines.done) == ("done", 1)
    assert not app.service.being_compiled()
    assert not asyncio.run(app.submissions.answered(json.dumps(lost).encode())).replayed
    app.close()


def test_no_batch_of_simulated_telemetry_or_of_the_last_epoch_waits_for_a_file_of_the_sky(
    make, missions, monkeypatch, tmp_path
):
    """A server that starts without files of the sky builds these before it is ready."""

    def run(build, missions, zones_built, whole_sky_built, build_files):
        zones_built()
        build_files()
        whole_sky_built()
        build.is_needed = build.zones_needed = build.whole_sky_needed = False

    settings = Settings(database=f"sqlite:///{tmp_path}/served.db", replay_processes=0)
    with closing(open_app(settings)) as app:
        app.submissions.submit(make("recorded"))
    monkeypatch.setattr(kernel_build, "_marker", lambda: Path("/none"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(KernelBuild, "run", run)
    with closing(open_app(settings, serving=True)) as app:
        app.service.ready()
        waits_for = app.submissions.pool.builder
        monkeypatch.setattr(waits_for, "submit", lambda *_: pytest.fail("a file is built"))
        times = [json.loads(make().text)["time"], *(m.simulated_start for m in missions.values())]
        for place, time_utc in enumerate(times):
            body = json.loads(make(f"lost-{place}").text) | {"time": time_utc, "a_priori": None}
            answer = app.submissions.submit(submission_from_json(json.dumps(body)))
            assert json.loads(answer.body)["path"] == "lost_in_space"


def test_what_is_asked_after_closing_is_busy(opened, make):
    app = opened()
    app.close()
    with pytest.raises(Busy, match="stopping"):
        app.submissions.submit(make())


def test_what_was_recorded_is_there_when_opened_again(opened, make):
    app = opened()
    first = app.submissions.submit(make())
    app.close()
    again = opened().submissions.submit(make())
    assert (again.replayed, again.body) == (True, first.body)


def test_zones_show_what_is_cached_and_can_be_warmed_and_dropped(app, make):
    time = parse_utc("1996-01-10T12:00:00.000Z")
    app.zones.drop()
    (warmed,) = app.zones.warm("XTE", [QuaternionIn(quaternion=QUATERNION)], time)
    assert warmed.kind == "cap"
    answer = json.loads(app.submissions.submit(make()).body)
    assert answer["observations"][0]["zone"]["cached"]
    shown = app.zones.state()
    (zone,) = shown.items
    assert (zone.spacecraft, zone.stars) == ("XTE", warmed.stars)
    assert zone.bytes > 0
    assert zone.hits == 1
    assert zone.build_us > 0
    assert shown.bytes <= shown.max_bytes
    assert app.zones.drop("SWAS") == 0
    assert app.zones.drop("XTE") == 1
    assert app.zones.state().items == []
    for ask in (app.zones.drop, lambda name: app.zones.warm(name, [], time)):
        with pytest.raises(BadBatch, match=r"spacecraft: there is no such .*'HST'"):
            ask("HST")


@pytest.mark.parametrize("name", ["none.csv", "none.npz"])
def test_a_catalog_that_cannot_be_read_is_a_mistake_in_the_configuration(tmp_path, name):
    database = f"sqlite:///{tmp_path / 'acquire.db'}"
    with pytest.raises(BadConfiguration, match=name):
        open_app(Settings(database=database, catalog=tmp_path / name))


@pytest.mark.both_databases
def test_no_moment_of_the_database_is_held_while_many_are_worked_on(app, make):
    """By the thread that works on them: others may read meanwhile."""
    this, taken, held = get_ident(), Counter(), []
    pool = app.store._readers.pool
    event.listen(pool, "checkout", lambda *_: taken.update([get_ident()]))
    event.listen(pool, "checkin", lambda *_: taken.subtract([get_ident()]))
    solver = app.submissions.solver
    solver.acquired = lambda *asked, own=solver.acquired, **how: (
        held.append((taken[this], taken[get_ident()])),
        own(*asked, **how),
    )[1]
    app.submissions.submit_many([make("b1"), make("b2")])
    assert held == [(0, 0)]


def test_many_at_once_share_the_time_of_their_recording(app, make):
    """The sum over a chunk is what the chunk took, not that times its size."""
    sent = [make(f"b{i}", after_s=60.0 * i) for i in range(40)]
    start = time.perf_counter()
    answers = app.submissions.submit_many(sent)
    took_us = (time.perf_counter() - start) * 1e6
    recording = [json.loads(each.body)["timings_us"]["record"] for each in answers]
    assert all(each > 0 for each in recording)
    assert sum(recording) < took_us


@pytest.mark.parametrize("place", ["of its own", "of all together"])
def test_a_fault_of_ours_in_one_batch_keeps_no_other_from_being_recorded(
    app, make, monkeypatch, caplog, place
):
    def search(batch, *rest):
        if batch.batch == "b2":
            raise ZeroDivisionError("inside")
        return real(batch, *rest)

    def acquired(batches, *rest, **how):
        if "b2" in [each.batch for each in batches]:
            raise ZeroDivisionError("inside")
        return real_of_all(batches, *rest, **how)

    real, real_of_all = pipeline._search, solver_pool.acquired
    if place == "of its own":
        monkeypatch.setattr(pipeline, "_search", search)
    else:
        monkeypatch.setattr(solver_pool, "acquired", acquired)
    first, second, third = app.submissions.submit_many([make("b1"), make("b2"), make("b3")])
    assert not first.replayed
    assert not third.replayed
    assert isinstance(second, AcquisitionError)
    assert "inside" not in str(second)
    assert "batch b2 failed" in caplog.text


def test_a_batch_was_received_before_it_was_worked_on_however_long_that_took(
    app, make, monkeypatch
):
    solver = app.submissions.solver
    begun = []

    def slowed(acquire):
        def slow(asked, **how):
            begun.extend([utc_now().tai_ns] * (len(asked) if isinstance(asked, list) else 1))
            time.sleep(0.02)
            return acquire(asked, **how)

        return slow

    monkeypatch.setattr(solver, "acquire", slowed(solver.acquire))
    monkeypatch.setattr(solver, "acquired", slowed(solver.acquired))
    made = [solver.solve(make("alone"))]
    made += solver.solve_many([make("one"), make("other")])
    app.submissions.submit(make("in the queue"))
    (told,) = (each for each in app.results.page().items if each.batch == "in the queue")
    received = [parse_utc(each.batch["received"]).tai_ns for each in made] + [
        parse_utc(told.received).tai_ns
    ]
    assert all(came <= later for came, later in zip(received, begun, strict=True))


def test_a_batch_that_no_processor_takes_for_long_may_come_again(app, make, monkeypatch):
    monkeypatch.setattr(solver_pool, "WAIT_S", 0.01)
    pool, go_on = app.submissions.pool, threading.Event()
    give_up_s, begun = time.monotonic() + 30, threading.Barrier(len(pool._threads) + 1)

    def hold():
        begun.wait(30)
        go_on.wait(30)

    for _ in pool._threads:
        pool.put(solver_pool.SolverTask(hold, print, give_up_s), "a", is_long=False)
    begun.wait(30)
    with ThreadPoolExecutor(2) as threads:
        batch = make().batch
        single = threads.submit(app.submissions.run_again, batch)
        many = threads.submit(app.submissions.submit_many, [make()])
        time.sleep(0.1)
        go_on.set()
        for each in (single, many):
            assert isinstance(each.exception(30), Busy)
            assert "processor" in str(each.exception())
    assert not app.submissions.submit(make()).replayed
