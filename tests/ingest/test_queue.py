"""The queue of submissions: repeats wait, slow batches delay no other, turns are fair."""

import asyncio
import json
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

import pytest

from service.errors import BadInput, BeingBuilt, Busy, Fault, Stopping
from service.ingest import queue
from service.ingest import solver_pool as pools
from service.ingest.solver_pool import FairQueue, SolverPool, SolverTask, may_take_long
from service.observations.schema import submission_from_json
from service.sky.cache import NotAtHand
from service.sky.whole_sky.index import build_sky_index
from tests.waiting import wait_until

PATIENCE_S = 20.0


class Held:
    """Holds the computing of batches whose names are given until it is let go."""

    def __init__(self, monkeypatch, *names):
        self.begun, self.go_on = threading.Event(), threading.Event()
        self.computed = []
        acquire = pools.acquire

        def holding(batch, mission, sky):
            self.computed.append(batch.batch)
            if batch.batch in names:
                self.begun.set()
                assert self.go_on.wait(PATIENCE_S)
            return acquire(batch, mission, sky)

        def together(batches, *rest, at_once):
            assert at_once
            short = [batch for batch in batches if batch.batch not in names]
            self.computed += [batch.batch for batch in short]
            found = iter(acquired(short, *rest, at_once=True) if short else ())
            return [next(found) if batch in short else NotAtHand() for batch in batches]

        acquired = pools.acquired
        monkeypatch.setattr(pools, "acquire", holding)
        monkeypatch.setattr(pools, "acquired", together)


@pytest.fixture
def send(app):
    def sent(submission, caller=None):
        return app.submissions.queued(submission, None, caller, Future())

    return sent


def test_a_batch_that_takes_long_delays_no_other(send, make, monkeypatch):
    held = Held(monkeypatch, "slow")
    slow = send(make("slow"))
    assert held.begun.wait(PATIENCE_S)
    for k in range(50):
        assert not send(make(f"quick {k}")).result(PATIENCE_S).replayed
    assert not slow.done()
    held.go_on.set()
    assert not slow.result(PATIENCE_S).replayed


def test_what_takes_long_is_told_as_soon_as_it_shows(app, make, monkeypatch):
    """A zone that has to be built, and an attitude that only the whole sky tells."""
    app.zones.drop()
    threads = []
    acquire = pools.acquire
    monkeypatch.setattr(
        pools,
        "acquire",
        lambda *asked: (threads.append(threading.current_thread().name), acquire(*asked))[1],
    )
    app.submissions.submit(make("builds its zone"))
    app.submissions.submit(make("has its zone"))
    assert len(threads) == 1
    wrong = json.loads(make("wrong").text)
    wrong["a_priori"] = {"quaternion": [0.0, 0.0, 0.0, 1.0]}
    app.submissions.submit(submission_from_json(json.dumps(wrong)))
    # Twice more where the sky had to be built first.
    assert len(threads) >= 2
    assert all(name.startswith("solver") for name in threads)


def test_what_the_pool_computes_before_its_caller_goes_on_is_recorded_once(app, make, monkeypatch):
    pool = app.submissions.pool
    monkeypatch.setattr(pool, "put", lambda task, turn, is_long: task.work())
    app.zones.drop()
    answer = app.submissions.submit(make("quick"))
    assert not answer.replayed
    assert [each.id for each in app.results.page().items] == [answer.id]


def test_a_repeat_of_what_is_computed_waits_for_it_and_gets_its_answer(send, make, monkeypatch):
    held = Held(monkeypatch, "same")
    first = send(make("same"))
    assert held.begun.wait(PATIENCE_S)
    again = [send(make("same")) for _ in range(5)]
    send(make("other")).result(PATIENCE_S)
    assert not any(each.done() for each in again)
    held.go_on.set()
    answer = first.result(PATIENCE_S)
    for each in again:
        assert each.result(PATIENCE_S).replayed
        assert each.result().body == answer.body
    assert held.computed.count("same") == 1


