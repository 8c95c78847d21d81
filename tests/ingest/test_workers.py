"""Replays computed by processes of their own: the same answers, whatever becomes of a process."""

import json
import os
import pickle
import re
import signal
import subprocess
import sys
import threading
from collections import Counter
from functools import partial
from multiprocessing import forkserver
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import httpx
import msgspec
import pytest
from sqlalchemy import select

from service.acquire.kernel_build import SIGNALS
from service.app.factory import open_app
from service.errors import AcquisitionError, BadBatch, BadConfiguration, BadInput
from service.ingest.bulk import identity_in
from service.ingest.local_workers import (
    MOST_DEATHS,
    ChunkEndsWorkers,
    LocalWorkers,
    WorkerLost,
)
from service.ingest.worker_process import WorkerConfig
from service.observations.schema import submission_from_json
from service.settings import Settings
from service.storage.sql.tables import batches
from tests import waiting
from tests.fresh_databases import sqlite_at
from tests.ingest.test_replays import finished
from tests.ingest.worker_tasks import double, half_sent, settings_once_there, unreadable
from tests.scale import draws
from tests.storage import samples
from tests.storage.samples import without_accidents

GIVE_UP_S = 120.0
wait_until = partial(waiting.wait_until, seconds=GIVE_UP_S)


def server_pid():
    """The process that forks workers; None before the first."""
    return forkserver._forkserver._forkserver_pid


def is_there(pid):
    return Path(f"/proc/{pid}").exists()


def workers_of(app):
    return sorted(app.replays.bulk.workers.pids)


def with_workers(app, count=1):
    """The operations, once so many workers are ready."""
    app.replays.bulk.workers.start()
    wait_until(lambda: app.replays.processes() == count, why="no worker is ready")
    return app


def names_in(app, run):
    with app.store.reading() as connection:
        return list(connection.scalars(select(batches.c.batch).where(batches.c.run == run)))


def answers_in(app, run):
    items = app.results.page(run=run, limit=500).items
    return {each.batch: msgspec.to_builtins(app.results.get(each.id).answer) for each in items}


@pytest.fixture
def sent(make):
    """Batches of every kind, more than one transaction of them."""
    kinds = [samples.KINDS[k % len(samples.KINDS)] for k in range(80)]
    return [make(f"b{k}", kind=kind, after_s=60.0 * k) for k, kind in enumerate(kinds)]


@pytest.fixture
def lines(sent):
    return [each.text.encode() + b"\n" for each in sent]


def endless(text):
    """The lines of one batch after the other, and how many there were."""
    number = 0
    while True:
        yield text.replace('"b1"', f'"n{number}"', 1).encode()
        number += 1


def test_workers_answer_what_single_posts_are_answered(opened, sent, lines, make):
    """Bad lines, repeats and conflicts included; the serving process computes none of it.

    They are counted all the same.
    """
    app = opened(replay_processes=1)
    for each in sent:
        app.submissions.submit(each)
    with_workers(app)
    conflict = make("b0", stars=4).text.encode()
    unknown = lines[1].replace(b'"XTE"', b'"HST"')
    tracker = make("b90").text.replace('"tracker":"', '"tracker":"no-').encode()
    more = [b'{"cut', lines[3], unknown, tracker, b"\n", conflict]
    app.zones.drop(None)
    before, counted = app.zones.state().misses, app.submissions.counts

    replay = finished(app, app.replays.start(lines + more, "bulk"))
    again = finished(app, app.replays.start(lines + more, "bulk"))

    assert app.zones.state().misses == before
    single, bulk = answers_in(app, "live"), answers_in(app, "bulk")
    assert single.keys() == bulk.keys()
    for name, answer in bulk.items():
        assert without_accidents(answer) | {"run": "live"} == without_accidents(single[name])
    assert (replay.counts.new, replay.counts.repeated) == (80, 1)
    assert (again.counts.new, again.counts.repeated) == (0, 81)
    told = {each.line: each.problem for each in replay.errors}
    assert told == {each.line: each.problem for each in again.errors}
    assert told.keys() == {81, 83, 84, 86}
    for number, text in ((81, more[0]), (83, unknown), (84, tracker)):
        with pytest.raises(BadInput) as refusal:
            app.submissions.submit(submission_from_json(text))
        assert told[number].detail.startswith(str(refusal.value.faults[0]))
    assert "another body" in told[86].detail
    solved = sum(answer["attitude"] is not None for answer in bulk.values())
    assert counted.batches["XTE", False, True] == solved
    assert counted.batches["XTE", False, False] == 80 - solved
    for outcome in ("unique", "ambiguous", "unmatched"):
        found = sum(answer["counts"][outcome] for answer in bulk.values())
        assert counted.stars["XTE", False, outcome] == found


