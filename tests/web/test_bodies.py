"""Bodies that are too large or too slow: refused in time, whatever their client does next."""

import json
import socket
import time

import httpx
import pytest

from service.operations import Operations
from service.settings import Settings
from service.web.app import create_app
from service.web.bodies import MAX_JSON_BYTES, Limits
from tests.web.serving import Server

URL = "/api/v1/batches"
HEADERS = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def impatient(tmp_path_factory):
    """A server that waits half a second for a body, and reads a kilobyte of a replay."""
    path = tmp_path_factory.mktemp("impatient") / "acquire.db"
    operations = Operations.open(Settings(database=f"sqlite:///{path}"))
    limits = Limits(replay_bytes=1024, pause_s=0.5, json_s=1.0)
    with Server(create_app(operations, limits)) as address:
        yield address


def raw(address, *pieces, pause_s=0.0):
    """What the server answers to bytes sent as they are, piece by piece."""
    host, port = httpx.URL(address).host, httpx.URL(address).port
    with socket.create_connection((host, port), timeout=10) as connection:
        try:
            for piece in pieces:
                connection.sendall(piece)
                time.sleep(pause_s)
            return connection.recv(65536)
        except (BrokenPipeError, ConnectionResetError):
            return connection.recv(65536)


def head(length):
    lines = [
        f"POST {URL} HTTP/1.1",
        "Host: localhost",
        "Content-Type: application/json",
        f"Content-Length: {length}",
    ]
    return "\r\n".join([*lines, "", ""]).encode()


def test_a_body_that_says_it_is_too_large_is_refused_before_it_comes(impatient):
    assert raw(impatient, head(10**15)).startswith(b"HTTP/1.1 413")
    assert raw(impatient, head(10**25)).startswith((b"HTTP/1.1 413", b"HTTP/1.1 400"))


def test_a_body_of_unknown_length_is_refused_where_it_passes_the_bound(client):
    def pieces():
        for _ in range(64):
            yield b" " * (MAX_JSON_BYTES // 16)

    answer = client.post(URL, content=pieces(), headers=HEADERS)
    assert answer.status_code == 413
    assert str(MAX_JSON_BYTES) in answer.json()["detail"]
    assert client.get("/livez").status_code == 200


def test_a_body_that_stops_coming_is_given_up(impatient):
    answer = raw(impatient, head(100), b'{"spacecraft"')
    assert answer.startswith(b"HTTP/1.1 408")
    assert b"problem+json" in answer
    assert b"connection: close" in answer.lower()


def test_a_body_that_trickles_is_given_up(impatient):
    started = time.monotonic()
    answer = raw(impatient, head(10_000), *[b" "] * 40, pause_s=0.1)
    assert answer.startswith(b"HTTP/1.1 408")
    assert time.monotonic() - started < 9


def test_a_client_that_leaves_in_the_middle_harms_no_one(impatient):
    host, port = httpx.URL(impatient).host, httpx.URL(impatient).port
    with socket.create_connection((host, port)) as connection:
        connection.sendall(head(100) + b"{")
    assert httpx.get(f"{impatient}/livez").status_code == 200


def test_a_replay_that_is_too_large_is_refused(impatient, batch):
    content = json.dumps(batch).encode() * 10
    answer = httpx.post(
        f"{impatient}/api/v1/replays?run=big",
        content=content,
        headers={"Content-Type": "application/x-ndjson"},
    )
    assert answer.status_code == 413


def test_what_is_no_http_is_refused(impatient):
    assert raw(impatient, b"hello\r\n\r\n").startswith(b"HTTP/1.1 400")
