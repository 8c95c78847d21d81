"""Replays on the server: in the background, a line at a time, into a run of their own."""

import io
import json
import threading
from concurrent.futures import ThreadPoolExecutor

import msgspec
import pytest
from msgspec.structs import asdict
from sqlalchemy import update

from service.errors import BadBatch, Busy, Stopping
from service.storage.recording.writer import Writer
from service.storage.sql.tables import replays
from tests.waiting import wait_until


def finished(app, id, seconds=60):
    """The state of a replay when it is over."""
    wait_until(
        lambda: app.replays.get(id).finished is not None, seconds, why="the replay does not end"
    )
    return app.replays.get(id)


@pytest.fixture
def lines(make):
    return [make(f"b{index}", after_s=60.0 * index).text.encode() + b"\n" for index in range(10)]


@pytest.mark.both_databases
def test_every_line_is_recorded_in_the_run_and_none_in_live(app, lines):
    replay = finished(app, app.replays.start(lines, "pass-1", name="pass-1.ndjson"))
    assert replay.state == "done"
    assert asdict(replay.lines) == {"total": None, "done": 10, "refused": 0}
    assert (replay.run, replay.name, replay.errors) == ("pass-1", "pass-1.ndjson", [])
    assert replay.started <= replay.finished
    assert [each.batches for each in app.spacecraft.rates("XTE", run="pass-1")] == [10]
    assert app.spacecraft.rates("XTE") == []
    assert app.results.page().items == []


def test_a_bad_line_is_reported_with_its_number_and_the_rest_goes_on(app, lines, make):
    lines[3] = b'{"spacecraft": "XTE", "batch": \n'
    lines[5] = b"\n"
    lines[7] = make("b0", stars=4).text.encode() + b"\n"
    replay = finished(app, app.replays.start(lines, "pass-1"))
    assert replay.state == "done"
    assert asdict(replay.lines) == {"total": None, "done": 10, "refused": 2}
    truncated, conflict = replay.errors
    assert truncated.line == 4
    assert truncated.problem.errors
    assert (conflict.line, "another body" in conflict.problem.detail) == (8, True)
    assert len(app.results.page(run="pass-1").items) == 7


@pytest.mark.both_databases
def test_a_replay_is_safe_to_run_twice(app, lines):
    for _ in range(2):
        replay = finished(app, app.replays.start(lines, "pass-1"))
        assert replay.lines.refused == 0
    assert [each.batches for each in app.spacecraft.rates("XTE", run="pass-1")] == [10]


def test_lines_that_can_be_closed_are_closed_at_the_end(app, lines):
    file = io.BytesIO(b"".join(lines))
    finished(app, app.replays.start(file, "pass-1"))
    assert file.closed


def test_that_a_replay_is_over_is_noted_once_the_database_can_be_written_again(
    app, lines, monkeypatch
):
    monkeypatch.setattr("service.ingest.running_replay.SAVE_PAUSE_S", 0.01)
    change, refused = app.store.writer.change, []

    def refuse(change):
        refused.append(change)
        raise Busy("the database cannot be written now")

    class Closed:
        """Nothing can be written from the moment when the lines are closed, for a while."""

        def __iter__(self):
            return iter(lines)

        def close(self):
            monkeypatch.setattr(
                app.store.writer,
                "change",
                lambda made: refuse(made) if len(refused) < 3 else change(made),
            )

    replay = finished(app, app.replays.start(Closed(), "pass-1"))
    assert len(refused) == 3
    assert (replay.state, replay.lines.done) == ("done", 10)


def test_the_first_thousand_errors_are_kept_and_all_are_counted(app):
    replay = finished(app, app.replays.start([b"{\n"] * 1200, "pass-1"))
    assert replay.lines.refused == 1200
    assert [each.line for each in replay.errors] == list(range(1, 1001))


def test_lines_that_break_off_fail_the_replay_and_keep_what_was_read(app, lines):
    def broken():
        yield from lines
        raise OSError("the file is gone")

    replay = finished(app, app.replays.start(broken(), "pass-1"))
    assert replay.state == "failed"
    assert "the file is gone" in replay.errors[0].problem.detail


@pytest.mark.parametrize("run", ["no spaces", "-", "x" * 65])
def test_a_run_that_cannot_be_named_so_is_refused(app, run):
    with pytest.raises(BadBatch, match="run"):
        app.replays.start([], run)


def test_closing_interrupts_a_replay_and_keeps_what_it_recorded(opened, make):
    def endless():
        index = 0
        while True:
            yield make(f"b{index}").text.encode()
            index += 1

    app = opened()
    id = app.replays.start(endless(), "endless")
    wait_until(lambda: app.replays.get(id).lines.done, 60, why="no line is recorded")
    app.close()
    later = opened()
    replay = later.replays.get(id)
    assert replay.state == "interrupted"
    (run,) = later.runs.all()
    assert run.batches == replay.lines.done


def test_what_a_killed_process_left_running_is_marked_interrupted_on_opening(opened, lines):
    app = opened()
    id = app.replays.start(lines, "pass-1")
    finished(app, id)
    left = update(replays).values(state="running", finished=None)
    app.store.writer.change(lambda connection: connection.execute(left))
    app.close()
    assert opened().replays.get(id).state == "interrupted"


def test_progress_is_json_ready(app, lines):
    replay = finished(app, app.replays.start(lines, "pass-1"))
    assert json.loads(msgspec.json.encode(replay))["lines"]["done"] == 10


def test_replays_that_begin_together_are_all_stopped_by_closing(opened, make):
    """None is forgotten while its row is on its way to the table."""

    def endless():
        index = 0
        while True:
            yield make(f"b{index % 50}").text.encode()
            index += 1

    app = opened()
    with ThreadPoolExecutor(6) as threads:
        ids = list(threads.map(lambda n: app.replays.start(endless(), f"r{n}"), range(6)))
    assert len(app.replays.at_work) == 6
    app.close()
    assert not [each for each in threading.enumerate() if each.name.startswith("replay-")]
    later = opened()
    assert {later.replays.get(id).state for id in ids} == {"interrupted"}


def test_a_replay_does_not_outlive_a_service_that_stops_under_it(app, lines, monkeypatch):
    monkeypatch.setattr(
        Writer, "record", lambda *_, **named: (_ for _ in ()).throw(Stopping("stopping"))
    )
    replay = finished(app, app.replays.start(lines, "pass-1"))
    assert (replay.state, replay.lines.refused) == ("interrupted", 0)


def test_none_begins_once_the_service_is_stopping(opened, lines):
    app = opened()
    app.close()
    with pytest.raises(Stopping):
        app.replays.start(lines, "pass-1")


def test_replays_have_a_bound_in_number(app, lines, monkeypatch):
    monkeypatch.setattr("service.app.replays.MAX_REPLAYS", 1)
    go_on = threading.Event()

    def waiting():
        go_on.wait(30)
        yield from lines

    id = app.replays.start(waiting(), "pass-1")
    with pytest.raises(Busy, match="1 replays are running"):
        app.replays.start(lines, "pass-2")
    go_on.set()
    finished(app, id)


def test_what_is_kept_of_bad_lines_is_bounded(app):
    wrong = json.dumps({"k" * 30_000 + str(k): 1 for k in range(20)}).encode()
    replay = finished(app, app.replays.start([wrong] * 100, "pass-1"))
    assert replay.lines.refused == 100
    assert len(msgspec.json.encode(replay.errors)) < 200_000
