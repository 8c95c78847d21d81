"""What several services on one database do together, and what one of them does alone."""

import asyncio
import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing

import pytest
from sqlalchemy import select

from service.access import Caller
from service.app.factory import open_app
from service.features.calibration.estimates import CalibrationRequest
from service.features.calibration.part import Calibrations
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.storage.queries.replay_rows import find_replay
from service.storage.sql.tables import results
from tests.features.calibration.wrong_file import true_batches, write_mission_files
from tests.storage import samples
from tests.waiting import wait_until

pytestmark = pytest.mark.parametrize("database", ["postgresql"], indirect=True)

WHO = "J. Operator"


@pytest.fixture
def services(database, tmp_path):
    """Two services on one database: the first of them projects."""
    settings = Settings(database=database, replay_processes=0, spool=tmp_path / "spool")
    with (
        closing(open_app(settings, serving=True)) as first,
        closing(open_app(settings, serving=True)) as second,
    ):
        assert (first.single_projector.is_projecting, second.single_projector.is_projecting) == (
            True,
            False,
        )
        yield first, second


def submitted(app, sky, missions, name, **wanted):
    return app.submissions.submit(
        submission_from_json(samples.batch(sky, missions, name, **wanted))
    )


def rates(app):
    return sum(each.batches for each in app.spacecraft.rates("XTE"))


def test_what_one_service_has_recorded_the_other_answers_and_shows_at_once(services, sky, missions):
    first, second = services
    for number in range(5):
        new = submitted(second, sky, missions, f"b{number}")
        again = submitted(first, sky, missions, f"b{number}")
        assert (new.replayed, again.replayed) == (False, True)
        assert again.body == new.body
        # The projections of the first are waited for by both.
        assert rates(second) == rates(first) == number + 1
    assert second.store.progress.lag().results == 0


def test_events_of_one_service_wake_the_other(services, sky, missions):
    first, second = services
    last = second.events.last()

    async def woken():
        news = second.store.writer.bell.subscribe()
        await asyncio.to_thread(submitted, first, sky, missions, "one")
        # Without being woken it would read them a second later.
        await asyncio.wait_for(news.wait(), 10.0)

    asyncio.run(woken())
    wait_until(lambda: second.events.after(last, 10))


def test_another_service_projects_within_two_seconds_of_the_end_of_a_session(
    services, sky, missions
):
    first, second = services
    submitted(first, sky, missions, "before")

    def pid_of(app):
        return app.context.change(
            lambda connection: connection.exec_driver_sql("SELECT pg_backend_pid()").scalar()
        )

    pid = pid_of(first)
    begun_s = time.monotonic()
    second.context.change(
        lambda connection: connection.exec_driver_sql(f"SELECT pg_terminate_backend({pid}, 5000)")
    )
    submitted(second, sky, missions, "after")
    assert rates(second) == 2
    took_s = time.monotonic() - begun_s
    assert took_s < 2.0 + 1.0, "more than two seconds, and one for a machine that is busy"
    projecting = [app.single_projector.is_projecting for app in services]
    wait_until(lambda: sum(app.single_projector.is_projecting for app in services) == 1, 10.0)
    assert any(projecting)


def test_a_calibration_that_one_service_adopted_holds_for_the_next_batch_of_the_other(
    database, sky, tmp_path
):
    write_mission_files(tmp_path)
    settings = Settings(database=database, missions=tmp_path / "assumed")
    with ExitStack() as stack:
        one, other = (
            stack.enter_context(closing(open_app(settings, serving=True))) for _ in range(2)
        )
        # It does not look for adoptions by itself.
        other.single_projector.stop()
        file = one.missions["TWO"].digest
        batches = true_batches(sky, 33)
        sent = [submission_from_json(json.dumps(each)) for each in batches]
        one.submissions.submit_many(sent[:30])
        wanted = CalibrationRequest("TWO")
        estimate = one.part(Calibrations).of_spacecraft(wanted)
        found = one.part(Calibrations).record(wanted, estimate, WHO)

        def used(submission):
            answer = json.loads(other.submissions.submit(submission).body)
            return answer["provenance"]["mission"]

        assert used(sent[30]) == file
        adopted = one.part(Calibrations).adopt(found.id, WHO)
        assert used(sent[31]) == adopted.mission != file
        # Whatever the clocks of two machines say, a later change has a later id.
        back = other.adoptions.revert("TWO", None, WHO)
        assert back.id > adopted.id
        one.in_force.follow()
        assert one.missions["TWO"].digest == file
        assert used(sent[32]) == file


