"""The one object that every door holds."""

import json
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import select

from service.errors import AcquisitionError, BadBatch, BadConfiguration, BadInput, Busy, Conflict
from service.observe.wire import OptionsIn, QuaternionIn, submission_from_json
from service.operations import Operations
from service.records import bench, intake
from service.records.tables import metadata
from service.settings import Settings
from service.times import parse_utc, utc_now
from tests.records.samples import KINDS, QUATERNION, without_accidents


def told(outcome):
    if isinstance(outcome, Exception):
        return type(outcome), str(outcome)
    return outcome.replayed, without_accidents(json.loads(outcome.body))


def test_many_at_once_give_what_each_by_itself_gives(operations, make):
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
    operations.submit(one_run[-1])
    operations.submit(other_run[-1])

    def single(submission):
        try:
            return operations.submit(submission)
        except Exception as error:
            return error

    singly = [told(single(each)) for each in one_run]
    at_once = [told(each) for each in operations.submit_many(other_run)]
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
    live, bulk = (operations.rates("XTE", run=run) for run in ("live", "bulk"))
    assert live == bulk


def everything(operations):
    """Every row of every table."""
    with operations.store.reading() as connection:
        return {
            table.name: sorted(map(str, connection.execute(select(table))))
            for table in metadata.sorted_tables
        }


def test_what_is_rehearsed_to_be_ready_is_not_kept(operations, make, caplog):
    operations.submit(make("b1", kind="suspect"))
    operations.submit(make("s1", spacecraft="SWAS"))
    before, observed = everything(operations), []
    operations.observers.append(observed.append)
    operations.ready()
    assert everything(operations) == before
    assert observed == []
    assert "rehearsed" not in caplog.text
    assert not operations.submit(make("b2")).replayed


def test_single_posts_go_before_bulk(operations, make, monkeypatch):
    """Between the batches of a bulk load whatever came one by one is computed and recorded."""
    monkeypatch.setattr(intake, "LET_PASS_S", 10.0)
    acquire, order, first_at_work = bench.acquire, [], threading.Event()

    def noting(batch, mission, sky):
        order.append(batch.batch)
        if batch.batch == "m0":
            first_at_work.set()
            time.sleep(0.5)
        return acquire(batch, mission, sky)

    monkeypatch.setattr(bench, "acquire", noting)
    bulk = [make(f"m{k}", run="bulk") for k in range(4)]
    single = make("b1")
    with ThreadPoolExecutor(1) as threads:
        many = threads.submit(operations.submit_many, bulk)
        assert first_at_work.wait(30)
        operations.submit(single)
        assert len(many.result(30)) == 4
    assert order == ["m0", "b1", "m1", "m2", "m3"]


def test_nothing_at_once_is_nothing(operations):
    assert operations.submit_many([]) == []


def test_observers_see_every_new_batch_once_and_neither_repeats_nor_what_ifs(operations, make):
    seen = []
    operations.observers.append(lambda recorded: seen.append(recorded.batch))
    first = operations.submit(make("b1"))
    operations.submit(make("b1"))
    operations.what_if(first.id, OptionsIn(), adopt=True)
    operations.submit_many([make("b1"), make("b2"), make("b2"), make("b3")])
    assert seen == ["b1", "b2", "b3"]


def test_an_observer_that_fails_takes_no_answer_away(operations, make):
    operations.observers.append(lambda recorded: 1 / 0)
    assert not operations.submit(make()).replayed


def test_ready_means_warm_and_in_reach_of_the_database(operations):
    operations.ready()
    with operations._warming:
        # What is warm stays so: nobody has to wait for it again.
        operations.ready()


def test_whoever_asks_while_another_warms_up_is_told_to_wait(operations):
    with operations._warming, pytest.raises(Busy, match="warming up"):
        operations.ready()


def test_what_is_asked_after_closing_is_busy(opened, make):
    operations = opened()
    operations.close()
    with pytest.raises(Busy, match="stopping"):
        operations.submit(make())


def test_what_was_recorded_is_there_when_opened_again(opened, make):
    first = opened().submit(make())
    again = opened().submit(make())
    assert (again.replayed, again.body) == (True, first.body)


