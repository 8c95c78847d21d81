"""The writer: shared commits, and failures that reach those they concern."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import Engine, event, func, insert, inspect, select, text
from sqlalchemy.exc import IntegrityError, OperationalError

from service.errors import Busy, Stopping
from service.storage.recording.writer import PROBE_TABLE, Writer
from service.storage.sql.tables import results, runs
from service.storage.store import Store
from tests.storage.recount import assert_equal_to_a_recount

pytestmark = pytest.mark.both_databases


@pytest.fixture
def store(database):
    opened = Store(database)
    yield opened
    opened.close()


def held_up(writer):
    """Keep the writer busy until the event that is given back is set."""
    begun, go_on = threading.Event(), threading.Event()

    def wait(_connection):
        begun.set()
        go_on.wait(30)

    writer.change(wait)
    begun.wait(30)
    return go_on


def before_commit(store, monkeypatch, act):
    """Have `act` called with the writer's connection before each of its commits."""
    kept = store.writer._connection
    end = kept._end

    def acting(connection, *, keep):
        if keep:
            act(connection)
        end(connection, keep=keep)

    monkeypatch.setattr(kept, "_end", acting)


def new_run(name):
    return lambda connection: connection.execute(insert(runs).values(name=name, created="now"))


def names(store):
    with store.reading() as connection:
        return sorted(connection.scalars(select(runs.c.name)))


def test_what_waits_together_is_committed_together(store, monkeypatch):
    commits = []
    before_commit(store, monkeypatch, commits.append)
    go_on = held_up(store.writer)
    waiting = [store.writer.change(new_run(f"run{i:02d}")) for i in range(20)]
    go_on.set()
    for each in waiting:
        each.result(30)
    assert len(names(store)) == 20
    assert len(commits) == 2


def test_what_has_time_lets_others_pass_for_one_transaction(store):
    """Chunks of a bulk load neither hold up single posts nor wait for them for ever."""
    done, writer = [], store.writer

    def later(future, name):
        future.add_done_callback(lambda _: done.append(name))
        return future

    def post_meanwhile(_connection):
        later(writer.change(lambda _: None), "a post that came meanwhile")

    go_on = held_up(writer)
    chunks = [later(writer.record([], low_priority=True), f"chunk {k}") for k in (1, 2)]
    later(writer.change(post_meanwhile), "a post")
    go_on.set()
    for each in chunks:
        each.result(30)
    assert done == ["a post", "chunk 1", "a post that came meanwhile", "chunk 2"]


def test_results_that_waited_too_long_are_refused_and_what_waits_with_them_is_written(
    app, make, monkeypatch
):
    writer = app.store.writer
    monkeypatch.setattr(writer, "_wait_s", 0.05)
    unsaved = app.submissions.solver.solve(make("late"))
    go_on = held_up(writer)
    late, change = writer.record([unsaved]), writer.change(new_run("kept"))
    in_bulk = writer.record([unsaved], low_priority=True)
    time.sleep(0.1)
    go_on.set()
    with pytest.raises(Busy, match="not written yet"):
        late.result(30)
    change.result(30)
    assert "kept" in names(app.store)
    (outcome,) = in_bulk.result(30)
    assert not outcome.replayed


def test_an_answer_comes_after_its_commit(store):
    for index in range(20):
        store.writer.change(new_run(f"run{index:02d}")).result(30)
        assert len(names(store)) == index + 1


def test_one_change_that_fails_spoils_none_of_its_neighbours(store):
    go_on = held_up(store.writer)
    waiting = [store.writer.change(new_run(name)) for name in ("a", "b", "a", "c")]
    go_on.set()
    assert isinstance(waiting[2].exception(30), IntegrityError)
    assert names(store) == ["a", "b", "c"]


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_a_change_that_fails_with_an_answer_half_read_keeps_no_lock(store):
    """Closed like that, SQLite's connection would live on for as long as the answer does."""
    half_read = []

    def fail(connection):
        half_read.append(connection.execute(text("SELECT name FROM sqlite_master")))
        half_read[0].fetchone()
        connection.execute(insert(runs).values(name="lost", created="now"))
        raise OperationalError("SELECT", {}, Exception("disk I/O error"))

    store.writer.change(new_run("before")).result(30)
    assert isinstance(store.writer.change(fail).exception(30), Busy)
    store.writer.change(new_run("after")).result(5)
    assert names(store) == ["after", "before"]


def test_one_draft_that_cannot_be_kept_spoils_none_of_its_neighbours(app, make):
    go_on = held_up(app.store.writer)
    unsaved_results = [app.submissions.solver.solve(make(name)) for name in ("b1", "b2", "b3")]
    unsaved_results[1].result["mission_digest"] = "sha256:of nothing that is there"
    waiting = app.store.writer.record(unsaved_results)
    go_on.set()
    first, second, third = waiting.result(30)
    assert isinstance(second, IntegrityError)
    assert [app.results.get(each.id).answer.batch for each in (first, third)] == ["b1", "b3"]
    assert [each.batches for each in app.spacecraft.rates("XTE")] == [2]


def test_a_full_queue_is_busy_and_takes_work_again_once_it_is_written(store):
    writer = Writer(store._writing, max_queued=3)
    go_on = held_up(writer)
    waiting = [writer.change(new_run(name)) for name in "abc"]
    with pytest.raises(Busy, match="3 records are waiting"):
        writer.change(new_run("d"))
    go_on.set()
    for each in waiting:
        each.result(30)
    writer.change(new_run("d")).result(30)
    writer.close()
    assert names(store) == ["a", "b", "c", "d"]


