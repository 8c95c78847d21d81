"""What a small body that holds much may cost, and replays that are cancelled."""

import gzip
import json
import signal
import subprocess
import sys
import threading
import time
from collections import Counter

import httpx
import pytest
import zstandard
from sqlalchemy import text

from service.app.factory import open_app
from service.ingest import running_replay
from service.ingest.running_replay import RunningReplay
from service.observations import decompress
from service.storage.queries import replay_rows
from service.web.app import create_app
from tests.waiting import wait_until
from tests.web.browser import CHROMIUM
from tests.web.serving import Server, ended, in_process_settings, served
from tests.web.test_access import Guarded, shown

API = "/api/v1"
NDJSON = {"Content-Type": "application/x-ndjson"}
WAITING_FOR_THIS = text(
    "SELECT count(*) FROM pg_locks WHERE pg_backend_pid() = ANY (pg_blocking_pids(pid))"
)
"""The transactions that wait for the one that asks."""


PACKERS = {"gzip": gzip.compress, "zstd": zstandard.compress}


def begun(client, run, data, coding="identity", **headers):
    headers = NDJSON | {"Content-Encoding": coding} | headers
    answer = client.post(f"{API}/replays?run={run}", content=data, headers=headers)
    assert answer.status_code == 202, answer.text
    return answer.headers["Location"]


# ---- bounds ------------------------------------------------------------------------------------


@pytest.fixture
def few_blank_lines(monkeypatch):
    """The bound of blank lines, set so low that reading up to it takes no time."""
    monkeypatch.setattr(running_replay, "MAX_BLANK_LINES", 20_000)
    return running_replay.MAX_BLANK_LINES


@pytest.fixture
def free_bytes(monkeypatch):
    """What a body may unpack to whatever its size, set as low."""
    monkeypatch.setattr(decompress, "FREE_BYTES", 1 << 20)
    return decompress.FREE_BYTES


@pytest.mark.parametrize("coding", PACKERS)
def test_newlines_without_end_are_refused_and_leave_room_for_other_replays(
    client, batch, run, coding, few_blank_lines
):
    """Eight bodies of 5 GiB of newlines each, and a good file after them."""
    data = PACKERS[coding](b"\n" * (64 << 20)) * 80
    assert len(data) < 6 << 20
    places = [begun(client, run, data, coding) for _ in range(8)]
    for place in places:
        state = ended(client, place)
        assert state["state"] == "failed"
        (error,) = state["errors"]
        assert f"has more than {few_blank_lines} blank lines" in error["problem"]["detail"]
        assert error["line"] == few_blank_lines + 1
    good = ended(client, begun(client, run, json.dumps(batch).encode()))
    assert (good["state"], good["counts"]["new"]) == ("done", 1)


def test_blank_lines_are_bounded_where_nothing_is_packed_too(client, batch, run):
    line = json.dumps(batch).encode() + b"\n"
    state = ended(client, begun(client, run, line + b"\n" * 1_000_001))
    assert (state["state"], state["counts"]["new"]) == ("failed", 1)
    assert "has more than 1000000 blank lines" in state["errors"][0]["problem"]["detail"]


def test_blank_lines_between_batches_and_at_the_end_are_passed_over(client, batch, run):
    lines = b"\n\r\n  \n".join(
        json.dumps(batch | {"batch": f"{run}-{index}"}).encode() + b"\n" for index in range(5)
    )
    state = ended(client, begun(client, run, lines + b"\n" * 1000))
    assert (state["state"], state["counts"]["new"]) == ("done", 5)
    assert state["lines"]["done"] == state["lines"]["total"] == 5 + 4 * 3 + 1000


@pytest.mark.parametrize("coding", PACKERS)
def test_a_body_that_unpacks_to_too_much_of_its_size_says_which_bound_and_what_size(
    client, batch, run, coding, free_bytes
):
    """Spaces behind a good line; several members or frames change nothing."""
    pack = PACKERS[coding]
    data = pack(json.dumps(batch).encode() + b"\n") + pack(b" " * (1 << 20)) * 32
    state = ended(client, begun(client, run, data, coding))
    assert (state["state"], state["counts"]["new"]) == ("failed", 1)
    detail = state["errors"][-1]["problem"]["detail"]
    allowed = max(free_bytes, 200 * len(data))
    assert f"decompresses to more than {allowed} bytes" in detail
    assert "200 times its size" in detail
    assert f"{len(data)} bytes" in detail


