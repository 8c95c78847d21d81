"""The writer: one transaction after another, and failures that reach those they concern."""

import threading
from concurrent.futures import ThreadPoolExecutor, wait

import pytest
from sqlalchemy import Engine, event, func, insert, inspect, select, text
from sqlalchemy.exc import IntegrityError, OperationalError

from service.errors import Busy, Stopping
from service.storage.sql.dialects import PROBE_TABLE
from service.storage.sql.tables import results, runs
from service.storage.store import Store
from tests.storage.recount import assert_equal_to_a_recount
from tests.waiting import wait_until

pytestmark = pytest.mark.both_databases


@pytest.fixture
def store(database):
    opened = Store(database)
    yield opened
    opened.close()


@pytest.fixture
def threads():
    with ThreadPoolExecutor(24) as pool:
        yield pool


def held_up(writer, threads):
    """Keep the writer busy until the event that is given back is set."""
    begun, go_on = threading.Event(), threading.Event()

    def wait(_connection):
        begun.set()
        go_on.wait(30)

    threads.submit(writer.change, wait)
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


def waiting_for_their_turn(writer, count):
    wait_until(lambda: writer.state().queued == count, why=f"{count} records do not wait")


def test_changes_are_made_in_the_order_in_which_they_came(store, threads):
    made, writer = [], store.writer
    go_on = held_up(writer, threads)
    waiting = []
    for k in range(10):
        waiting.append(threads.submit(writer.change, lambda _, k=k: made.append(k)))
        waiting_for_their_turn(writer, k + 1)
    go_on.set()
    wait(waiting, 30)
    assert made == list(range(10))


def test_what_has_time_lets_others_pass_for_one_transaction(store, threads):
    """Chunks of a bulk load neither hold up single posts nor wait for them for ever."""
    done, writer = [], store.writer

    def post_meanwhile(_connection):
        done.append("a post")
        waiting.append(threads.submit(writer.change, lambda _: done.append("a later post")))
        waiting_for_their_turn(writer, 3)

    def project(k):
        with writer.projection():
            done.append(f"chunk {k}")

    go_on = held_up(writer, threads)
    waiting = []
    for k in (1, 2):
        chunk = threads.submit(project, k)
        waiting.append(chunk)
        waiting_for_their_turn(writer, k)
    waiting.append(threads.submit(writer.change, post_meanwhile))
    waiting_for_their_turn(writer, 3)
    go_on.set()
    wait(waiting[:3], 30)
    wait(waiting, 30)
    assert done == ["a post", "chunk 1", "a later post", "chunk 2"]


def test_results_that_waited_too_long_are_refused_and_what_waits_with_them_is_written(
    app, make, monkeypatch, threads
):
    writer = app.store.writer
    monkeypatch.setattr(writer, "_wait_s", 0.05)
    unsaved = app.submissions.solver.solve(make("late"))
    go_on = held_up(writer, threads)
    late = threads.submit(writer.record, [unsaved])
    change = threads.submit(writer.change, new_run("kept"))
    in_bulk = threads.submit(writer.record, [unsaved], low_priority=True)
    with pytest.raises(Busy, match="not written yet"):
        late.result(30)
    go_on.set()
    change.result(30)
    assert "kept" in names(app.store)
    (outcome,) = in_bulk.result(30)
    assert not outcome.replayed


def test_a_repeat_with_a_new_key_is_refused_where_its_key_cannot_be_kept_in_time(
    app, make, monkeypatch, threads
):
    app.submissions.submit(make("b1"))
    monkeypatch.setattr(app.store.writer, "_wait_s", 0.05)
    go_on = held_up(app.store.writer, threads)
    with pytest.raises(Busy, match="not written yet"):
        app.submissions.submit(make("b1"), "given later")
    go_on.set()
    assert app.submissions.submit(make("b1"), "given later").replayed


def test_an_answer_comes_after_its_commit(store):
    for index in range(20):
        store.writer.change(new_run(f"run{index:02d}"))
        assert len(names(store)) == index + 1


def test_a_change_that_fails_is_told_to_its_caller_and_to_no_other(store):
    store.writer.change(new_run("a"))
    with pytest.raises(IntegrityError):
        store.writer.change(new_run("a"))
    store.writer.change(new_run("b"))
    assert names(store) == ["a", "b"]


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_a_change_that_fails_with_an_answer_half_read_keeps_no_lock(store):
    """Closed like that, SQLite's connection would live on for as long as the answer does."""
    half_read = []

    def fail(connection):
        half_read.append(connection.execute(text("SELECT name FROM sqlite_master")))
        half_read[0].fetchone()
        connection.execute(insert(runs).values(name="lost", created="now"))
        raise OperationalError("SELECT", {}, Exception("disk I/O error"))

    store.writer.change(new_run("before"))
    with pytest.raises(Busy):
        store.writer.change(fail)
    store.writer.change(new_run("after"))
    assert names(store) == ["after", "before"]


def test_one_result_that_cannot_be_kept_spoils_none_of_its_neighbours(app, make):
    unsaved_results = [app.submissions.solver.solve(make(name)) for name in ("b1", "b2", "b3")]
    unsaved_results[1].result["mission_digest"] = "sha256:of nothing that is there"
    first, second, third = app.store.writer.record(unsaved_results)
    assert isinstance(second, IntegrityError)
    assert [app.results.get(each.id).answer.batch for each in (first, third)] == ["b1", "b3"]
    assert [each.batches for each in app.spacecraft.rates("XTE")] == [2]


def test_closing_writes_what_waits_and_refuses_the_rest(store, threads):
    go_on = held_up(store.writer, threads)
    waiting = [threads.submit(store.writer.change, new_run(name)) for name in "abc"]
    waiting_for_their_turn(store.writer, 3)
    closing = threads.submit(store.writer.close)
    wait_until(lambda: store.writer._turns.is_closing)
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
        writer.change(lambda connection: connection.exec_driver_sql(command).scalar())

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
    writer.change(new_run("small"))
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


@pytest.mark.parametrize("ends", [SystemExit, KeyboardInterrupt])
def test_a_change_that_ends_its_thread_is_rolled_back_and_holds_up_no_other(store, ends):
    def end(connection):
        new_run("lost")(connection)
        raise ends

    with pytest.raises(ends):
        store.writer.change(end)
    store.writer.change(new_run("later"))
    assert names(store) == ["later"]


def test_a_writer_that_is_closed_is_not_ready(app):
    app.store.writer.close()
    with pytest.raises(Stopping):
        app.store.writer.change(new_run("late"))
    with pytest.raises(Busy, match="restart the service"):
        app.service.ready()
