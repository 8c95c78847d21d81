"""The head of a request and the trailers after its body: bounded in bytes and in number."""

import json
import socket
import time
from contextlib import ExitStack

import httpx
import pytest

KIB = 1 << 10
REFUSED = b"HTTP/1.1 431 "
GET = b"GET /livez HTTP/1.1\r\nHost: localhost\r\n"
CHUNKED = (
    b"POST /api/v1/session HTTP/1.1\r\nHost: localhost\r\n"
    b"Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n\r\n"
)
FIELDS = b"".join(b"X-%d: %d\r\n" % (number, number) for number in range(200))
PATIENCE_S = 20
PIECES = (7, 1000, 50_000, None)


@pytest.fixture
def connect(address):
    """Opens connections, which are closed at the end."""
    url = httpx.URL(address)
    with ExitStack() as opened:

        def connect():
            connection = socket.create_connection((url.host, url.port), timeout=PATIENCE_S)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            return opened.enter_context(connection)

        yield connect


@pytest.fixture
def connection(connect):
    return connect()


def send(connection, sent, piece=None):
    """Send it whole or in pieces, as far as the other end takes it."""
    try:
        for begin in range(0, len(sent), piece or len(sent)):
            connection.sendall(sent[begin : begin + (piece or len(sent))])
    except ConnectionError:
        pass


def received(connection, until=b"\r\n\r\n"):
    """All that comes up to some bytes, or the end."""
    read = b""
    try:
        while until not in read and (piece := connection.recv(1 << 16)):
            read += piece
    except ConnectionError:
        pass
    return read


def is_closed(connection):
    """Whether the other end closes the connection."""
    try:
        while connection.recv(1 << 16):
            pass
    except ConnectionError:
        pass
    return True


@pytest.mark.parametrize(
    "sent",
    [
        GET + b"X-Long: " + 100 * KIB * b"x",
        GET + b"X-Long: " + 66 * KIB * b"x" + b"\r\n\r\n",
        GET + 100 * KIB * b"x",
        b"GET /" + 100 * KIB * b"x",
        b"GET /" + 66 * KIB * b"x" + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        GET + FIELDS,
        GET + FIELDS + b"\r\n",
        CHUNKED + b"2\r\n{}\r\n0\r\nX-Long: " + 100 * KIB * b"x",
        CHUNKED + b"2\r\n{}\r\n0\r\n" + FIELDS,
        CHUNKED + b"2;" + 100 * KIB * b"x",
        100 * KIB * b"\r\n",
    ],
    ids=[
        "an endless value",
        "a long value",
        "an endless name",
        "an endless URL",
        "a long URL",
        "endless fields",
        "many fields",
        "an endless trailer",
        "many trailers",
        "an endless extension of a chunk",
        "endless blank lines",
    ],
)
def test_what_is_too_long_or_too_many_is_refused_and_the_connection_closed(connect, sent):
    """Sent in pieces of a few bytes, in larger ones, and whole."""
    connections = [connect() for _ in PIECES]
    for connection, piece in zip(connections, PIECES, strict=True):
        send(connection, sent, piece)
        answer = received(connection, b"}")
        assert answer.startswith(REFUSED), piece
        head, _, body = answer.partition(b"\r\n\r\n")
        assert b"application/problem+json" in head
        assert json.loads(body)["status"] == 431
    # They linger for the same second.
    assert all(is_closed(connection) for connection in connections)


