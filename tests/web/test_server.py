"""The server as a process of its own: where it listens, how it stops, what it keeps."""

import resource
import signal
import socket
import subprocess
import sys

import httpx
import pytest

from service.errors import BadConfiguration
from service.settings import Settings, is_loopback
from service.web.server import _connections, serve
from tests.fresh_databases import sqlite_at
from tests.waiting import wait_until
from tests.web.serving import is_ready, serving_in_process

SERVE = """
import sys
from service.settings import Settings
from service.web.server import serve
serve(Settings(database=sys.argv[1], port=int(sys.argv[2])))
"""


@pytest.fixture
def database(tmp_path):
    return sqlite_at(tmp_path / "acquire.db")


@pytest.fixture
def process(database):
    """Starts the server in a process; gives its address and the process."""
    begun = []

    def start():
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        command = [sys.executable, "-c", SERVE, database, str(port)]
        begun.append(subprocess.Popen(command))
        address = f"http://127.0.0.1:{port}"
        wait_until(lambda: is_ready(begun[-1], address, "livez"), 600.0, every_s=0.05)
        return address, begun[-1]

    yield start
    for each in begun:
        each.kill()
        each.wait()


@pytest.mark.parametrize(
    "host", ["0.0.0.0", "::", "192.168.0.1", "10.1.2.3", "example.com", "127.0.0.1.evil.com"]
)
def test_before_there_is_a_token_it_listens_to_this_machine_alone(tmp_path, host):
    settings = Settings(database=f"sqlite:///{tmp_path / 'acquire.db'}", host=host)
    with pytest.raises(BadConfiguration, match=r"not a loopback address.*acquire token create"):
        serve(settings)


@pytest.mark.parametrize("host", ["127.0.0.1", "127.9.9.9", "::1", "localhost"])
def test_every_name_of_this_machine_counts_as_this_machine(host):
    assert is_loopback(host)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [signal.SIGTERM, signal.SIGINT])
def test_told_to_stop_it_ends_in_order_and_keeps_what_it_took(process, database, batch, stop):
    address, running = process()
    answer = httpx.post(f"{address}/api/v1/batches", json=batch, timeout=60)
    assert answer.status_code == 201
    running.send_signal(stop)
    assert running.wait(timeout=60) in (0, -stop, 130)
    with serving_in_process(database) as again:
        record = again.client.get(answer.headers["Location"]).json()
    assert record["answer"] == answer.json()


@pytest.mark.slow
def test_killed_it_keeps_what_it_acknowledged(process, database, batch):
    address, running = process()
    answer = httpx.post(f"{address}/api/v1/batches", json=batch, timeout=60)
    running.kill()
    running.wait()
    with serving_in_process(database) as service:
        again = service.client.post("/api/v1/batches", json=batch)
    assert (again.status_code, again.content) == (200, answer.content)


def test_idle_connections_are_bounded_below_the_files_that_may_be_open():
    """Beyond the bound whoever comes is told so, and is not left without an answer."""
    soft = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    bound = _connections()
    assert 16 <= bound <= max(16, resource.getrlimit(resource.RLIMIT_NOFILE)[0] // 2)
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= soft


@pytest.mark.slow
def test_killed_it_keeps_its_limits_and_alarms_and_what_was_done_about_them(process, drawn):
    address, running = process()
    (lone,) = drawn("XTE", 1, stars=1)
    limit = "/api/v1/spacecraft/XTE/limits/no_attitude_share"
    settings = {"critical": {"high": 0.5}, "minimum_count": 2, "duration_s": 0}
    with httpx.Client(base_url=address, timeout=120) as client:
        client.put(limit, json={"settings": settings, "who": "jb"}).raise_for_status()
        for name in ("b1", "b2"):
            client.post("/api/v1/batches", json=lone | {"batch": name}).raise_for_status()
        (alarm,) = client.get("/api/v1/alarms").json()["items"]
        said = {"who": "jb", "comment": "a cover is on"}
        client.post(f"/api/v1/alarms/{alarm['id']}/acknowledge", json=said).raise_for_status()
        before = client.get(f"/api/v1/alarms/{alarm['id']}").json()
    running.kill()
    running.wait()
    address, _ = process()
    with httpx.Client(base_url=address, timeout=120) as client:
        # The same batches again are no news, and raise nothing.
        client.post("/api/v1/batches", json=lone | {"batch": "b2"}).raise_for_status()
        assert client.get(f"/api/v1/alarms/{alarm['id']}").json() == before
        assert client.get(limit).json()["limit"]["settings"]["critical"]["high"] == 0.5
        assert before["actions"][-1]["comment"] == "a cover is on"
