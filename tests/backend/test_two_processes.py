"""The service in two processes: what each does, and what becomes of one without the other."""

import inspect
import json
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from service.backend.front import ASKED, CHECKED_HERE_BYTES, Front
from service.backend.process import Backend
from service.operations import Operations
from tests.records import samples

READ_HERE = {
    "active_alarms",
    "alarm",
    "alarms",
    "attitudes",
    "audit",
    "batch",
    "batches",
    "compare_runs",
    "default_run",
    "events_after",
    "every_batch",
    "history",
    "last_event",
    "limit",
    "limits",
    "neighbours",
    "overview",
    "rates",
    "reading",
    "replay",
    "replays",
    "runs",
    "settings_for",
    "spacecraft",
    "spacecraft_of",
    "spacecraft_state",
    "worst_batches",
}
"""What looks into the records alone."""
NOT_OVER_HTTP = {
    "open",
    "reprocess",
    "start_replay",
    "submit",
    "submit_many",
    "take",
    "take_all",
    "take_all_here",
}
"""What commands and the backend itself call."""


def test_every_method_is_read_here_or_asked_of_the_backend():
    public = {
        name
        for name, each in vars(Operations).items()
        if not name.startswith("_") and (inspect.isroutine(each) or isinstance(each, property))
    }
    own = {name for name in vars(Front) if name in public} - set(ASKED)
    assert public - READ_HERE - NOT_OVER_HTTP - set(ASKED) == own
    assert not READ_HERE & set(ASKED)


def test_an_error_that_cannot_be_packed_is_told_in_words():
    class Tied(Exception):
        def __init__(self):
            super().__init__(threading.Lock())

    backend = Backend(None, None, None)
    backend._settle(7, Tied())
    ((number, error),) = backend._telling.failed
    assert (number, type(error)) == (7, RuntimeError)
    assert "Tied" in str(pickle.loads(pickle.dumps(error)))


@pytest.fixture
def served(tmp_path):
    """A service over its own database: its address and its process."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    command += ["--database", f"sqlite:///{tmp_path / 'acquire.db'}"]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(command, stderr=log, start_new_session=True)
    url = f"http://127.0.0.1:{port}"
    try:
        _until(lambda: httpx.get(f"{url}/readyz").status_code == 200, process)
        yield url, process
    finally:
        process.kill()
        process.wait()


def _until(holds, process=None, seconds=180):
    give_up = time.monotonic() + seconds
    while time.monotonic() < give_up:
        assert process is None or process.poll() is None, "the service ended"
        try:
            if holds():
                return
        except httpx.TransportError:
            pass
        time.sleep(0.05)
    raise AssertionError("it did not come to pass")


def _parent_of(pid):
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return None
    state, parent = stat.rpartition(")")[2].split()[:2]
    return None if state == "Z" else int(parent)


def _backend_of(process):
    pids = [int(each.name) for each in Path("/proc").iterdir() if each.name.isdigit()]
    for pid in pids:
        if _parent_of(pid) == process.pid:
            command = Path(f"/proc/{pid}/cmdline").read_bytes()
            if b"service.backend" in command:
                return pid
    return None


needs_proc = pytest.mark.skipif(
    not Path("/proc/self/stat").exists(), reason="processes are looked up in /proc"
)


def test_told_to_stop_while_it_compiles_it_does_not_finish_that_first(tmp_path):
    """As at the first start after an installation, which takes minutes."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    command += ["--database", f"sqlite:///{tmp_path / 'acquire.db'}"]
    nothing_compiled = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    process = subprocess.Popen(
        command, stderr=subprocess.PIPE, env=os.environ | nothing_compiled, start_new_session=True
    )
    try:
        url = f"http://127.0.0.1:{port}"
        _until(lambda: httpx.get(f"{url}/livez").status_code == 200, process)
        assert httpx.get(f"{url}/readyz").status_code == 503
        process.terminate()
        _, told = process.communicate(timeout=30)
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, b"Traceback" in told) in ((0, False), (-signal.SIGTERM, False))