@pytest.mark.both_databases
def test_what_could_not_be_recorded_is_tried_again_by_its_repeat(send, make, monkeypatch):
    failing = [ZeroDivisionError("inside")]
    held = Held(monkeypatch, "same")
    acquire = pools.acquire

    def fail_once(*given):
        acquisition = acquire(*given)
        if failing:
            raise failing.pop()
        return acquisition

    monkeypatch.setattr(pools, "acquire", fail_once)
    first = send(make("same"))
    assert held.begun.wait(PATIENCE_S)
    again = send(make("same"))
    held.go_on.set()
    assert isinstance(first.exception(PATIENCE_S), ZeroDivisionError)
    assert not again.result(PATIENCE_S).replayed


def test_those_that_are_too_many_are_refused_at_once(send, make, monkeypatch):
    monkeypatch.setattr(queue, "MAX_WAITING", 3)
    held = Held(monkeypatch, "b0")
    waiting = [send(make("b0"))]
    assert held.begun.wait(PATIENCE_S)
    waiting += [send(make("b0")) for _ in range(2)]
    with pytest.raises(Busy, match="3 batches are waiting"):
        send(make("b0"))
    held.go_on.set()
    assert [each.result(PATIENCE_S).replayed for each in waiting] == [False, True, True]


class HeldWriter:
    """Holds the writer in a change until it is let go."""

    def __init__(self, app):
        self.go_on, begun = threading.Event(), threading.Event()

        def hold(_connection):
            begun.set()
            assert self.go_on.wait(PATIENCE_S)

        self._thread = threading.Thread(target=app.store.writer.change, args=(hold,))
        self._thread.start()
        assert begun.wait(PATIENCE_S)

    def let_go(self):
        self.go_on.set()
        self._thread.join(PATIENCE_S)


@pytest.fixture
def held_writer(app):
    held = HeldWriter(app)
    yield held
    held.let_go()


def test_what_waited_too_long_may_come_again(app, send, make, held_writer):
    first = send(make("b1"))
    wait_until(lambda: app.store.writer.state().queued == 1)
    late = app.submissions.queue_made(
        ("XTE", "live", "b2"), "f", None, None, None, Future(), is_long=False, wait_s=0.0
    )
    held_writer.let_go()
    assert isinstance(late.exception(PATIENCE_S), Busy)
    assert not first.result(PATIENCE_S).replayed
    assert not app.submissions.submit(make("b2")).replayed


def test_look_up_and_solving_are_no_wait_to_be_written(app, make, monkeypatch):
    app.submissions.submit(make("builds its zone"))
    acquired = pools.acquired

    def slowly(*given, **options):
        time.sleep(0.5)
        return acquired(*given, **options)

    monkeypatch.setattr(pools, "acquired", slowly)
    monkeypatch.setattr(app.store.writer, "_wait_s", 0.25)
    assert not app.submissions.submit(make("b1")).replayed


def test_batches_that_wait_together_are_committed_together(app, send, make):
    app.submissions.submit(make("builds its zone"))
    before, held = app.store.writer.commits, HeldWriter(app)
    sent = [send(make(f"b{k}")) for k in range(20)]
    held.let_go()
    assert not any(each.result(PATIENCE_S).replayed for each in sent)
    # The change that held it, the first batch, and the others.
    assert app.store.writer.commits - before <= 3


def test_the_answers_of_a_group_reach_an_event_loop_together(app, make):
    sent = [make(f"b{k}") for k in range(8)]
    app.submissions.submit(make("its zone is at hand then"))

    async def post_all():
        loop = asyncio.get_running_loop()
        calls = []
        call_soon = loop.call_soon_threadsafe
        loop.call_soon_threadsafe = lambda *given: (calls.append(given), call_soon(*given))[1]
        held = HeldWriter(app)
        first = app.submissions.queued(make("b first"), None, None, loop.create_future())
        wait_until(lambda: app.store.writer.state().queued == 1)
        futures = [app.submissions.queued(each, None, None, loop.create_future()) for each in sent]
        held.let_go()
        await first
        calls.clear()
        return await asyncio.gather(*futures), len(calls)

    answers, calls = asyncio.run(post_all())
    assert [json.loads(each.body)["batch"] for each in answers] == [f"b{k}" for k in range(8)]
    assert calls <= 1


