"""Clients that are slow, or send far too much, cost others nothing and the server no memory."""

import json
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path

import httpx
import pytest

from tests import scale
from tests.fresh_databases import sqlite_at
from tests.scale import size
from tests.web.healthy import answers, resident_mb, tries
from tests.web.serving import served

SLOW = size(1_000, 100)
HEALTHY = size(1_000, 100)
"""Posts by one client, each answered before the next is sent."""
TURNS = 5
SETTLING = size(200, 20)
PATIENCE_S = 300
CHECKOUT = Path(__file__).parents[2]
HUGE_BYTES = 300_000_000 if scale.is_full() else 60_000_000
"""Of each of `SENDERS`: several times what the server may hold in all."""
SENDERS = 4
# As much as connections hold by themselves; of longer answers see below.
UNREAD = "GET /api/v1/batches?limit=100 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
HEAD = (
    "POST /api/v1/batches HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    "Content-Length: 100000\r\n\r\n{"
)


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A server in processes of its own, so that its memory is its own; ready for work."""
    with served(sqlite_at(tmp_path_factory.mktemp("slow") / "acquire.db")) as (process, url):
        yield process, httpx.URL(url).port, url


def connected(port):
    return socket.create_connection(("127.0.0.1", port), timeout=30)


@pytest.mark.torture
@pytest.mark.slow
def test_a_thousand_slow_connections_harm_nobody(server, batch, figures):
    """Some stop in the middle of the head or the body, some trickle, some do not read an answer."""
    process, port, url = server
    names = iter(f"beside-slow-{number}" for number in range(1_000_000))

    def while_slow(client):
        slow = [connected(port) for _ in range(SLOW)]
        sent = [HEAD[:40], HEAD, HEAD, UNREAD]
        taken = []
        try:
            for number, connection in enumerate(slow):
                connection.sendall(sent[number % 4].encode())
            # To answer those that will not read is work like any other, and soon done.
            answers(client, batch, names, SETTLING)
            for _ in range(TURNS):
                for connection in slow[1::4]:
                    connection.sendall(b" ")
                taken += answers(client, batch, names, HEALTHY // TURNS)
            return taken, resident_mb(process)
        finally:
            for connection in slow:
                connection.close()

    with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        # A page that is not read shall be a long one; and what it takes to answer so many at
        # once, quick or slow, is there before: threads, each with a connection to the database.
        answers(client, batch, names, 3 * SETTLING)
        with ThreadPoolExecutor(SLOW // 4) as threads:
            for page in threads.map(httpx.get, SLOW // 4 * [f"{url}{UNREAD.split()[1]}"]):
                assert page.status_code == 200
        tried = tries(
            process, lambda: answers(client, batch, names, HEALTHY // 2), lambda: while_slow(client)
        )
    figures(slow_connections=SLOW, healthy_posts=HEALTHY, tries=list(map(str, tried)))


@pytest.mark.torture
@pytest.mark.parametrize("how", [pytest.param("declared", marks=pytest.mark.slow), "chunked"])
def test_bodies_of_300_megabytes_are_refused_without_being_held(server, batch, how, figures):
    process, port, url = server
    names = iter(f"beside-{how}-{number}" for number in range(1_000_000))
    told, passed = [], []

    def while_flooded(client):
        """As long as it takes for enough healthy requests, and each flood to its end."""
        taken, most_mb = [], 0.0
        while len(taken) < HEALTHY:
            command = [sys.executable, "-m", "tests.web.flood", str(port), how]
            with subprocess.Popen(
                [*command, str(SENDERS), str(HUGE_BYTES)], cwd=CHECKOUT, stdout=subprocess.PIPE
            ) as flood:
                while flood.poll() is None:
                    taken += answers(client, batch, names, 1)
                    most_mb = max(most_mb, resident_mb(process))
                assert flood.returncode == 0
                said = json.loads(flood.stdout.read())
            told.extend(said["told"])
            passed.append(said["passed"])
        return taken, most_mb

    with httpx.Client(base_url=url, timeout=PATIENCE_S) as client:
        answers(client, batch, names, SETTLING)
        tried = tries(
            process,
            lambda: answers(client, batch, names, HEALTHY // 2),
            lambda: while_flooded(client),
        )
    figures(
        bodies=len(passed) * SENDERS,
        taken_off_mb=sum(passed) // 1_000_000,
        told_413=len(told),
        healthy_posts=HEALTHY,
        tries=list(map(str, tried)),
    )
    assert told
    assert all(each.startswith("HTTP/1.1 413 ") for each in told)
    assert httpx.get(f"{url}/livez").status_code == 200


LONG = 60
"""Answers asked for at once: more than the system's own buffers hold."""


def asking_much(address):
    """A connection that has asked for a long answer, again and again."""
    url = httpx.URL(address)
    connection = socket.create_connection((url.host, url.port), timeout=60)
    connection.sendall(LONG * b"GET /api/v1/openapi.json HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    return connection


def read_all(connection, pause_s):
    """How many answers begin in all that comes, read piece by piece until no more does."""
    count, rest = 0, b""
    try:
        while count < LONG and (piece := connection.recv(1 << 16)):
            rest += piece
            count += rest.count(b"HTTP/1.1 200")
            rest = rest[-11:]
            time.sleep(pause_s)
    except ConnectionResetError:
        pass
    return count


def test_an_answer_is_given_up_when_nothing_of_it_is_read_but_not_where_it_is_read_slowly(
    address, monkeypatch
):
    monkeypatch.setattr("service.web.slow_clients.UNREAD_S", 1.5)
    with asking_much(address) as slow, asking_much(address) as deaf:
        begun = time.monotonic()
        assert read_all(slow, pause_s=0.03) == LONG
        assert time.monotonic() - begun > 2.0
        assert 0 < read_all(deaf, pause_s=0.0) < LONG


GIVE_UP_S = 30.0


def closed_after_s(connection, every_s=0.1, byte=b"x"):
    """How long the server keeps a connection over which a byte comes now and then."""
    begun = time.monotonic()
    connection.settimeout(every_s)
    while time.monotonic() - begun < GIVE_UP_S:
        try:
            connection.sendall(byte)
            if not connection.recv(1 << 16):
                break
        except TimeoutError:
            continue
        except OSError:
            break
    return time.monotonic() - begun


@pytest.mark.parametrize(
    "sent",
    [
        "",
        "GET /livez HTTP/1.1\r\nX-Long: ",
        "GET /livez HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /li",
        # Refused by its length, and the rest comes byte by byte.
        HEAD.replace("100000", "99999999"),
    ],
    ids=["nothing", "a head", "a second head", "a body that was refused"],
)
@pytest.mark.slow("nothing", "a second head", "a body")
def test_a_client_that_trickles_where_a_head_should_come_is_let_go(address, monkeypatch, sent):
    monkeypatch.setattr("service.web.slow_clients.HEAD_S", 0.8)
    url = httpx.URL(address)
    with socket.create_connection((url.host, url.port)) as connection:
        connection.sendall(sent.encode())
        if not sent:
            connection.settimeout(GIVE_UP_S)
            assert connection.recv(1) == b""
        else:
            assert closed_after_s(connection) < GIVE_UP_S


@pytest.mark.slow
def test_the_rest_of_a_refused_body_is_taken_off_slowly_and_to_its_end(address, monkeypatch):
    """Longer than a client may dawdle: it is not the client who does."""
    monkeypatch.setattr("service.web.slow_clients.HEAD_S", 2.0)
    monkeypatch.setattr("service.web.slow_clients.DISCARDED_PER_S", 10e6)
    url = httpx.URL(address)
    with socket.create_connection((url.host, url.port), timeout=30) as connection:
        connection.sendall(HEAD.replace("100000", "40000000")[:-1].encode())
        begun = time.monotonic()
        for _ in range(40):
            connection.sendall(bytes(1_000_000))
        # What the system holds of it is sent, but not yet taken off.
        assert time.monotonic() - begun > 2.0
        refusal = HTTPResponse(connection)
        refusal.begin()
        assert refusal.status == 413
        assert refusal.read()
        connection.sendall(b"GET /livez HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 200")


def test_a_client_that_asks_now_and_then_is_kept(address, monkeypatch):
    monkeypatch.setattr("service.web.slow_clients.HEAD_S", 0.8)
    url = httpx.URL(address)
    with closing(HTTPConnection(url.host, url.port, timeout=10)) as connection:
        connection.connect()
        # A connection that the server has closed is an error, never replaced by another one.
        connection.auto_open = 0
        for _ in range(8):
            connection.request("GET", "/livez")
            answer = connection.getresponse()
            assert (answer.status, answer.read()) == (200, b"alive\n")
            time.sleep(0.3)


def test_a_request_may_take_longer_than_the_next_head(address, monkeypatch):
    """Here a body that comes slowly: it has deadlines of its own."""
    monkeypatch.setattr("service.web.slow_clients.HEAD_S", 0.5)
    url = httpx.URL(address)
    with socket.create_connection((url.host, url.port), timeout=30) as connection:
        connection.sendall(
            b"POST /api/v1/batches HTTP/1.1\r\nHost: 127.0.0.1\r\n"
            b"Content-Type: application/json\r\nContent-Length: 10\r\n\r\n"
        )
        for _ in range(10):
            time.sleep(0.2)
            connection.sendall(b" ")
        assert connection.recv(1 << 16).startswith(b"HTTP/1.1 400")
