"""HTTP client that posts over a few connections as fast as possible, and measures the times.

Requests are bytes made in advance; of an answer the client reads only status and length.  It costs
a tenth of the measured work.
"""

import asyncio
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np
import numpy.typing as npt
import uvloop

HEAD = "\r\n".join(
    (
        "POST {path} HTTP/1.1",
        "Host: 127.0.0.1",
        "Content-Type: {kind}",
        "Content-Length: {length}",
        "\r\n",
    )
)
_LENGTH = b"content-length: "


@dataclass
class Driven:
    """Result of several posts: total seconds, milliseconds of each, number of answers by status."""

    seconds: float = 0.0
    waits_ms: list[float] = field(default_factory=list)
    statuses: Counter[int] = field(default_factory=Counter)
    last: bytes = b""

    @property
    def per_second(self) -> float:
        return len(self.waits_ms) / self.seconds

    def percentile_ms(self, percent: float) -> float:
        waits: npt.NDArray[np.float64] = np.array(self.waits_ms)
        return float(np.percentile(waits, percent))


def request(path: str, body: bytes, kind: str = "application/json") -> bytes:
    """HTTP bytes of a post."""
    return HEAD.format(path=path, kind=kind, length=len(body)).encode() + body


def get(path: str) -> bytes:
    """HTTP bytes of a GET request."""
    return f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode()


def drive(
    port: int,
    requests: Iterable[bytes],
    connections: int,
    gap_s: float = 0.0,
    per_second: float = math.inf,
) -> Driven:
    """Send every request once; a connection waits for the answer, and `gap_s`, before its next.

    All connections together send at most `per_second` requests per second.
    """
    return uvloop.run(_drive(port, iter(requests), connections, gap_s, per_second))


async def _drive(
    port: int, requests: Iterator[bytes], connections: int, gap_s: float, per_second: float
) -> Driven:
    driven = Driven()
    loop = asyncio.get_running_loop()
    paced = _paced(requests, per_second)
    clients = [_Client(paced, driven, gap_s) for _ in range(connections)]
    for client in clients:
        await loop.create_connection(partial(_same, client), "127.0.0.1", port)
    await asyncio.gather(*(client.ready for client in clients))
    started = perf_counter()
    for client in clients:
        client.send()
    await asyncio.gather(*(client.over for client in clients))
    driven.seconds = perf_counter() - started
    return driven


def _paced(requests: Iterator[bytes], per_second: float) -> Iterator[tuple[float, bytes]]:
    """Requests, each with its earliest time of sending."""
    started = perf_counter()
    for number, each in enumerate(requests):
        yield started + number / per_second, each


def _same(client: "_Client") -> "_Client":
    return client


class _Client(asyncio.Protocol):
    """Client side of one connection."""

    def __init__(
        self, requests: Iterator[tuple[float, bytes]], driven: Driven, gap_s: float
    ) -> None:
        loop = asyncio.get_running_loop()
        self.ready: asyncio.Future[None] = loop.create_future()
        self.over: asyncio.Future[None] = loop.create_future()
        self._requests, self._driven, self._gap_s = requests, driven, gap_s
        self._read = b""
        self._sent = 0.0

    def connection_made(self, transport: Any) -> None:
        self._transport = transport
        self.ready.set_result(None)

    def send(self) -> None:
        following = next(self._requests, None)
        if following is None:
            self._transport.close()
            if not self.over.done():
                self.over.set_result(None)
            return
        turn, request = following
        if (ahead_s := turn - perf_counter()) > 0.0:
            asyncio.get_running_loop().call_later(ahead_s, self._send, request)
        else:
            self._send(request)

    def _send(self, request: bytes) -> None:
        self._sent = perf_counter()
        self._transport.write(request)

    def data_received(self, data: bytes) -> None:
        self._read += data
        head, end, body = self._read.partition(b"\r\n\r\n")
        if not end:
            return
        at = head.lower().find(_LENGTH) + len(_LENGTH)
        if len(body) < int(head[at:].partition(b"\r\n")[0]):
            return
        self._driven.waits_ms.append((perf_counter() - self._sent) * 1000.0)
        self._driven.statuses[int(head[9:12])] += 1
        self._driven.last = body
        self._read = b""
        if self._gap_s:
            asyncio.get_running_loop().call_later(self._gap_s, self.send)
        else:
            self.send()

    def connection_lost(self, error: Exception | None) -> None:
        if not self.over.done():
            self.over.set_exception(ConnectionError("the server closed a connection"))