def test_closing_writes_what_is_queued_and_refuses_the_rest(store):
    go_on = held_up(store.writer)
    waiting = [store.writer.change(new_run(name)) for name in "abc"]
    with ThreadPoolExecutor(1) as thread:
        closing = thread.submit(store.writer.close)
        while not store.writer._closing:
            pass
        with pytest.raises(Busy, match="stopping"):
            store.writer.change(new_run("d"))
        go_on.set()
        closing.result(30)
    assert all(each.done() for each in waiting)
    assert names(store) == ["a", "b", "c"]


def test_a_commit_that_fails_reaches_everyone_who_waits_and_writing_goes_on(
    app, make, caplog, monkeypatch
):
    """What is put in stands for a disk that fails at COMMIT: nothing of the transaction is kept."""
    app.submissions.submit(make("b0"))

    def fail(_connection):
        raise OperationalError("COMMIT", {}, Exception("disk I/O error"))

    before_commit(app.store, monkeypatch, fail)
    with ThreadPoolExecutor(8) as threads:
        waiting = [threads.submit(app.submissions.submit, make(f"b{i}")) for i in range(8)]
        errors = [each.exception(30) for each in waiting]
    assert errors[0] is None  # recorded before: a repeat only reads
    assert all(isinstance(error, Busy) for error in errors[1:])
    assert "disk" not in str(errors[1]), "what is inside is for the log alone"
    assert "disk I/O error" in caplog.text
    assert len(app.results.page().items) == 1
    monkeypatch.undo()
    assert not any(app.submissions.submit(make(f"b{i}")).replayed for i in range(1, 8))
    assert len(app.results.page().items) == 8


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_a_full_disk_loses_nothing_acknowledged_and_writing_resumes_with_room(
    app, make, caplog, monkeypatch
):
    """SQLite's own bound on the file gives the error of a full disk, wherever it strikes."""
    kept, limit = app.store.writer._connection, {"pages": 0}
    start = kept._start

    def bound(connection):
        start(connection)
        connection.connection.execute(f"PRAGMA max_page_count = {limit['pages']}")

    with app.store.reading() as connection:
        used = connection.exec_driver_sql("PRAGMA page_count").scalar()
    monkeypatch.setattr(kept, "_start", bound)
    acknowledged, refused = [], []
    for index in range(60):
        limit["pages"] = used + index // 4  # a little more room at times
        try:
            acknowledged.append(app.submissions.submit(make(f"b{index}")))
        except Busy as error:
            refused.append(str(error))
    assert acknowledged
    assert refused
    assert all("cannot be written now" in each for each in refused)
    assert "disk is full" in caplog.text
    limit["pages"] = 1_000_000
    assert not app.submissions.submit(make("at last")).replayed
    for each in acknowledged:
        assert app.results.get(each.id).current
    with app.store.reading() as connection:
        stored = connection.scalar(select(func.count()).select_from(results))
        assert stored == len(acknowledged) + 1
        assert_equal_to_a_recount(connection)
        assert connection.exec_driver_sql("PRAGMA integrity_check").scalar() == "ok"


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_it_is_ready_again_only_when_there_is_room_for_a_batch(app, make, request):
    """A probe that changes a row succeeds on a full disk, where every post fails."""
    writer = app.store.writer
    bound = {"pages": 1_000_000}

    def bounded(connection, _record):
        connection.execute(f"PRAGMA max_page_count = {bound['pages']}")

    # SQLite's own bound is one of a connection; after an error the service takes a new one.
    event.listen(Engine, "connect", bounded)
    request.addfinalizer(lambda: event.remove(Engine, "connect", bounded))

    def pages(most):
        bound["pages"] = most
        command = f"PRAGMA max_page_count = {most}"
        writer.change(lambda connection: connection.exec_driver_sql(command).scalar()).result()

    def used():
        with app.store.reading() as connection:
            return connection.exec_driver_sql("PRAGMA page_count").scalar()

    pages(used())
    for index in range(40):
        try:
            app.submissions.submit(make(f"b{index}"))
        except Busy:
            break
    assert not writer.state().succeeded
    # A small change still finds room, and says nothing of posts.
    writer.change(new_run("small")).result()
    for _ in range(2):
        with pytest.raises(Busy):
            writer.require_written()
        assert not writer.state().succeeded
    with pytest.raises(Busy):
        app.submissions.submit(make("still full"))

    pages(1_000_000)
    writer.require_written()
    assert writer.state().succeeded
    app.submissions.submit(make("at last"))
    with app.store.reading() as connection:
        assert not inspect(connection).has_table(PROBE_TABLE)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_writer_that_ends_leaves_nobody_waiting_and_is_not_ready(app):
    writer = app.store.writer

    def end(_connection):
        begun.set()
        go_on.wait(30)
        raise SystemExit

    begun, go_on = threading.Event(), threading.Event()
    ended = writer.change(end)
    begun.wait(30)
    later = writer.change(new_run("late"))
    go_on.set()
    for each in (ended, later):
        assert isinstance(each.exception(30), Stopping)
    with pytest.raises(Stopping):
        writer.change(new_run("later still"))
    with pytest.raises(Busy, match="restart the service"):
        app.service.ready()