@needs_proc
def test_without_the_front_the_backend_ends_at_once(served):
    _, process = served
    backend = _backend_of(process)
    process.kill()
    process.wait()
    _until(lambda: _parent_of(backend) is None, seconds=10)


@needs_proc
def test_what_is_wrong_with_the_form_of_a_batch_is_said_without_the_backend(served, sky, missions):
    """A long batch is checked there, where nobody else waits for it; the words are the same."""
    url, process = served
    good = json.loads(samples.batch(sky, missions, "good"))
    wrong = good | {"time": "yesterday"}
    star = good["observations"][0]["stars"][0]
    many = 2 * CHECKED_HERE_BYTES // len(json.dumps(star))
    long = wrong | {"observations": [good["observations"][0] | {"stars": [star] * many}]}

    def post(body):
        return httpx.post(f"{url}/api/v1/batches", json=body, timeout=60)

    def faults(answer):
        assert answer.status_code == 422, answer.text
        return [each for each in answer.json()["errors"] if each["field"] == "time"]

    with ThreadPoolExecutor(2) as threads:
        os.kill(_backend_of(process), signal.SIGSTOP)
        try:
            later = [threads.submit(post, body) for body in (good, long)]
            told = faults(post(wrong))
            assert not any(each.done() for each in later)
        finally:
            os.kill(_backend_of(process), signal.SIGCONT)
        taken, checked_there = (each.result() for each in later)
    assert taken.status_code == 201
    assert faults(checked_there) == told


