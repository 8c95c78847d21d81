"""What a hostile client sends, from a process of its own, until it is told to stop.

    python -m tests.web.attack PORT KIND CONNECTIONS

Stops at the end of its standard input.  Prints one JSON line: how many connections it
opened, how many bytes it sent, and how often each first line of an answer came.  Its
priority is the lowest: what it costs to send is not to be mistaken for what it costs to
be sent to.
"""

import itertools
import json
import os
import socket
import sys
import threading
import time
from collections import Counter

LONG = b"x" * 65536
CHUNKED = (
    b"POST /api/v1/session HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b"Transfer-Encoding: chunked\r\n\r\n"
)
BODY_BYTES = 2 << 20
SESSION, BATCH = (
    (
        f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        f"Content-Length: {BODY_BYTES}\r\n\r\n"
    ).encode()
    for path in ("/api/v1/session", "/api/v1/batches")
)
REOPEN_S = 0.5
LISTEN_S = 30.0
"""How long it goes on until it has heard what some connection must be told."""

ENDLESS = {
    # What begins a request, and what then comes again and again.
    "header value": (b"GET /livez HTTP/1.1\r\nHost: localhost\r\nX-Long: ", LONG),
    "url": (b"GET /", LONG),
    "trailer": (CHUNKED + b"2\r\n{}\r\n0\r\nX-Long: ", LONG),
    "many headers": (b"GET /livez HTTP/1.1\r\n", b"a: b\r\n" * 10_000),
    "chunk extension": (CHUNKED + b"2;", LONG),
    "small chunks": (CHUNKED, b"1\r\n \r\n" * 10_000),
    "blank lines": (b"", b"\r\n" * 30_000),
    "pipelined requests": (b"", b"GET /livez HTTP/1.1\r\nHost: localhost\r\n\r\n" * 1_000),
}

stopping = threading.Event()
counted, told = Counter(), Counter()


def connected(port):
    counted["connections"] += 1
    connection = socket.create_connection(("127.0.0.1", port), timeout=20)
    return connection


def hear(connection):
    """Count the first line of an answer, which may have come before the connection broke."""
    try:
        told[connection.recv(1000).decode("latin-1").split("\r\n")[0] or "closed"] += 1
    except OSError as error:
        told[type(error).__name__] += 1


def is_over():
    """Whether to stop: not before an answer came, which on a busy machine takes a while."""
    return stopping.is_set() and told


def send_endlessly(port, begin, again):
    """One request without an end after another."""
    while not is_over():
        with connected(port) as connection:
            try:
                connection.sendall(begin)
                while not is_over():
                    connection.sendall(again)
                    counted["bytes"] += len(again)
            except OSError:
                pass
            hear(connection)


def send_bodies(port, head):
    """One large body after another over a connection, each to its end."""
    while not stopping.is_set():
        try:
            with connected(port) as connection:
                while not stopping.is_set():
                    connection.sendall(head)
                    for _ in range(BODY_BYTES // len(LONG)):
                        connection.sendall(LONG)
                        counted["bytes"] += len(LONG)
                    hear(connection)
        except OSError as error:
            told[type(error).__name__] += 1


def hold_bodies(port, head):
    """A large body that stops before its end, again and again."""
    while not stopping.is_set():
        try:
            with connected(port) as connection:
                connection.sendall(head)
                for _ in range(BODY_BYTES // len(LONG) - 1):
                    connection.sendall(LONG)
                    counted["bytes"] += len(LONG)
                while not stopping.wait(1.0):
                    connection.sendall(b" ")
        except OSError as error:
            told[type(error).__name__] += 1


def stay_idle(port, connections):
    """Connections of one byte each; those that are closed are opened again."""
    open_ones = []
    while not stopping.is_set():
        still = []
        for connection in open_ones:
            try:
                told[connection.recv(1000).decode("latin-1").split("\r\n")[0] or "closed"] += 1
                connection.close()
            except BlockingIOError:
                still.append(connection)
            except OSError:
                connection.close()
        open_ones = still
        while len(open_ones) < connections and not stopping.is_set():
            try:
                connection = connected(port)
                connection.sendall(b"G")
            except OSError as error:
                told[type(error).__name__] += 1
                break
            connection.setblocking(False)
            open_ones.append(connection)
        counted["most open"] = max(counted["most open"], len(open_ones))
        time.sleep(REOPEN_S)


def attackers(port, kind, connections):
    if kind == "idle":
        return [(stay_idle, port, connections)]
    if kind == "bodies":
        return connections * [(send_bodies, port, SESSION)]
    if kind == "held bodies":
        return connections * [(hold_bodies, port, BATCH)]
    return connections * [(send_endlessly, port, *ENDLESS[kind])]


def main(port, kind, connections, expected):
    """Attack until the end of the standard input, and until something was heard if it must be."""
    os.nice(19)
    threads = [
        threading.Thread(target=each[0], args=each[1:], daemon=True)
        for each in attackers(int(port), kind, int(connections))
    ]
    for thread in threads:
        thread.start()
    sys.stdin.read()
    until_s = time.monotonic() + LISTEN_S
    while expected not in ("", *told) and time.monotonic() < until_s:
        time.sleep(0.1)
    stopping.set()
    print(json.dumps({**counted, "told": dict(itertools.islice(told.items(), 20))}), flush=True)
    # Senders may be blocked; they end with the process.
    os._exit(0)


if __name__ == "__main__":
    main(*sys.argv[1:])