@pytest.mark.slow
def test_workers_that_are_killed_again_and_again_cost_and_double_nothing(opened, make):
    app = with_workers(opened(replay_processes=2), 2)
    killed, wanted, between = [], draws(500, 2000), draws(250, 500)
    over = threading.Event()

    def numbered():
        for number, text in zip(range(wanted), endless(make().text), strict=False):
            if number % between == between // 2:
                killed.extend(workers_of(app))
                for pid in workers_of(app):
                    os.kill(pid, signal.SIGKILL)
            yield text
        over.set()

    # Other processes are started and load the kernels, each time.
    replay = finished(app, app.replays.start(numbered(), "bulk"), GIVE_UP_S * 2)
    assert over.is_set()
    assert len(set(killed)) >= 2
    assert (replay.state, replay.errors) == ("done", [])
    assert replay.counts.new == wanted
    assert Counter(names_in(app, "bulk")) == Counter(f"n{k}" for k in range(wanted))
    with_workers(app, 2)
    assert not set(workers_of(app)) & set(killed)


def test_closing_ends_workers_and_replays_at_once(opened, make):
    # Those of other services in this process stay.
    others = set(threading.enumerate())
    app = with_workers(opened(replay_processes=1))
    id = app.replays.start(endless(make().text), "endless")
    wait_until(lambda: app.replays.get(id).lines.done > 100, why="nothing is recorded")
    (pid,) = workers_of(app)
    app.close()
    assert not is_there(pid)
    left = set(threading.enumerate()) - others
    assert not [each for each in left if each.name.startswith("worker-")]
    later = opened()
    replay = later.replays.get(id)
    assert replay.state == "interrupted"
    assert len(names_in(later, "endless")) == replay.lines.done


@pytest.fixture
def local_workers(sky):
    """Makes workers, by default without missions; all are ended.

    They load only the kernels that depend on no mission.
    """
    made = []

    def make_workers(work, count=1, missions=None, catalog=None):
        config = WorkerConfig(missions or {}, catalog, sky.catalog.digest, 1 << 20)
        made.append(LocalWorkers(config, work, count))
        return made[-1]

    yield make_workers
    for each in made:
        closing = threading.Thread(target=each.close, daemon=True)
        closing.start()
        closing.join(GIVE_UP_S)
        assert not closing.is_alive()


def test_workers_that_are_still_starting_are_ended_as_well(local_workers, tmp_path):
    never_read = tmp_path / "catalog.npz"
    os.mkfifo(never_read)
    before = waiting.children_of(server_pid()) if server_pid() else set()
    workers = local_workers(double, catalog=never_read)
    workers.start()
    started = wait_until(
        lambda: waiting.children_of(server_pid()) - before, why="no worker is started"
    )
    workers.close()
    assert not workers.pids
    wait_until(
        lambda: not waiting.children_of(server_pid()) & started, why="a worker is left behind"
    )


def assert_13_is_lost(futures, error=WorkerLost):
    for number, future in futures.items():
        if number == 13:
            assert isinstance(future.exception(GIVE_UP_S), error)
        else:
            assert future.result(GIVE_UP_S) == [2 * number]


def test_a_chunk_that_ends_its_processes_is_named_and_costs_no_other(local_workers):
    workers = local_workers(double, 2)
    futures = {number: workers.submit(number) for number in (1, 2, 13, 4, 5)}
    assert_13_is_lost(futures, ChunkEndsWorkers)
    assert workers.submit(6).result(GIVE_UP_S) == [12]