@pytest.mark.parametrize("coding", PACKERS)
def test_telemetry_that_packs_to_a_hundredth_is_taken(
    client, batch, run, coding, free_bytes, figures
):
    """The same five stars in every batch, in several members or frames."""
    lines = many(batch, run, 200)
    again = 1 + free_bytes // len(lines)
    data = PACKERS[coding](lines) * again
    assert again * len(lines) > free_bytes
    figures(ratio=round(again * len(lines) / len(data)))
    state = ended(client, begun(client, run, data, coding))
    assert (state["state"], state["lines"]["refused"]) == ("done", 0)
    assert (state["counts"]["new"], state["counts"]["repeated"]) == (200, 200 * (again - 1))


@pytest.fixture(scope="module")
def hurried(chosen_database):
    """A service whose replays may take a second."""
    settings = in_process_settings(chosen_database(), replay_seconds=1)
    with (
        Server(create_app(open_app(settings))) as url,
        httpx.Client(base_url=url, timeout=60) as client,
    ):
        yield client


@pytest.fixture
def hold_at(monkeypatch):
    """hold_at(20): replays stop reading at the 20th time that they ask whether to go on.

    There they stay until they are cancelled or their time is over: inputs as long as in
    the real world, without the work.  Where nothing asks, a replay reads to its end.
    """

    def hold(times):
        asked, ask = Counter(), RunningReplay.require_going_on

        def ask_and_wait(replay):
            if threading.current_thread().name == f"replay-{replay.id}":
                asked[replay.id] += 1
                if asked[replay.id] >= times:
                    replay._stopping.wait(max(0.0, replay._until_s - time.monotonic()))
            ask(replay)

        monkeypatch.setattr(RunningReplay, "require_going_on", ask_and_wait)

    return hold


INPUTS = {
    "bad lines": ("gzip", gzip.compress(b"{\n" * 10_000)),
    "empty members": ("gzip", gzip.compress(b"") * 10_000),
    "empty frames": ("zstd", zstandard.compress(b"") * 500_000),
}
READS = 20
"""Reads of each of these inputs, and more."""


def test_a_replay_that_takes_too_long_ends_and_names_the_setting(hurried, hold_at):
    hold_at(READS)
    places = [begun(hurried, "long", data, coding) for coding, data in INPUTS.values()]
    for place in places:
        state = ended(hurried, place)
        assert state["state"] == "failed"
        detail = state["errors"][-1]["problem"]["detail"]
        assert "took longer than 1 s (ACQUIRE_REPLAY_SECONDS)" in detail


# ---- cancelling --------------------------------------------------------------------------------


@pytest.fixture
def running(client, batch, run, hold_at):
    """The address of a replay that has recorded something and would go on for long."""
    hold_at(2_000)
    place = begun(client, run, many(batch, run, 2_000))
    wait_for_records(client, place)
    yield place
    client.delete(place)


def many(batch, run, count=20_000):
    """Lines of telemetry: the same stars in every batch."""
    before, _, after = json.dumps(batch | {"batch": "NAME"}).partition("NAME")
    return "".join(f"{before}{run}-{index:05}{after}\n" for index in range(count)).encode()


def wait_for_records(client, place, **more):
    def has_recorded():
        state = client.get(place, **more).json()
        assert state["state"] == "running"
        return state["counts"]["new"]

    wait_until(has_recorded)


def test_a_cancelled_replay_ends_long_before_its_end_and_keeps_what_it_recorded(
    client, running, run
):
    answer = client.delete(running)
    assert (answer.status_code, answer.json()["state"]) == (200, "cancelled")
    state = client.get(running).json()
    assert state == answer.json()
    assert state["finished"] is not None
    assert 0 < state["lines"]["done"] < state["lines"]["total"]
    assert state["counts"]["new"] == state["lines"]["done"]
    (row,) = [each for each in client.get(f"{API}/runs").json()["items"] if each["run"] == run]
    assert row["batches"] == state["counts"]["new"]
    # Again is no error, and changes nothing.
    again = client.delete(running)
    assert (again.status_code, again.json()) == (200, state)


def test_a_cancelled_replay_says_how_it_goes_on_and_then_that_it_was_continued(
    client, batch, run, running
):
    """The list of replays has the control for that in the row: cancel, then to continue."""
    page = running.removeprefix(API)

    def row():
        listed = client.get("/runs").text.split("<tr>")
        return next(each for each in listed if f'href="{page}"' in each)

    for each in (row(), client.get(page).text):
        assert f'data-send="DELETE {running}"' in each
    client.delete(running)
    for each in (row(), client.get(page).text):
        assert f'<a href="/runs#into={run}">send the file again</a>.' in each
        assert "data-send" not in each.partition("data-region>")[2]
    later = begun(client, run, many(batch, run, 2_000))
    for each in (row(), client.get(page).text):
        assert f'<a href="{later.removeprefix(API)}">continued ' in each
        assert "send the file again" not in each
    client.delete(later)