@needs_proc
def test_a_backend_that_dies_is_replaced_and_nothing_acknowledged_is_lost(served, sky, missions):
    url, process = served
    template = samples.batch(sky, missions, "NAME")
    acknowledged, refused, stop = {}, [], threading.Event()

    def post():
        number = 0
        with httpx.Client(base_url=url, timeout=60) as client:
            while not stop.is_set():
                name = f"{threading.get_ident()}-{number}"
                body = template.replace("NAME", name)
                answer = client.post(
                    "/api/v1/batches", content=body, headers={"Content-Type": "application/json"}
                )
                if answer.status_code == 503:
                    # The same again: if it was recorded all the same, that is the answer.
                    refused.append(answer.json()["detail"])
                    time.sleep(0.1)
                    continue
                assert answer.status_code in (200, 201), answer.text
                acknowledged[name] = answer.json()
                number += 1

    threads = [threading.Thread(target=post) for _ in range(4)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(2):
            before = len(acknowledged)
            _until(lambda before=before: len(acknowledged) > before + 30, process)
            first = _backend_of(process)
            os.kill(first, signal.SIGKILL)
            # Reading and being alive do not depend on it.
            assert httpx.get(f"{url}/livez").status_code == 200
            assert httpx.get(f"{url}/api/v1/batches?limit=1").status_code == 200
            _until(lambda first=first: _backend_of(process) not in (None, first), process)
        before = len(acknowledged)
        _until(lambda: len(acknowledged) > before + 30, process)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    assert all("started again" in each or "warming" in each for each in refused), refused
    recorded = _recorded(url)
    for answer in acknowledged.values():
        assert recorded.count(answer["id"]) == 1
        record = httpx.get(f"{url}/api/v1/batches/{answer['id']}").json()
        assert record["answer"] == answer
    # What was recorded and not acknowledged came again and was acknowledged then.
    assert len(recorded) == len(acknowledged)


@needs_proc
def test_a_backend_that_finds_its_database_unusable_is_tried_again_until_it_is_not(
    served, sky, missions, tmp_path
):
    url, process = served

    def post(name):
        body = samples.batch(sky, missions, name)
        head = {"Content-Type": "application/json"}
        return httpx.post(f"{url}/api/v1/batches", content=body, headers=head, timeout=60)

    assert post("before").status_code == 201
    aside = tmp_path / "aside"
    aside.mkdir()
    files = list(tmp_path.glob("acquire.db*"))
    for each in files:
        each.rename(aside / each.name)
    database = tmp_path / "acquire.db"
    database.write_text("this is no database" * 100)
    os.kill(_backend_of(process), signal.SIGKILL)
    _until(lambda: b"could not be started" in (tmp_path / "log").read_bytes(), process)
    assert post("meanwhile").status_code == 503
    assert httpx.get(f"{url}/readyz").status_code == 503
    database.unlink()
    for each in files:
        (aside / each.name).rename(each)
    _until(lambda: post("after").status_code in (200, 201), process)
    assert len(_recorded(url)) == 2


def _recorded(url):
    """The ids of all that is recorded."""
    ids, cursor = [], None
    while True:
        asked = {"limit": 500} | ({"cursor": cursor} if cursor else {})
        page = httpx.get(f"{url}/api/v1/batches", params=asked).json()
        ids += [each["id"] for each in page["items"]]
        if (cursor := page["next_cursor"]) is None:
            return ids


@needs_proc
@pytest.mark.parametrize("whom", ["front", "all"])
def test_told_to_stop_both_end_in_order(served, sky, missions, whom):
    url, process = served
    body = samples.batch(sky, missions, "kept")
    answer = httpx.post(
        f"{url}/api/v1/batches",
        content=body,
        headers={"Content-Type": "application/json"},
        timeout=60,
    )
    assert answer.status_code == 201
    backend = _backend_of(process)
    if whom == "front":
        process.terminate()
    else:
        os.killpg(process.pid, signal.SIGTERM)
    assert process.wait(30) in (0, -signal.SIGTERM)
    assert _parent_of(backend) is None


def test_a_key_is_that_of_the_token_it_came_with(served, sky, missions, tmp_path):
    """Two clients with tokens of their own use the same key for batches of their own."""
    url, _ = served
    database = f"sqlite:///{tmp_path / 'acquire.db'}"
    command = [sys.executable, "-m", "service.cli", "token", "create"]
    tokens = [
        subprocess.run(
            [*command, name, "--scope", "submit", "--database", database],
            check=True,
            capture_output=True,
            text=True,
        ).stdout.split()[0]
        for name in ("one", "other")
    ]
    time.sleep(1.1)
    sent = [samples.batch(sky, missions, name) for name in ("a", "b")]

    def post(token, body):
        headers = {"Authorization": f"Bearer {token}", "Idempotency-Key": "same"}
        headers["Content-Type"] = "application/json"
        return httpx.post(f"{url}/api/v1/batches", content=body, headers=headers, timeout=60)

    firsts = [post(token, body) for token, body in zip(tokens, sent, strict=True)]
    assert [answer.status_code for answer in firsts] == [201, 201]
    for token, body, first, others in zip(tokens, sent, firsts, reversed(sent), strict=True):
        again = post(token, body)
        assert (again.status_code, again.content) == (200, first.content)
        refused = post(token, others)
        assert (refused.status_code, refused.json()["type"]) == (422, "/problems/key-reused")


def test_what_the_backend_counts_the_front_tells(served, sky, missions):
    url, _ = served
    for name in ("one", "two", "two"):
        body = samples.batch(sky, missions, name)
        httpx.post(
            f"{url}/api/v1/batches",
            content=body,
            headers={"Content-Type": "application/json"},
            timeout=60,
        ).raise_for_status()
    text = httpx.get(f"{url}/metrics").text
    told = [line for line in text.splitlines() if line.startswith("starid_batches_total")]
    assert sum(float(line.rsplit(" ", 1)[1]) for line in told) == 2.0
    assert "starid_batches_repeated_total 1.0" in text
    assert "starid_zone_cache_misses_total 0.0" not in text
