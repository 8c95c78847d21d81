"""Clients that are slow, or send far too much, cost others nothing and the server no memory."""

import resource
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import httpx
import pytest

from tests.scale import size

SLOW = 1_000
HUGE_BYTES = 300_000_000
MORE_MEMORY_MB = 50
HEAD = (
    "POST /api/v1/batches HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    "Content-Length: 100000\r\n\r\n{"
)


@pytest.fixture
def server(tmp_path):
    """A server in a process of its own, so that its memory is its own; ready for work."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    process = subprocess.Popen([*command, "--database", f"sqlite:///{tmp_path / 'acquire.db'}"])
    url = f"http://127.0.0.1:{port}"
    try:
        while True:
            assert process.poll() is None
            try:
                if httpx.get(f"{url}/readyz").status_code == 200:
                    break
            except httpx.TransportError:
                pass
            time.sleep(0.1)
        yield process, port, url
    finally:
        process.terminate()
        process.wait()


def resident_mb(process):
    pages = int(Path(f"/proc/{process.pid}/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def connected(port):
    return socket.create_connection(("127.0.0.1", port), timeout=30)


def answers(client, batch, names, count):
    """Healthy requests while others are slow: each must be answered as ever."""
    for _ in range(count):
        answer = client.post("/api/v1/batches", json=batch | {"batch": next(names)})
        assert answer.status_code == 201, answer.text


@pytest.mark.torture
def test_a_thousand_slow_connections_harm_nobody(server, batch):
    """Some stop in the middle of the head, some trickle a body, some do not read their answer."""
    process, port, url = server
    names = iter(f"healthy-{number}" for number in range(10_000))
    with httpx.Client(base_url=url, timeout=30) as client:
        answers(client, batch, names, 50)
        before = resident_mb(process)
        slow = [connected(port) for _ in range(size(SLOW))]
        try:
            for number, connection in enumerate(slow):
                connection.sendall((HEAD[:40] if number % 3 == 0 else HEAD).encode())
            for _ in range(5):
                for number, connection in enumerate(slow):
                    if number % 3 == 1:
                        connection.sendall(b" ")
                answers(client, batch, names, 20)
            assert resident_mb(process) - before < MORE_MEMORY_MB
        finally:
            for connection in slow:
                connection.close()
        answers(client, batch, names, 20)


@pytest.mark.torture
@pytest.mark.parametrize("declared", [True, False], ids=["declared", "chunked"])
def test_bodies_of_300_megabytes_are_refused_without_being_held(server, batch, declared):
    process, port, url = server
    piece = b" " * 65536
    before = resident_mb(process)

    def send():
        with connected(port) as connection:
            length = f"Content-Length: {HUGE_BYTES}" if declared else "Transfer-Encoding: chunked"
            head = f"POST /api/v1/batches HTTP/1.1\r\nHost: 127.0.0.1\r\n{length}\r\n"
            connection.sendall(head.encode() + b"Content-Type: application/json\r\n\r\n")
            try:
                for _ in range(HUGE_BYTES // len(piece)):
                    connection.sendall(piece if declared else b"10000\r\n" + piece + b"\r\n")
            except OSError:
                # Cut off, after its answer, which may be lost with the connection.
                return
            told.append(connection.recv(1000))

    told = []
    senders = [threading.Thread(target=send) for _ in range(4)]
    for sender in senders:
        sender.start()
    names = iter(f"healthy-{number}" for number in range(10_000))
    with httpx.Client(base_url=url, timeout=30) as client:
        while any(sender.is_alive() for sender in senders):
            answers(client, batch, names, 1)
            assert resident_mb(process) - before < MORE_MEMORY_MB
    assert all(b" 413 " in each.split(b"\r\n", 1)[0] for each in told)
    assert httpx.get(f"{url}/livez").status_code == 200