@pytest.mark.slow
def test_a_replay_of_a_service_that_has_ended_is_interrupted_and_one_that_goes_on_is_not(
    services, sky, missions
):
    first, second = services
    go_on = threading.Event()

    def lines():
        yield samples.batch(sky, missions, "line").encode()
        go_on.wait(60)

    left = second.replays.start(lines(), "left")
    kept = second.replays.start(lines(), "kept")
    # As if a service had been killed that was at work on the first.
    second.store.at_work.discard(left)

    def state(id):
        with first.context.reading_record() as connection:
            return find_replay(connection, id).state

    try:
        wait_until(lambda: state(left) == "interrupted", 30.0)
        assert state(kept) == "running"
    finally:
        go_on.set()
    wait_until(lambda: state(kept) == "done", 30.0)


@pytest.mark.slow
def test_an_upload_is_followed_and_cancelled_through_the_other_service(services, sky, missions):
    first, second = services
    go_on = threading.Event()

    def lines():
        for number in range(100):
            yield samples.batch(sky, missions, f"line{number}").encode()
            go_on.wait(0.05)

    id = second.replays.start(lines(), "cancelled")
    assert first.replays.get(id).state == "running"
    assert first.replays.cancel(id, Caller("all", frozenset(), None, "other")).state == "cancelled"
    wait_until(lambda: not second.replays.at_work, 30.0)
    assert second.replays.get(id).state == "cancelled"


def tracked(sky, missions, name, after_s):
    body = json.loads(samples.batch(sky, missions, name, after_s=after_s))
    return submission_from_json(json.dumps(body | {"a_priori": {"from": "last"}}))


def predicted_from(answered):
    return json.loads(answered.body)["tracking"]["prediction"]["result"]


def test_a_batch_that_asks_for_the_last_attitude_gets_the_one_another_service_recorded_meanwhile(
    services, sky, missions, monkeypatch
):
    first, second = services
    begin = submitted(first, sky, missions, "begin")
    solver = second.submissions.solver
    solve, solved, go_on = solver.solve, threading.Event(), threading.Event()

    def solve_and_wait(*arguments, **wanted):
        unsaved = solve(*arguments, **wanted)
        solved.set()
        assert go_on.wait(30)
        return unsaved

    monkeypatch.setattr(solver, "solve", solve_and_wait)
    with ThreadPoolExecutor(1) as thread:
        late = thread.submit(second.submissions.submit, tracked(sky, missions, "late", 20.0))
        assert solved.wait(30)
        between = first.submissions.submit(tracked(sky, missions, "between", 10.0))
        go_on.set()
        assert predicted_from(between) == begin.id
        assert predicted_from(late.result(30)) == between.id


def test_batches_of_a_spacecraft_posted_to_both_services_are_one_sequence(services, sky, missions):
    submitted(services[0], sky, missions, "begin")
    posted = [tracked(sky, missions, f"b{k}", 10.0 * k) for k in range(1, 41)]
    with ThreadPoolExecutor(4) as threads:
        submit = [app.submissions.submit for app in services]
        futures = [threads.submit(submit[k % 2], each) for k, each in enumerate(posted)]
        assert not any(each.result(60).replayed for each in futures)
    with services[0].context.reading_record() as connection:
        query = select(results.c.id, results.c.time_ns, results.c.answer).order_by(results.c.seq)
        recorded = connection.execute(query).all()
    before = {recorded[0].id: recorded[0].time_ns}
    for id, time_ns, answer in recorded[1:]:
        earlier = {each: at for each, at in before.items() if at <= time_ns}
        last = json.loads(answer)["tracking"]["prediction"]["result"]
        assert last == max(earlier, key=lambda each: earlier[each])
        before[id] = time_ns
    assert len(before) == 41