def test_a_client_that_has_gone_keeps_no_other_from_its_answer(app, make):
    async def post():
        loop = asyncio.get_running_loop()
        gone, stays = (
            app.submissions.queued(make(name), None, None, loop.create_future())
            for name in ("gone", "stays")
        )
        gone.cancel()
        return await stays

    assert not asyncio.run(post()).replayed
    assert app.submissions.submit(make("gone")).replayed


def test_turns_go_around_between_clients_whatever_one_has_sent():
    tasks = FairQueue()
    for k in range(3):
        tasks.put("many", f"many {k}")
    tasks.put("one", "one")
    tasks.put("two", "two")
    assert [tasks.get() for _ in range(5)] == ["many 0", "one", "two", "many 1", "many 2"]
    assert not tasks


def test_long_tasks_leave_a_thread_to_short_ones():
    pool, go_on = SolverPool(2), threading.Event()
    done = []
    give_up_s = time.monotonic() + PATIENCE_S
    for _ in range(5):
        pool.put(
            SolverTask(lambda: go_on.wait(PATIENCE_S), done.append, give_up_s), "a", is_long=True
        )
    for k in range(5):
        assert pool.call(lambda k=k: k, "a", is_long=False) == k
    go_on.set()
    pool.close()


def test_a_task_that_was_not_begun_in_time_is_refused():
    pool, go_on, refused = SolverPool(2), threading.Event(), Future()
    now = time.monotonic()
    hold = SolverTask(lambda: go_on.wait(PATIENCE_S), print, now + PATIENCE_S)
    for _ in range(2):
        pool.put(hold, "a", is_long=False)
    pool.put(SolverTask(print, refused.set_result, now), "a", is_long=False)
    go_on.set()
    assert isinstance(refused.result(PATIENCE_S), Busy)
    pool.close()


def test_closing_finishes_what_has_begun_and_refuses_what_has_not():
    pool, begun, go_on = SolverPool(2), threading.Event(), threading.Event()
    with ThreadPoolExecutor(3) as threads:

        def work():
            begun.set()
            return go_on.wait(PATIENCE_S)

        first = threads.submit(pool.call, work, "a", is_long=True)
        assert begun.wait(PATIENCE_S)
        second = threads.submit(pool.call, work, "b", is_long=True)
        wait_until(lambda: pool._long, why="the second task is not queued")
        closing = threads.submit(pool.close)
        assert isinstance(second.exception(PATIENCE_S), Stopping)
        go_on.set()
        assert first.result(PATIENCE_S) is True
        closing.result(PATIENCE_S)
    with pytest.raises(Stopping):
        pool.call(print, "a", is_long=False)


def test_a_task_that_waits_for_what_is_built_gives_its_thread_to_others():
    pool, built, tries = SolverPool(2), Future(), []

    def needs_it():
        tries.append(1)
        if not built.done():
            raise BeingBuilt(built)
        return "answer"

    with ThreadPoolExecutor(5) as threads:
        waiting = [
            threads.submit(pool.call, needs_it, "a", is_long=is_long)
            for is_long in (False, False, False, True, True)
        ]
        wait_until(lambda: len(tries) == 5, why="they were not begun")
        for is_long in (False, True):
            assert pool.call(lambda: "at once", "a", is_long=is_long) == "at once"
        assert not any(each.done() for each in waiting)
        built.set_result(None)
        assert [each.result(PATIENCE_S) for each in waiting] == ["answer"] * 5
    pool.close()


def test_what_cannot_be_built_fails_the_tasks_that_wait_for_it():
    pool, built = SolverPool(2), Future()

    def needs_it():
        raise BeingBuilt(built)

    with ThreadPoolExecutor(1) as threads:
        waiting = threads.submit(pool.call, needs_it, "a", is_long=False)
        built.set_exception(BadInput(Fault("limit", "too deep")))
        with pytest.raises(BadInput, match="too deep"):
            waiting.result(PATIENCE_S)
    pool.close()