@pytest.mark.slow
def test_the_server_of_workers_is_idle_and_its_death_costs_no_chunk(local_workers):
    """It has no thread and no database that a fork could tear; a stop signal does not reach it."""
    workers = local_workers(double)
    assert workers.submit(1).result(GIVE_UP_S) == [2]
    process = Path(f"/proc/{server_pid()}")
    assert len(list((process / "task").iterdir())) == 1
    opened = [os.readlink(each) for each in (process / "fd").iterdir()]
    assert not [each for each in opened if ".db" in each]
    blocked = int(re.search(r"SigBlk:\s+(\w+)", (process / "status").read_text())[1], 16)
    assert all(blocked >> (each - 1) & 1 for each in SIGNALS)
    before = workers.pids
    os.kill(server_pid(), signal.SIGKILL)
    # By a worker that does not know yet, or by its successor.
    assert workers.submit(2).result(GIVE_UP_S) == [4]
    wait_until(lambda: not any(map(is_there, before)), why="a worker is left behind")
    assert workers.submit(3).result(GIVE_UP_S) == [6]
    assert not workers.pids & before


@pytest.fixture
def dies_at_start(monkeypatch):
    """Has the next so many processes die before anything else happens."""
    left = []
    start = ForkServerProcess.start

    def killed(process):
        start(process)
        if left:
            left.pop()
            process.kill()
            process.join()

    monkeypatch.setattr(ForkServerProcess, "start", killed)
    return lambda starts: left.extend(range(starts))