SMALL = b"Content-Type: application/json\r\n"
POST = b"POST /api/v1/session HTTP/%s\r\n" + SMALL
ILL_FORMED = {
    "no Host": (400, b"GET /livez HTTP/1.1\r\n\r\n"),
    "two Hosts": (400, GET + b"Host: localhost\r\n\r\n"),
    "two Hosts in HTTP/1.0": (400, GET.replace(b"/1.1", b"/1.0") + b"Host: a\r\n\r\n"),
    "a Host with a user": (400, b"GET /livez HTTP/1.1\r\nHost: a@localhost\r\n\r\n"),
    "a Host with a space": (400, b"GET /livez HTTP/1.1\r\nHost: a localhost\r\n\r\n"),
    "a Host with a path": (400, b"GET /livez HTTP/1.1\r\nHost: localhost/x\r\n\r\n"),
    "an unknown coding": (501, POST % b"1.1" + b"Host: a\r\nTransfer-Encoding: deflate\r\n\r\n"),
    "an unknown coding before chunked": (
        501,
        POST % b"1.1" + b"Host: a\r\nTransfer-Encoding: gzip, chunked\r\n\r\n2\r\n{}\r\n0\r\n\r\n",
    ),
    "an unknown coding after chunked": (
        400,
        POST % b"1.1" + b"Host: a\r\nTransfer-Encoding: chunked, x\r\n\r\n2\r\n{}\r\n0\r\n\r\n",
    ),
    "chunked in HTTP/1.0": (
        400,
        POST % b"1.0" + b"Host: a\r\nTransfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n\r\n",
    ),
    "chunked twice": (
        400,
        POST % b"1.1" + b"Host: a\r\nTransfer-Encoding: chunked, chunked\r\n\r\n0\r\n\r\n",
    ),
    "a length and chunked": (
        400,
        POST % b"1.1"
        + b"Host: a\r\nContent-Length: 2\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\n",
    ),
    "a target of another host": (
        400,
        b"GET http://other.example/livez HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ),
    "a target with a user": (
        400,
        b"GET http://a@localhost/livez HTTP/1.1\r\nHost: localhost\r\n\r\n",
    ),
}
"""Heads that RFC 9112 has a server refuse, with the status."""


@pytest.mark.parametrize(("status", "sent"), ILL_FORMED.values(), ids=ILL_FORMED)
def test_a_head_that_the_rfc_forbids_is_refused_and_the_connection_closed(connection, status, sent):
    # What follows in the same connection is no second request.
    send(connection, sent + GET + b"\r\n")
    answer = received(connection, b"}" if status == 501 else b"\r\n\r\n")
    assert answer.startswith(b"HTTP/1.1 %d " % status)
    assert answer.count(b"HTTP/1.1 ") == 1
    assert is_closed(connection)


@pytest.mark.parametrize(
    "sent",
    [
        GET.replace(b"GET /", b"GET http://localhost/") + b"\r\n",
        GET.replace(b"GET /", b"GET HTTP://LOCALHOST/") + b"\r\n",
        b"GET /livez HTTP/1.1\r\nHost: 127.0.0.1:80\r\n\r\n",
        b"GET /livez HTTP/1.1\r\nHost: [::1]:8000\r\n\r\n",
        b"GET /livez HTTP/1.0\r\n\r\n",
    ],
)
def test_a_head_that_the_rfc_allows_is_answered(connection, sent):
    send(connection, sent)
    assert received(connection).startswith((b"HTTP/1.1 200 ", b"HTTP/1.0 200 "))


@pytest.mark.parametrize("sent", [GET + b"X-Long: " + 90 * KIB * b"x", GET + FIELDS])
def test_a_head_that_comes_byte_by_byte_is_refused(connection, sent):
    send(connection, sent, 1)
    assert received(connection).startswith(REFUSED)


@pytest.mark.parametrize("piece", [1000, None])
@pytest.mark.parametrize(
    "head",
    [
        GET + b"X-Long: " + 60 * KIB * b"x" + b"\r\n\r\n",
        GET + FIELDS[: FIELDS.index(b"X-99:")] + b"\r\n",
    ],
    ids=["60 KiB", "a hundred fields"],
)
def test_a_large_head_within_the_bounds_is_answered_again_and_again(connection, head, piece):
    """Over one connection: what one head takes is not counted for the next."""
    for _ in range(4):
        send(connection, head, piece)
        assert received(connection, b"alive\n").startswith(b"HTTP/1.1 200 ")


def test_heads_sent_together_are_each_counted_on_its_own(connection):
    head = GET + b"X-Long: " + 30 * KIB * b"x" + b"\r\n" + FIELDS[:500] + b"\r\n"
    send(connection, 8 * head)
    read = b""
    while read.count(b"alive\n") < 8:
        piece = connection.recv(1 << 16)
        assert piece, read
        read += piece
    assert read.count(b"HTTP/1.1 200 ") == 8


def test_a_request_before_one_that_is_refused_is_answered(connection):
    send(connection, GET + b"\r\n" + GET + FIELDS + b"\r\n")
    assert received(connection, b"alive\n").startswith(b"HTTP/1.1 200 ")
    assert is_closed(connection)


def test_a_body_in_chunks_with_a_few_trailers_is_read(address, connection, batch):
    body = json.dumps(batch).encode()
    chunks = b"".join(b"%x\r\n%b\r\n" % (len(each), each) for each in (body[:100], body[100:]))
    head = CHUNKED.replace(b"/api/v1/session", b"/api/v1/batches")
    trailers = b"0\r\nX-Checksum: 12\r\nIdempotency-Key: not a header\r\n\r\n"
    send(connection, head + chunks + trailers)
    assert received(connection).startswith(b"HTTP/1.1 201 ")


def test_chunks_of_one_byte_are_read(connection, batch):
    body = json.dumps(batch).encode()
    head = CHUNKED.replace(b"/api/v1/session", b"/api/v1/batches")
    send(connection, head + b"".join(b"1\r\n%c\r\n" % each for each in body) + b"0\r\n\r\n")
    assert received(connection).startswith(b"HTTP/1.1 201 ")


@pytest.mark.parametrize("protocol", ["websocket", "h2c"])
def test_a_request_to_speak_another_protocol_is_answered_as_one_without(
    connection, protocol, capfd
):
    upgrade = b"Connection: Upgrade\r\nUpgrade: %b\r\n\r\n" % protocol.encode()
    for _ in range(3):
        send(connection, GET + upgrade)
        assert received(connection, b"alive\n").startswith(b"HTTP/1.1 200 ")
    assert "upgrade" not in capfd.readouterr().err.lower()


def test_a_client_that_waits_to_be_told_to_go_on_is_told(connection, batch):
    body = json.dumps(batch).encode()
    head = (
        f"POST /api/v1/batches HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        f"Content-Length: {len(body)}\r\nExpect: 100-continue\r\n\r\n"
    )
    send(connection, head.encode())
    assert received(connection) == b"HTTP/1.1 100 Continue\r\n\r\n"
    send(connection, body)
    assert received(connection).startswith(b"HTTP/1.1 201 ")


def test_a_body_that_comes_slowly_is_read_whole(connection, batch):
    """In small pieces with pauses, as over a poor line: more than is read at a time."""
    body = json.dumps(batch).encode() + 40 * KIB * b" "
    head = (
        f"POST /api/v1/batches HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        f"Content-Length: {len(body)}\r\n\r\n"
    )
    send(connection, head.encode())
    for begin in range(0, len(body), 2 * KIB):
        send(connection, body[begin : begin + 2 * KIB])
        time.sleep(0.005)
    assert received(connection).startswith(b"HTTP/1.1 201 ")