def test_zones_show_what_is_cached_and_can_be_warmed_and_dropped(operations, make):
    time = parse_utc("1996-01-10T12:00:00.000Z")
    operations.drop_zones()
    (warmed,) = operations.warm_zones("XTE", [QuaternionIn(quaternion=QUATERNION)], time)
    assert warmed["kind"] == "cap"
    answer = json.loads(operations.submit(make()).body)
    assert answer["observations"][0]["zone"]["cached"]
    shown = operations.zones()
    (zone,) = shown["items"]
    assert (zone["spacecraft"], zone["stars"]) == ("XTE", warmed["stars"])
    assert zone["bytes"] > 0
    assert zone["hits"] == 1
    assert zone["build_us"] > 0
    assert shown["bytes"] <= shown["max_bytes"]
    assert operations.drop_zones("SWAS") == 0
    assert operations.drop_zones("XTE") == 1
    assert operations.zones()["items"] == []
    for ask in (operations.drop_zones, lambda name: operations.warm_zones(name, [], time)):
        with pytest.raises(BadBatch, match=r"spacecraft: there is no such .*'HST'"):
            ask("HST")


@pytest.mark.parametrize("name", ["none.csv", "none.npz"])
def test_a_catalog_that_cannot_be_read_is_a_mistake_in_the_configuration(tmp_path, name):
    database = f"sqlite:///{tmp_path / 'acquire.db'}"
    with pytest.raises(BadConfiguration, match=name):
        Operations.open(Settings(database=database, catalog=tmp_path / name))


def test_no_moment_of_the_database_is_held_while_many_are_worked_on(operations, make):
    held = []
    operations._intake._bench.acquire = lambda *asked, own=operations._intake._bench.acquire: (
        held.append(operations.store._readers.pool.checkedout()),
        own(*asked),
    )[1]
    operations.submit_many([make("b1"), make("b2")])
    assert held == [0, 0]


def test_many_at_once_share_the_time_of_their_recording(operations, make):
    """The sum over a chunk is what the chunk took, not that times its size."""
    sent = [make(f"b{i}", after_s=60.0 * i) for i in range(40)]
    start = time.perf_counter()
    answers = operations.submit_many(sent)
    took_us = (time.perf_counter() - start) * 1e6
    recording = [json.loads(each.body)["timings_us"]["record"] for each in answers]
    assert all(each > 0 for each in recording)
    assert sum(recording) < took_us


def test_a_fault_of_ours_in_one_batch_keeps_no_other_from_being_recorded(
    operations, make, monkeypatch, caplog
):
    def acquire(batch, *rest):
        if batch.batch == "b2":
            raise ZeroDivisionError("inside")
        return real(batch, *rest)

    real = bench.acquire
    monkeypatch.setattr(bench, "acquire", acquire)
    first, second, third = operations.submit_many([make("b1"), make("b2"), make("b3")])
    assert not first.replayed
    assert not third.replayed
    assert isinstance(second, AcquisitionError)
    assert "inside" not in str(second)
    assert "batch b2 failed" in caplog.text


def test_a_batch_was_received_before_it_was_worked_on_however_long_that_took(
    operations, make, monkeypatch
):
    table = operations._intake._bench
    acquire = table.acquire
    begun = []

    def slow(batch, mission):
        begun.append(utc_now().tai_ns)
        time.sleep(0.02)
        return acquire(batch, mission)

    monkeypatch.setattr(table, "acquire", slow)
    made = [table.draft(make("alone")), *table.drafts_or_errors([make("one"), make("other")])]
    operations.submit(make("at the desk"))
    (told,) = (each for each in operations.batches().items if each["batch"] == "at the desk")
    received = [each.received_ns for each in made] + [parse_utc(told["received"]).tai_ns]
    assert all(came <= later for came, later in zip(received, begun, strict=True))


def test_whoever_finds_every_processor_taken_for_long_is_told_to_come_again(
    operations, make, monkeypatch
):
    monkeypatch.setattr(bench, "PROCESSOR_WAIT_S", 0.01)
    free = operations._intake._bench._free
    taken = [free.get() for _ in range(operations._intake._bench.processors)]
    with pytest.raises(Busy, match="processor"):
        operations.submit(make())
    with pytest.raises(Busy, match="processor"):
        operations.submit_many([make()])
    for each in taken:
        free.put(each)
    assert not operations.submit(make()).replayed
