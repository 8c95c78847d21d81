"""How many connections there may be, of whom, and which are closed for others."""

import re
import socket
import subprocess
import sys
import threading
from contextlib import ExitStack, contextmanager
from ipaddress import ip_network

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from service.web.slow_clients import Admission
from tests.fresh_databases import sqlite_at
from tests.waiting import wait_until
from tests.web.serving import Server, free_port, in_process_settings, is_ready

GET = b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n"
EVENTS = b"GET /api/v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n"
MOST, SHARE = 20, 4
PATIENCE_S = 20


@pytest.fixture(scope="module")
def crowded(tmp_path_factory):
    """A server for twenty connections, four of each address but 127.0.0.1."""
    path = tmp_path_factory.mktemp("crowded") / "acquire.db"
    app = open_app(in_process_settings(f"sqlite:///{path}"))
    admission = Admission(MOST, SHARE, [ip_network("127.0.0.1")])
    with Server(create_app(app), admission=admission) as address:
        yield address


@pytest.fixture
def connect(crowded):
    """Connects from an address of this machine, and sends something."""
    url = httpx.URL(crowded)
    wait_for_room(crowded)
    with ExitStack() as opened:

        def open_one(sent=b"", client="127.0.0.1"):
            connection = opened.enter_context(
                socket.create_connection(
                    (url.host, url.port), timeout=PATIENCE_S, source_address=(client, 0)
                )
            )
            connection.sendall(sent)
            return connection

        yield open_one


def wait_for_room(address):
    """Until the server has noticed that the last test closed its connections."""
    wait_until(lambda: httpx.get(f"{address}/livez").status_code != 503, PATIENCE_S)


def answer(connection):
    """The first line of an answer, empty where the connection was closed."""
    try:
        return connection.recv(1 << 16).partition(b"\r\n")[0]
    except ConnectionError:
        return b""


def follow(connect, count, client="127.0.0.1"):
    """Connections with a request that goes on for ever."""
    streams = [connect(EVENTS, client) for _ in range(count)]
    for each in streams:
        assert answer(each) == b"HTTP/1.1 200 OK"
    return streams


def is_open(connection):
    connection.settimeout(0.2)
    try:
        while connection.recv(1 << 16):
            pass
    except TimeoutError:
        return True
    except ConnectionError:
        pass
    return False


def test_an_idle_connection_is_closed_after_the_time_that_is_set(tmp_path):
    app = open_app(in_process_settings(f"sqlite:///{tmp_path / 'acquire.db'}"))
    with Server(create_app(app), keep_alive_seconds=1) as address:
        url = httpx.URL(address)
        with socket.create_connection((url.host, url.port), timeout=PATIENCE_S) as connection:
            connection.sendall(GET)
            assert answer(connection) == b"HTTP/1.1 200 OK"
            assert is_open(connection)
            connection.settimeout(PATIENCE_S)
            assert connection.recv(1) == b""


def test_the_connection_that_was_idle_longest_goes_for_a_new_one(connect):
    idle = [connect(b"G") for _ in range(MOST)]
    assert answer(connect(GET)) == b"HTTP/1.1 200 OK"
    assert not is_open(idle[0])
    assert is_open(idle[-1])


def test_a_connection_that_is_used_is_not_the_one_that_was_idle_longest(connect):
    used = connect()
    for _ in range(3 * MOST):
        connect(b"G")
        used.sendall(GET)
        # Head and body may come one after the other.
        told = b""
        while not told.endswith(b"alive\n"):
            piece = used.recv(1 << 16)
            assert piece
            told += piece
        assert told.startswith(b"HTTP/1.1 200 OK")


def test_an_address_has_a_share_and_gives_up_its_own(connect):
    (other,) = [connect(b"G", "127.0.0.3")]
    idle = [connect(b"G", "127.0.0.2") for _ in range(SHARE)]
    assert answer(connect(GET, "127.0.0.2")) == b"HTTP/1.1 200 OK"
    assert [is_open(each) for each in [other, *idle]] == [True, False, *(SHARE - 1) * [True]]


def test_an_address_that_uses_all_of_its_share_is_told_so_and_others_are_served(connect):
    streams = follow(connect, SHARE, "127.0.0.2")
    refused = connect(client="127.0.0.2")
    told = refused.recv(1 << 16)
    assert told.startswith(b"HTTP/1.1 503 ")
    assert b"retry-after: 1" in told
    assert answer(connect(GET, "127.0.0.3")) == b"HTTP/1.1 200 OK"
    # Streams are silent on purpose.
    assert all(is_open(each) for each in streams)
    streams[0].close()
    wait_until(lambda: answer(connect(GET, "127.0.0.2")) == b"HTTP/1.1 200 OK", PATIENCE_S)