def test_a_replay_is_listed_by_the_name_of_its_file(client, batch, run):
    asked = {"run": run, "name": "pass 7.ndjson"}
    head = {"Content-Type": "application/x-ndjson"}
    sent = client.post(f"{API}/replays", params=asked, content=many(batch, run, 1), headers=head)
    assert sent.json()["name"] == "pass 7.ndjson"
    assert ">pass 7.ndjson</a>" in client.get("/runs").text
    refused = client.post(f"{API}/replays", params=asked | {"name": ""}, content=b"", headers=head)
    assert [each["field"] for each in refused.json()["errors"]] == ["name"]


def test_what_listens_for_events_is_told_of_a_cancelled_replay(client, address, running, run):
    # From the first event on: what comes between the head of the answer and its first line counts.
    everything = {"Last-Event-ID": "0"}
    address = f"{address}{API}/events?run={run}"
    with httpx.stream("GET", address, timeout=30, headers=everything) as told:
        lines = told.iter_lines()
        assert client.delete(running).status_code == 200
        for line in lines:
            if line.startswith("data: ") and running.rpartition("/")[2] in line:
                data = json.loads(line.removeprefix("data: "))
                if data["state"] != "running":
                    break
    assert data["state"] == "cancelled"


def test_a_replay_that_has_ended_cannot_be_cancelled_nor_one_that_is_not_there(client, batch, run):
    place = begun(client, run, json.dumps(batch).encode())
    ended(client, place)
    answer = client.delete(place)
    assert answer.status_code == 409
    assert "its state is done" in answer.json()["detail"]
    assert client.get(place).json()["state"] == "done"
    assert client.delete(f"{API}/replays/01JD0000000000000000000000").status_code == 404
    assert client.delete(f"{API}/replays/none").status_code == 404


@pytest.mark.parametrize(("coding", "data"), INPUTS.values(), ids=INPUTS)
def test_cancelling_frees_the_place_of_a_replay_whatever_it_is_at(
    client, run, coding, data, hold_at
):
    hold_at(READS)
    headers = NDJSON | {"Content-Encoding": coding}
    places = []
    try:
        places += [begun(client, run, data, coding) for _ in range(8)]
        full = client.post(f"{API}/replays?run={run}", content=data, headers=headers)
        assert full.status_code == 503
        assert client.delete(places[0]).status_code == 200
        places.append(begun(client, run, data, coding))
    finally:
        states = [client.delete(each).json()["state"] for each in places]
    assert states == ["cancelled"] * 9


@pytest.fixture(scope="module")
def guarded(chosen_database):
    service = Guarded(chosen_database())
    of_swas = {"spacecraft": ["SWAS"]}
    service.tokens = {
        "theirs": service.token("theirs", "submit", **of_swas),
        "another": service.token("another", "submit", "read", "operate", **of_swas),
        "all": service.token("all", "submit"),
        "reader": service.token("reader", "read"),
        "operator": service.token("operator", "read", "submit", "operate"),
    }
    web_app = create_app(service.app)
    with Server(web_app) as url, httpx.Client(base_url=url, timeout=60) as service.client:
        yield service