def test_a_batch_waits_for_the_sky_that_it_needs_and_others_pass(app, make, monkeypatch, tmp_path):
    """Nothing is built in the way of a post: the whole sky is asked for by the first one alone."""
    begun, go_on = threading.Event(), threading.Event()

    def build(*arguments):
        begun.set()
        assert go_on.wait(PATIENCE_S)
        return build_sky_index(*arguments)

    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr("service.sky.model.build_sky_index", build)
    lost = json.loads(make("lost", stars=8).text) | {"a_priori": None}
    app.submissions.submit(make("b0"))
    with ThreadPoolExecutor(3) as threads:
        waiting = [
            threads.submit(
                app.submissions.submit, submission_from_json(json.dumps(lost | {"batch": f"l{k}"}))
            )
            for k in range(3)
        ]
        assert begun.wait(PATIENCE_S)
        for k in range(1, 5):
            app.submissions.submit(make(f"b{k}"))
        assert not any(each.done() for each in waiting)
        go_on.set()
        answers = [json.loads(each.result(PATIENCE_S).body) for each in waiting]
    assert [each["path"] for each in answers] == ["lost_in_space"] * 3
    assert all(each["attitude"]["status"] == "good" for each in answers)


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_thread_that_ended_or_stalls_is_noticed(app, send, make, monkeypatch):
    service = app.submissions

    def is_alive():
        with suppress(Stopping):
            service.require_alive()
            return True
        return False

    assert is_alive()
    monkeypatch.setattr(queue, "STALLED_S", 0.1)
    go_on = threading.Event()
    look_up = queue.look_up
    monkeypatch.setattr(
        queue, "look_up", lambda *given: (go_on.wait(PATIENCE_S), look_up(*given))[1]
    )
    stalled = send(make("b1"))
    wait_until(lambda: not is_alive(), why="the stalled thread is not noticed")
    with pytest.raises(Stopping, match="restart"):
        service.require_alive()
    go_on.set()
    stalled.exception(PATIENCE_S)
    wait_until(is_alive, why="the thread counts as stalled though it goes on")

    both_sent = threading.Event()
    monkeypatch.setattr(queue, "look_up", lambda *given: (both_sent.wait(PATIENCE_S), sys.exit()))
    waiting = [send(make(name)) for name in ("b2", "b3")]
    both_sent.set()
    for each in waiting:
        assert isinstance(each.exception(PATIENCE_S), Stopping)
    with pytest.raises(Stopping):
        send(make("b4"))
    with pytest.raises(Stopping, match="restart"):
        service.require_alive()
    with pytest.raises(Stopping):
        app.service.ready()


@pytest.mark.parametrize(
    ("change", "is_long"),
    [
        ({}, False),
        ({"options": {"tolerances": {"separation_deg": 0.3}}}, True),
        ({"options": {"identifier": "lost_in_space"}}, True),
        ({"a_priori": None}, True),
    ],
)
def test_what_may_take_long_is_told_by_its_form(make, change, is_long):
    sent = json.loads(make("b1").text) | change
    assert may_take_long(submission_from_json(json.dumps(sent)).batch) is is_long


def test_many_stars_and_inaccurate_ones_may_take_long(make):
    sent = json.loads(make("b1").text)
    stars = sent["observations"][0]["stars"]
    sent["observations"][0]["stars"] = [stars[0] | {"sigma_arcsec": 600.0}, *stars[1:]]
    assert may_take_long(submission_from_json(json.dumps(sent)).batch)
    sent["observations"][0]["stars"] = [
        star | {"magnitude": star["magnitude"] + 0.001 * k} for k in range(50) for star in stars
    ]
    assert may_take_long(submission_from_json(json.dumps(sent)).batch)


@pytest.mark.parametrize(("lines", "is_long"), [(100, False), (401, True)])
def test_a_raster_may_have_as_many_stars_as_its_lines_can_show(make, lines, is_long):
    sent = json.loads(make("b1").text)
    sums = {"column_counts": [1.0] * lines, "row_counts": [1.0] * lines}
    sent["observations"][0] |= {"stars": [], **sums}
    assert may_take_long(submission_from_json(json.dumps(sent)).batch) is is_long