@pytest.mark.parametrize("starts", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_process_that_dies_at_its_start_costs_no_chunk(local_workers, dies_at_start, starts):
    workers = local_workers(double, 2)
    assert workers.submit(1).result(GIVE_UP_S) == [2]
    # Those that take the place of the one that dies over 13 die at their start.
    dies_at_start(starts)
    assert_13_is_lost({number: workers.submit(number) for number in (2, 13, 4, 5, 6)})


def test_a_process_that_dies_while_others_are_started_is_replaced(local_workers, dies_at_start):
    """Though no chunk is handed in: a replay hands none in before processes are ready."""
    workers = local_workers(double, 2)
    dies_at_start(1)
    workers.start()

    def are_up():
        workers.start()
        return workers.up == 2

    wait_until(are_up, why="the processes have no successors")


def test_a_result_that_cannot_be_read_is_told(local_workers):
    workers = local_workers(unreadable)
    assert isinstance(workers.submit(13).exception(GIVE_UP_S), WorkerLost)
    assert workers.submit(1).result(GIVE_UP_S) == [1]


def test_processes_that_are_replaced_on_purpose_are_not_held_against_a_chunk(
    local_workers, tmp_path
):
    workers = local_workers(settings_once_there)
    future = workers.submit(str(tmp_path / "go-on"))
    for _ in range(MOST_DEATHS + 1):
        before = workers.pids
        wait_until(lambda before=before: workers.pids - before, why="no worker is ready")
        assert not future.done()
        workers.restart()
    (tmp_path / "go-on").touch()
    assert future.result(GIVE_UP_S) == []


@pytest.mark.slow
def test_a_process_that_dies_while_it_sends_a_result_costs_no_other_chunk(local_workers):
    workers = local_workers(half_sent, 2)
    futures = {number: workers.submit(number) for number in (1, 13, 2, 3)}
    for number, future in futures.items():
        if number == 13:
            assert isinstance(future.exception(GIVE_UP_S), ChunkEndsWorkers)
        else:
            assert future.result(GIVE_UP_S) == [bytes(1 << 20)]


def test_restarted_workers_have_the_settings_of_now_and_lose_no_chunk(
    local_workers, missions, tmp_path
):
    used = {"XTE": missions["XTE"]}
    workers = local_workers(settings_once_there, missions=used)
    assert workers.submit(str(tmp_path)).result(GIVE_UP_S) == [missions["XTE"].digest]
    pending = [workers.submit(str(tmp_path / "go-on")) for _ in range(4)]
    used["XTE"] = missions["XTE"].within_zones
    assert used["XTE"].digest != missions["XTE"].digest
    workers.restart()
    (tmp_path / "go-on").touch()
    assert [each.result(GIVE_UP_S) for each in pending] == [[used["XTE"].digest]] * 4


class Served:
    """`acquire serve` in a process group of its own, with one worker at work on a replay."""

    def __init__(self, folder, lines):
        self.database = sqlite_at(folder / "acquire.db")
        self._said = folder / "said"
        command = [sys.executable, "-m", "service.cli", "serve", "--port", "0"]
        environment = os.environ | {"ACQUIRE_REPLAY_PROCESSES": "1"}
        with self._said.open("wb") as said:
            self.process = subprocess.Popen(
                [*command, "--database", self.database],
                stdout=said,
                stderr=said,
                env=environment,
                start_new_session=True,
            )
        wait_until(lambda: "running on http" in self.said, why="the service did not start")
        address = self.said.partition("running on ")[2].split()[0]
        with httpx.Client(base_url=address, timeout=60) as client:
            wait_until(lambda: client.get("/readyz").status_code == 200, why="it is not ready")
            head = {"Content-Type": "application/x-ndjson"}

            def send(content, run):
                path = f"/api/v1/replays?run={run}"
                client.post(path, content=content, headers=head).raise_for_status()

            def is_up():
                return "\nstarid_replay_processes 1.0" in client.get("/metrics").text

            send(lines[0], "first")
            wait_until(is_up, why="no worker is ready")
            assert 'run="named",spacecraft="XTE"} 1.0' in client.get("/metrics").text
            self.children = waiting.children_of(self.process.pid)
            send(b"\n".join(lines), "bulk")
            wait_until(
                lambda: client.get("/api/v1/batches?run=bulk&limit=1").json()["items"],
                why="nothing is recorded",
            )

    @property
    def said(self):
        return self._said.read_text()

    def left(self):
        return set(filter(is_there, self.children))


@pytest.fixture
def long_replay(make):
    return [text for _, text in zip(range(20_000), endless(make().text), strict=False)]


@pytest.mark.slow
def test_no_worker_outlives_a_service_that_is_killed(tmp_path, long_replay):
    served = Served(tmp_path, long_replay)
    assert served.children
    served.process.kill()
    served.process.wait()
    wait_until(lambda: not served.left(), why="a worker is left behind")


@pytest.mark.slow
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM], ids=lambda each: each.name)
def test_whoever_stops_the_whole_group_stops_it_in_order(tmp_path, long_replay, stop):
    """As Ctrl-C does, and systemd."""
    served = Served(tmp_path, long_replay)
    os.killpg(served.process.pid, stop)
    assert served.process.wait(60) in (0, -stop)
    wait_until(lambda: not served.left(), why="a worker is left behind")
    assert "Traceback" not in served.said
    assert "a worker ended" not in served.said
    app = open_app(Settings(database=served.database))
    try:
        newest, _ = app.replays.all()
        assert newest.state == "waiting"
        names = names_in(app, "bulk")
        assert len(names) == newest.lines.done < len(long_replay)
        assert set(names) == {f"n{k}" for k in range(len(names))}
    finally:
        app.close()


def test_a_catalog_that_was_changed_meanwhile_is_not_mixed_with_the_one_before(missions):
    with pytest.raises(BadConfiguration, match="changed"):
        WorkerConfig(missions, None, "sha256:another", 1 << 20).solver()


def test_errors_cross_processes_whole(make):
    text = make().text.replace('"vector":', '"vektor":')
    with pytest.raises(AcquisitionError) as refusal:
        submission_from_json(text)
    copy = pickle.loads(pickle.dumps(refusal.value))
    assert type(copy) is BadBatch
    assert (str(copy), copy.faults) == (str(refusal.value), refusal.value.faults)


def test_a_line_is_called_in_passing_what_it_is_called(make):
    text = make("name").text.encode()
    assert identity_in(text, "r") == ("XTE", "r", "name")
    assert identity_in(json.dumps(json.loads(text) | {"batch": "\n"}).encode(), "r") is None
    for bad in (b"", b"[]", b"\xff", b'{"batch": 1}', b'{"x":' + b"[" * 100_000):
        assert identity_in(bad, "r") is None
