"""Replays on the server: in the background, a line at a time, into a run of their own."""

import io
import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import update

from service.errors import BadBatch, Busy, Stopping
from service.records.tables import replays
from service.records.writer import Writer


def finished(operations, id):
    give_up = time.monotonic() + 60
    while (replay := operations.replay(id))["finished"] is None and time.monotonic() < give_up:
        time.sleep(0.01)
    return replay


@pytest.fixture
def lines(make):
    return [make(f"b{index}", after_s=60.0 * index).text.encode() + b"\n" for index in range(10)]


def test_every_line_is_recorded_in_the_run_and_none_in_live(operations, lines):
    replay = finished(operations, operations.start_replay(lines, "pass-1", "pass-1.ndjson"))
    assert replay["state"] == "done"
    assert replay["lines"] == {"total": None, "done": 10, "refused": 0}
    assert (replay["run"], replay["name"], replay["errors"]) == ("pass-1", "pass-1.ndjson", [])
    assert replay["started"] <= replay["finished"]
    assert [each["batches"] for each in operations.rates("XTE", run="pass-1")] == [10]
    assert operations.rates("XTE") == []
    assert operations.batches().items == []


def test_a_bad_line_is_reported_with_its_number_and_the_rest_goes_on(operations, lines, make):
    lines[3] = b'{"spacecraft": "XTE", "batch": \n'
    lines[5] = b"\n"
    lines[7] = make("b0", stars=4).text.encode() + b"\n"
    replay = finished(operations, operations.start_replay(lines, "pass-1"))
    assert replay["state"] == "done"
    assert replay["lines"] == {"total": None, "done": 10, "refused": 2}
    truncated, conflict = replay["errors"]
    assert truncated["line"] == 4
    assert truncated["problem"]["errors"]
    assert (conflict["line"], "another body" in conflict["problem"]["detail"]) == (8, True)
    assert len(operations.batches(run="pass-1").items) == 7


def test_a_replay_is_safe_to_run_twice(operations, lines):
    for _ in range(2):
        replay = finished(operations, operations.start_replay(lines, "pass-1"))
        assert replay["lines"]["refused"] == 0
    assert [each["batches"] for each in operations.rates("XTE", run="pass-1")] == [10]


def test_lines_that_can_be_closed_are_closed_at_the_end(operations, lines):
    file = io.BytesIO(b"".join(lines))
    finished(operations, operations.start_replay(file, "pass-1"))
    assert file.closed


def test_that_a_replay_is_over_is_noted_once_the_database_can_be_written_again(
    operations, lines, monkeypatch
):
    monkeypatch.setattr("service.records.replays.BUSY_PAUSE_S", 0.01)
    change, refused = operations.store.writer.change, []

    def refuse(change):
        refused.append(change)
        raise Busy("the database cannot be written now")

    class Closed:
        """Nothing can be written from the moment when the lines are closed, for a while."""

        def __iter__(self):
            return iter(lines)

        def close(self):
            monkeypatch.setattr(
                operations.store.writer,
                "change",
                lambda made: refuse(made) if len(refused) < 3 else change(made),
            )

    replay = finished(operations, operations.start_replay(Closed(), "pass-1"))
    assert len(refused) == 3
    assert (replay["state"], replay["lines"]["done"]) == ("done", 10)


def test_the_first_thousand_errors_are_kept_and_all_are_counted(operations):
    replay = finished(operations, operations.start_replay([b"{\n"] * 1200, "pass-1"))
    assert replay["lines"]["refused"] == 1200
    assert [each["line"] for each in replay["errors"]] == list(range(1, 1001))


def test_lines_that_break_off_fail_the_replay_and_keep_what_was_read(operations, lines):
    def broken():
        yield from lines
        raise OSError("the file is gone")

    replay = finished(operations, operations.start_replay(broken(), "pass-1"))
    assert replay["state"] == "failed"
    assert "the file is gone" in replay["errors"][0]["problem"]["detail"]


@pytest.mark.parametrize("run", ["no spaces", "-", "x" * 65])
def test_a_run_that_cannot_be_named_so_is_refused(operations, run):
    with pytest.raises(BadBatch, match="run"):
        operations.start_replay([], run)


def test_closing_interrupts_a_replay_and_keeps_what_it_recorded(opened, make):
    def endless():
        index = 0
        while True:
            yield make(f"b{index}").text.encode()
            index += 1

    operations = opened()
    id = operations.start_replay(endless(), "endless")
    give_up = time.monotonic() + 60
    while operations.replay(id)["lines"]["done"] == 0 and time.monotonic() < give_up:
        time.sleep(0.01)
    operations.close()
    later = opened()
    replay = later.replay(id)
    assert replay["state"] == "interrupted"
    (run,) = later.runs()
    assert run["batches"] == replay["lines"]["done"]


def test_what_a_killed_process_left_running_is_marked_interrupted_on_opening(opened, lines):
    operations = opened()
    id = operations.start_replay(lines, "pass-1")
    finished(operations, id)
    left = update(replays).values(state="running", finished=None)
    operations.store.writer.change(lambda connection: connection.execute(left)).result()
    operations.close()
    assert opened().replay(id)["state"] == "interrupted"


def test_progress_is_json_ready(operations, lines):
    json.dumps(finished(operations, operations.start_replay(lines, "pass-1")))


def test_replays_that_begin_together_are_all_stopped_by_closing(opened, make):
    """None is forgotten while its row is on its way to the table."""

    def endless():
        index = 0
        while True:
            yield make(f"b{index % 50}").text.encode()
            index += 1

    operations = opened()
    with ThreadPoolExecutor(6) as threads:
        ids = list(threads.map(lambda n: operations.start_replay(endless(), f"r{n}"), range(6)))
    assert len(operations._replays) == 6
    operations.close()
    assert not [each for each in threading.enumerate() if each.name.startswith("replay-")]
    later = opened()
    assert {later.replay(id)["state"] for id in ids} == {"interrupted"}


def test_a_replay_does_not_outlive_a_service_that_stops_under_it(operations, lines, monkeypatch):
    monkeypatch.setattr(Writer, "record", lambda *_: (_ for _ in ()).throw(Stopping("stopping")))
    replay = finished(operations, operations.start_replay(lines, "pass-1"))
    assert (replay["state"], replay["lines"]["refused"]) == ("interrupted", 0)


def test_none_begins_once_the_service_is_stopping(opened, lines):
    operations = opened()
    operations.close()
    with pytest.raises(Stopping):
        operations.start_replay(lines, "pass-1")


def test_replays_have_a_bound_in_number(operations, lines, monkeypatch):
    monkeypatch.setattr("service.operations.MAX_REPLAYS", 1)
    go_on = threading.Event()

    def waiting():
        go_on.wait(30)
        yield from lines

    id = operations.start_replay(waiting(), "pass-1")
    with pytest.raises(Busy, match="1 replays are at work"):
        operations.start_replay(lines, "pass-2")
    go_on.set()
    finished(operations, id)


def test_what_is_kept_of_bad_lines_is_bounded(operations):
    wrong = json.dumps({"k" * 30_000 + str(k): 1 for k in range(20)}).encode()
    replay = finished(operations, operations.start_replay([wrong] * 100, "pass-1"))
    assert replay["lines"]["refused"] == 100
    assert len(json.dumps(replay["errors"])) < 200_000
