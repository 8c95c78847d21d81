"""`acquire serve` as one process: compiling, stopping, checks, keys and counters."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import httpx
import pytest

from service.app.factory import open_app
from service.ingest.submit import READ_HERE_BYTES
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.storage import samples
from tests.waiting import wait_until
from tests.web.load import Load
from tests.web.serving import (
    Server,
    in_process_settings,
    is_ready,
    served,
    serving_in_process,
)
from tests.web.test_access import Guarded, shown

JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """A service over its own database: its address."""
    database = sqlite_at(tmp_path_factory.mktemp("one") / "acquire.db")
    with serving_in_process(database) as service:
        yield service.url


@pytest.fixture
def compiling(tmp_path):
    """A service whose kernels are not compiled yet: its process and its address."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    command += ["--database", sqlite_at(tmp_path / "acquire.db")]
    nothing_compiled = {"NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen(command, stderr=log, env=os.environ | nothing_compiled)
    url = f"http://127.0.0.1:{port}"
    try:
        wait_until(lambda: is_ready(process, url, "livez"), 600.0, every_s=0.05)
        yield process, url
    finally:
        process.kill()
        process.wait()


def _children(process):
    tasks = Path(f"/proc/{process.pid}/task").glob("*/children")
    return [int(pid) for task in tasks for pid in task.read_text().split()]


@pytest.mark.slow
def test_while_it_compiles_posts_are_told_to_come_again_and_told_to_stop_it_stops(
    compiling, tmp_path, sky, missions
):
    """As at the first start after an installation, which takes minutes."""
    process, url = compiling
    assert httpx.get(f"{url}/readyz").status_code == 503
    early = samples.batch(sky, missions, "early")
    answer = httpx.post(f"{url}/api/v1/batches", content=early, headers=JSON)
    assert (answer.status_code, int(answer.headers["Retry-After"]) > 0) == (503, True)
    process.terminate()
    assert process.wait(30) in (0, -signal.SIGTERM)
    assert "Traceback" not in (tmp_path / "log").read_text()


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are listed in /proc")
def test_killed_while_it_compiles_it_leaves_no_process(compiling):
    process, _ = compiling
    wait_until(lambda: _children(process), 120.0)
    children = _children(process)
    process.kill()
    process.wait()
    wait_until(lambda: not any(_is_running(pid) for pid in children))


def _is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_small_and_large_batches_are_refused_in_the_same_words(service, sky, missions):
    """A small one is checked in the event loop, a large one elsewhere."""
    good = json.loads(samples.batch(sky, missions, "good"))
    wrong = good | {"time": "yesterday"}
    star = good["observations"][0]["stars"][0]
    many = 2 * READ_HERE_BYTES // len(json.dumps(star))
    large = wrong | {"observations": [good["observations"][0] | {"stars": [star] * many}]}

    def faults(body):
        answer = httpx.post(f"{service}/api/v1/batches", json=body, timeout=60)
        assert answer.status_code == 422, answer.text
        return [each for each in answer.json()["errors"] if each["field"] == "time"]

    assert faults(wrong) == faults(large)


def test_a_key_is_that_of_the_token_it_came_with(chosen_database, sky, missions):
    """Two clients with tokens of their own use the same key for batches of their own."""
    guarded = Guarded(chosen_database())
    tokens = [guarded.token(name, "submit") for name in ("one", "other")]
    sent = [samples.batch(sky, missions, name) for name in ("a", "b")]
    with Server(create_app(guarded.app)) as url, httpx.Client(base_url=url, timeout=60) as client:

        def post(token, body):
            headers = JSON | shown(token) | {"Idempotency-Key": "same"}
            return client.post("/api/v1/batches", content=body, headers=headers)

        firsts = [post(token, body) for token, body in zip(tokens, sent, strict=True)]
        assert [answer.status_code for answer in firsts] == [201, 201]
        for token, body, first, others in zip(tokens, sent, firsts, reversed(sent), strict=True):
            again = post(token, body)
            assert (again.status_code, again.content) == (200, first.content)
            refused = post(token, others)
            assert (refused.status_code, refused.json()["type"]) == (422, "/problems/key-reused")


def test_the_metrics_count_new_batches_repeats_and_zones(service, sky, missions):
    for name in ("one", "two", "two"):
        body = samples.batch(sky, missions, name)
        answer = httpx.post(f"{service}/api/v1/batches", content=body, headers=JSON, timeout=60)
        answer.raise_for_status()
    text = httpx.get(f"{service}/metrics").text
    told = [line for line in text.splitlines() if line.startswith("starid_batches_total")]
    assert sum(float(line.rsplit(" ", 1)[1]) for line in told) == 2.0
    assert "starid_batches_repeated_total 1.0" in text
    assert "starid_zone_cache_misses_total 0.0" not in text


def test_told_to_stop_under_load_it_answers_what_it_took_and_ends_soon(tmp_path, sky, missions):
    database = sqlite_at(tmp_path / "acquire.db")
    with served(database) as (process, url):
        template = samples.batch(sky, missions, "NAME")
        load = Load(httpx.URL(url).port, template)
        with httpx.stream("GET", f"{url}/api/v1/events", timeout=60) as stream:
            events = stream.iter_lines()
            assert next(events).startswith("retry:")
            try:
                wait_until(lambda: len(load.acknowledged) > 50)
                process.terminate()
                assert process.wait(60) in (0, -signal.SIGTERM)
            finally:
                load.give_up()
    app = open_app(in_process_settings(database))
    try:
        for id, _ in load.acknowledged.values():
            assert app.results.get(id).current
    finally:
        app.close()
