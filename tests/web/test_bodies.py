"""Bodies that are too large or too slow: refused in time, whatever their client does next."""

import json
import socket
import time

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from service.web.requests.request_body import MAX_JSON_BYTES, BodyLimits
from tests.waiting import wait_until
from tests.web.serving import Server, in_process_settings

URL = "/api/v1/batches"
HEADERS = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def impatient(tmp_path_factory):
    """A server that waits half a second for a body, and reads a kilobyte of a replay."""
    path = tmp_path_factory.mktemp("impatient") / "acquire.db"
    app = open_app(in_process_settings(f"sqlite:///{path}"))
    limits = BodyLimits(replay_bytes=1024, pause_s=0.5, json_s=1.0)
    with Server(create_app(app, limits)) as address:
        yield address


@pytest.fixture(scope="module")
def narrow(tmp_path_factory):
    """A server that has a hundred kilobytes for all bodies together."""
    path = tmp_path_factory.mktemp("narrow") / "acquire.db"
    app = open_app(in_process_settings(f"sqlite:///{path}"))
    with Server(create_app(app, BodyLimits(budget_bytes=100_000))) as address:
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
    answer = raw(impatient, head(10_000), *[b" "] * 40, pause_s=0.1)
    assert answer.startswith(b"HTTP/1.1 408")


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


@pytest.mark.parametrize("chunked", [False, True])
def test_a_session_is_not_begun_with_more_than_4_kib(client, chunked):
    def post(length):
        body = json.dumps({"token": "x"}).encode().ljust(length)
        content = iter([body]) if chunked else body
        return client.post("/api/v1/session", content=content, headers=HEADERS)

    assert post(4096).status_code == 401
    answer = post(4097)
    assert answer.status_code == 413
    assert "4096 bytes" in answer.json()["detail"]


def test_bodies_that_are_too_many_together_are_put_off_and_small_ones_are_not(narrow, batch):
    host, port = httpx.URL(narrow).host, httpx.URL(narrow).port

    def post(length, name):
        content = json.dumps(batch | {"batch": name}).encode().ljust(length)
        return httpx.post(f"{narrow}{URL}", content=content, headers=HEADERS, timeout=60)

    with socket.create_connection((host, port), timeout=10) as connection:
        connection.sendall(head(95_000) + 90_000 * b" ")
        answer = wait_until(lambda: (a := post(60_000, "large")).status_code == 503 and a)
        assert answer.json()["type"] == "/problems/busy"
        assert answer.headers["Retry-After"] == "1"
        assert post(0, "small").status_code == 201

    # The client has gone, and its body with it.
    def is_taken():
        status = post(60_000, "after").status_code
        assert status in (201, 503)
        return status == 201

    wait_until(is_taken)


def test_bodies_one_after_another_take_no_more_room_than_one(narrow, batch):
    with httpx.Client(base_url=narrow, timeout=60) as client:
        for number in range(10):
            content = json.dumps(batch | {"batch": f"one-by-one-{number}"}).encode().ljust(90_000)
            assert client.post(URL, content=content, headers=HEADERS).status_code == 201
            assert client.post(URL, content=b"{" * 90_000, headers=HEADERS).status_code == 400


def test_what_is_no_http_is_refused(impatient):
    assert raw(impatient, b"hello\r\n\r\n").startswith(b"HTTP/1.1 400")