def test_a_proxy_that_is_trusted_has_no_share(connect):
    """Behind it are many clients, as here behind 127.0.0.1."""
    follow(connect, 3 * SHARE)
    assert answer(connect(GET)) == b"HTTP/1.1 200 OK"


def test_where_every_connection_is_used_a_new_one_is_told_so(connect):
    follow(connect, MOST)
    assert answer(connect(b"")).startswith(b"HTTP/1.1 503 ")


def test_a_client_that_sends_nothing_is_let_go(connect, monkeypatch):
    monkeypatch.setattr("service.web.slow_clients.FIRST_BYTE_S", 0.5)
    silent = connect()
    assert answer(silent) == b""


class Kept:
    """Stands for a connection."""

    closed = False

    def abort(self):
        self.closed = True


def admitted(admission, *hosts):
    return [admission.admit(Kept(), host) for host in hosts]


def test_the_last_connections_are_for_this_machine():
    admission = Admission(40, reserved=16)
    busy = [Kept() for _ in range(24)]
    for number, each in enumerate(busy):
        assert admission.admit(each, f"10.0.0.{number}")
        admission.set_busy(each)
    assert admitted(admission, "10.0.1.1", "127.0.0.1", "::1", "2001:db8::1") == [
        False,
        True,
        True,
        False,
    ]


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ("10.0.0.1", "10.0.0.2", False),
        ("10.0.0.1", "::ffff:10.0.0.1", True),
        ("2001:db8::1", "2001:db8::ffff:1", True),
        ("2001:db8::1", "2001:db8:0:1::1", False),
        ("::1", "::2", False),
        ("fe80::1%eth0", "fe80::2%eth0", False),
    ],
)
def test_an_ipv6_client_is_a_network_of_64_bits(one, other, same):
    admission = Admission(100, 1)
    first = Kept()
    admission.admit(first, one)
    admission.set_busy(first)
    assert admitted(admission, other) == [not same]


def test_networks_of_trusted_proxies_have_no_share():
    admission = Admission(100, 1, [ip_network("10.0.0.0/8"), ip_network("2001:db8::/32")])
    for proxy in ("10.1.2.3", "2001:db8::7", "::ffff:10.1.2.3"):
        kept = [Kept() for _ in range(5)]
        assert all(admission.admit(each, proxy) for each in kept)
        assert not any(each.closed for each in kept)


def test_a_probe_port_that_is_taken_is_named(acquire, monkeypatch, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setenv("ACQUIRE_PROBE_PORT", str(port))
        code, _, complaint = acquire("serve", "--port", free_port())
    assert code not in (0, None)
    assert f"ACQUIRE_PROBE_PORT: cannot listen on port {port}" in complaint


@contextmanager
def with_files(most, database):
    """`acquire serve` that may open so many files: the process and its URL."""
    port = free_port()
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    command = ["sh", "-c", f'ulimit -n {most}; exec "$@"', "sh", *command, "--database", database]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        try:
            yield process, f"http://127.0.0.1:{port}"
        finally:
            process.terminate()


def test_a_start_with_too_few_files_says_how_many_it_needs(tmp_path):
    with with_files(64, sqlite_at(tmp_path / "acquire.db")) as (process, _):
        complaint = process.communicate(timeout=120.0)[1]
    assert process.returncode == 2
    (needed,) = re.findall(r"allow at least (\d+)", complaint)
    assert 64 < int(needed) <= 256
    assert "may have 64" in complaint


def test_half_open_connections_use_up_no_files_of_a_service_with_few(tmp_path):
    with (
        with_files(160, sqlite_at(tmp_path / "acquire.db")) as (process, url),
        ExitStack() as opened,
    ):
        # Its log is read, so that the pipe never fills.
        threading.Thread(target=process.stderr.read, daemon=True).start()
        wait_until(lambda: is_ready(process, url, "livez"), 120.0)
        port = httpx.URL(url).port
        for _ in range(300):
            half = opened.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE_S))
            half.sendall(b"GET /liv")
        assert httpx.get(f"{url}/livez", timeout=PATIENCE_S).status_code == 200