def test_a_bound_token_cancels_its_own_replays_only_and_it_is_noted(guarded, drawn):
    client, tokens = guarded.client, guarded.tokens
    batch = drawn("SWAS", 1)[0]

    def begin(token, run):
        place = begun(client, run, many(batch, run), **shown(tokens[token]))
        wait_for_records(client, place, headers=shown(tokens[token]))
        return place

    def cancelled(token, place):
        return client.delete(place, headers=shown(tokens[token])).status_code

    one, two = begin("theirs", "one"), begin("all", "two")
    assert cancelled("another", one) == 404
    assert cancelled("theirs", two) == 404
    assert cancelled("reader", one) == 403
    assert client.delete(one).status_code == 401
    for place in (one, two):
        assert client.get(place, headers=shown(tokens["all"])).json()["state"] == "running"
    assert cancelled("theirs", one) == 200
    assert cancelled("operator", two) == 200
    noted = client.get(f"{API}/audit", headers=shown(tokens["operator"])).json()["items"]
    told = {
        (each["who"], each["about"], each["status"])
        for each in noted
        if each["action"] == "cancel_replay"
    }
    assert ("theirs", one, 200) in told
    assert ("operator", two, 200) in told


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_a_replay_of_another_process_is_cancelled_through_the_database(database, drawn):
    settings = in_process_settings(database)
    batch = drawn("XTE", 1)[0]
    with (
        Server(create_app(open_app(settings))) as one,
        Server(create_app(open_app(settings))) as other,
        httpx.Client(base_url=one, timeout=60) as client,
        httpx.Client(base_url=other, timeout=60) as elsewhere,
    ):
        place = begun(client, "r", many(batch, "r"))
        wait_for_records(client, place)
        answer = elsewhere.delete(place)
        assert (answer.status_code, answer.json()["state"]) == (200, "cancelled")
        # The process that works on it ends it with its next note, which has the last counts.
        wait_until(lambda: not any(t.name.startswith("replay-") for t in threading.enumerate()))
        (row,) = client.get(f"{API}/runs").json()["items"]
        state = client.get(place).json()
        assert row["batches"] == state["counts"]["new"] < 20_000
        assert state["state"] == "cancelled"


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_a_cancellation_that_comes_while_progress_is_noted_is_kept(database, drawn, monkeypatch):
    settings = in_process_settings(database)
    batch = drawn("XTE", 1)[0]
    places, answers = [], []
    cancelling = threading.Thread(target=lambda: answers.append(elsewhere.delete(places[0])))
    update_replay = replay_rows.update_replay

    def update_once_a_cancellation_is_on_its_way(connection, progress, *others):
        if places and progress.state == "running" and cancelling.ident is None:
            cancelling.start()
            wait_until(lambda: connection.scalar(WAITING_FOR_THIS) or not cancelling.is_alive())
        update_replay(connection, progress, *others)

    monkeypatch.setattr(replay_rows, "update_replay", update_once_a_cancellation_is_on_its_way)
    with (
        Server(create_app(open_app(settings))) as one,
        Server(create_app(open_app(settings))) as other,
        httpx.Client(base_url=one, timeout=60) as client,
        httpx.Client(base_url=other, timeout=60) as elsewhere,
    ):
        places.append(begun(client, "r", many(batch, "r")))
        (answer,) = wait_until(lambda: answers)
        cancelling.join()
        assert (answer.status_code, answer.json()["state"]) == (200, "cancelled")
        wait_until(lambda: not any(t.name.startswith("replay-") for t in threading.enumerate()))
        assert client.get(places[0]).json()["state"] == "cancelled"


def test_an_interrupted_command_cancels_its_replay_on_the_server(client, batch, run, tmp_path):
    file = tmp_path / "long.ndjson"
    file.write_bytes(many(batch, run))
    command = [sys.executable, "-m", "service.cli", "replay", str(file), "--run", run]
    command += ["--url", str(client.base_url)]
    # As from a terminal: started by a script in the background, it would ignore the signal.
    command = ["env", "--default-signal=INT", *command]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    with process:

        def begun_by_it():
            assert process.poll() is None
            return [each for each in replays(client) if each["run"] == run]

        place = f"{API}/replays/{wait_until(begun_by_it)[0]['id']}"
        wait_for_records(client, place)
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "interrupted" in complaint
    assert client.get(place).json()["state"] == "cancelled"


def replays(client):
    return client.get(f"{API}/replays").json()["items"]


@pytest.mark.slow
def test_a_service_with_processes_for_replays_cancels_too(chosen_database, drawn):
    with (
        served(chosen_database()) as (_, url),
        httpx.Client(base_url=url, timeout=60) as client,
    ):
        place = begun(client, "r", many(drawn("XTE", 1)[0], "r"))
        wait_for_records(client, place)
        answer = client.delete(place)
        assert (answer.status_code, answer.json()["state"]) == (200, "cancelled")
        assert client.delete(f"{API}/replays/01JD0000000000000000000000").status_code == 404
        # Its place is free, and so are the processes that compute.
        batch = drawn("XTE", 2)[1]
        state = ended(client, begun(client, "s", json.dumps(batch).encode()))
        assert (state["state"], state["counts"]["new"]) == ("done", 1)


@pytest.mark.skipif(CHROMIUM is None, reason="there is no chromium on this machine")
def test_the_page_of_a_running_replay_has_a_button_that_cancels_it(
    client, address, running, browser
):
    page = f"{address}{running.removeprefix('/api/v1')}"
    button = "document.querySelector('[data-send]')"
    browser.open(page)
    browser.wait(lambda: browser.run(f"{button} !== null"))
    browser.run(f"{button}.click()")
    browser.wait(lambda: browser.run("document.getElementById('message').innerText") != "Working…")
    assert browser.run("document.getElementById('message').innerText").startswith("Cancelled.")
    browser.wait(lambda: browser.run(f"{button} === null"))
    assert "cancelled" in browser.run("document.getElementById('replay').innerText")
    assert browser.complaints == []
    assert client.get(running).json()["state"] == "cancelled"


def test_the_page_of_a_replay_that_has_ended_has_no_such_button(client, batch, run):
    place = begun(client, run, json.dumps(batch).encode())
    ended(client, place)
    assert "data-send" not in client.get(place.removeprefix("/api/v1")).text
