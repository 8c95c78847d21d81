"""One client's connection: HTTP/1.1 with a bound on everything that a client may send or hold.

uvicorn's protocol on top of httptools does the work.  It has no bound for the head of a
request, none for what a connection may keep in memory, and a single deadline, for the
seconds between two requests.

The connections that are kept are limited too: a bound for all, a share for each client address.
A connection is idle while no request of it is being answered.  Where a bound is
reached, the connection that has been idle for the longest time is closed, so that
a client that holds many open connections cannot keep others out.
"""

import asyncio
import ipaddress
import json
import logging
import time
from collections import OrderedDict
from collections.abc import Iterable
from functools import lru_cache
from http import HTTPStatus
from typing import Any, Protocol, cast

import uvicorn
from uvicorn.protocols.http.flow_control import FlowControl
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle
from uvicorn.server import ServerState

from service.settings import Network, is_loopback
from service.web.request_head import refusal_of

RESERVED_FOR_LOOPBACK = 16
"""Number of connections reserved for clients on this machine, such as probes."""
IPV6_SITE_BITS = 64
"""Prefix length (bits) of an IPv6 network counted as one client, which usually owns all of it."""


class Closable(Protocol):
    """Interface of a connection that can be closed at once."""

    def abort(self) -> None:
        """Close the connection, whatever is still to be sent."""


class Client:
    """Counts of the connections of one client address, and those that are idle."""

    def __init__(self, origin: str, local: bool, shared: bool) -> None:
        self.origin = origin
        self.is_local = local
        self.has_share = shared
        self.count = 0
        self.idle: OrderedDict[Closable, None] = OrderedDict()


class Admission:
    """Counts connections, and closes idle ones at a limit."""

    def __init__(
        self,
        most: int,
        per_address: int | None = None,
        trusted: Iterable[Network] = (),
        reserved: int = RESERVED_FOR_LOOPBACK,
    ) -> None:
        """Allow at most `most` connections, and `per_address` of a client that is not `trusted`.

        The last `reserved` connections are for loopback addresses.
        """
        self._most = most
        self._per_address = most if per_address is None else per_address
        self._trusted = tuple(trusted)
        self._reserved = min(reserved, most // 2)
        self._clients: dict[str, Client] = {}
        self._admitted: dict[Closable, Client] = {}
        self._idle: OrderedDict[Closable, None] = OrderedDict()
        self._remote_count = 0
        self._remote_idle: OrderedDict[Closable, None] = OrderedDict()

    def admit(self, connection: Closable, host: str) -> bool:
        """Admit a new, idle connection from a client address.

        False if a limit is reached and no connection under that limit is idle.
        """
        client = self._client(host)
        if client.has_share and client.count >= self._per_address:
            is_free = self._close_oldest(client.idle)
        elif not client.is_local and self._remote_count >= self._most - self._reserved:
            is_free = self._close_oldest(self._remote_idle)
        elif len(self._admitted) >= self._most:
            is_free = self._close_oldest(self._idle)
        else:
            is_free = True
        if not is_free:
            return False
        self._clients[client.origin] = client
        client.count += 1
        self._remote_count += not client.is_local
        self._admitted[connection] = client
        self.set_idle(connection)
        return True

    def set_idle(self, connection: Closable) -> None:
        """Mark a connection as idle: no request of it is being answered."""
        for idle in self._idle_lists(self._admitted.get(connection)):
            idle[connection] = None

    def set_busy(self, connection: Closable) -> None:
        """Mark a connection as busy: a request of it is being answered."""
        for idle in self._idle_lists(self._admitted.get(connection)):
            idle.pop(connection, None)

    def remove(self, connection: Closable) -> None:
        """Remove a closed connection from the counts."""
        client = self._admitted.get(connection)
        if client is None:
            return
        self.set_busy(connection)
        del self._admitted[connection]
        client.count -= 1
        self._remote_count -= not client.is_local
        if not client.count:
            del self._clients[client.origin]

    def _idle_lists(self, client: Client | None) -> tuple[OrderedDict[Closable, None], ...]:
        if client is None:
            return ()
        if client.is_local:
            return client.idle, self._idle
        return client.idle, self._idle, self._remote_idle

    def _close_oldest(self, idle: OrderedDict[Closable, None]) -> bool:
        """Close the connection that was idle longest; False if none is idle."""
        if not idle:
            return False
        connection = next(iter(idle))
        # Removed first: the event loop reports the end of the connection only later.
        self.remove(connection)
        connection.abort()
        return True

    def _client(self, host: str) -> Client:
        origin = _origin(host)
        known = self._clients.get(origin)
        if known is not None:
            return known
        return Client(origin, is_loopback(origin), not self._is_trusted(host))

    def _is_trusted(self, host: str) -> bool:
        address = _address(host)
        return address is not None and any(address in network for network in self._trusted)


@lru_cache(maxsize=4096)
def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return None
    if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
        return address.ipv4_mapped
    return address


@lru_cache(maxsize=4096)
def _origin(host: str) -> str:
    """The key of one client: an IPv4 address, or a /64 network of IPv6."""
    address = _address(host)
    if address is None:
        return host
    if address.version == 4 or address.is_loopback or address.is_link_local:
        return str(address)
    return str(ipaddress.IPv6Network((int(address), IPV6_SITE_BITS), strict=False))


MAX_PIPELINED = 128
"""Greatest number of requests that wait on one connection."""
PIPELINED_PAUSE_S = 0.01
"""Delay in seconds before a waiting request begins, so that other connections get time."""
READ_BYTES = 16 << 10
"""Greatest number of bytes read at a time from a connection."""

FIRST_BYTE_S = 5
"""Seconds within which a client must send its first byte."""
HEAD_S = 30
"""Seconds from the end of a request to the end of the next head."""
UNREAD_S = 60
"""Seconds without reading after which a client's connection is closed."""
LINGER_S = 1
"""Seconds in which the answer to a refused head can still be read."""

DISCARDED_PER_S = 50e6
"""Largest rate, in bytes per second, of reading bodies that are answered already, together.

They are read to their end, because many clients look for an answer only then; read as fast
as clients can send them, they would keep the processor from all other requests.
"""
DISCARDING_SHARE = 0.1
"""Largest share of the event loop's time for reading bodies that are answered already.

Small chunks take more time than their bytes tell.
"""
LEAST_PAUSE_S = 0.005

_LOG = logging.getLogger("uvicorn.error.connections")
# A warning for each request that is none, or asks for WebSockets, would fill the log.
_LOG.setLevel(logging.ERROR)


class SharedState(ServerState):
    """State that the connections of a server share."""

    def __init__(self, admission: Admission) -> None:
        super().__init__()
        self.admission = admission
        self.buffer = memoryview(bytearray(READ_BYTES))
        self.discarding_until_s = 0.0


class Connection(asyncio.BufferedProtocol):
    """Protocol that reads a connection in small pieces.

    uvloop would otherwise read up to 256 KiB at a time; with hundreds of connections that is
    too much memory, and parsing it takes too long in one turn of the event loop.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        server_state: SharedState,
        app_state: dict[str, Any],
        _loop: asyncio.AbstractEventLoop | None = None,
        admission: Admission | None = None,
    ) -> None:
        """Connect the protocol; `admission` replaces the server's own."""
        self._buffer = server_state.buffer
        self._http = _Http(config, server_state, app_state, _loop)
        self._http.shared = server_state
        self._http.admission = admission or server_state.admission

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Handle a new connection of a client."""
        self._http.connection_made(cast(asyncio.Transport, transport))

    def connection_lost(self, exc: Exception | None) -> None:
        """Handle the end of the connection."""
        self._http.connection_lost(exc)

    def pause_writing(self) -> None:
        """Handle a full send buffer: the client reads more slowly than the app sends."""
        self._http.pause_writing()

    def resume_writing(self) -> None:
        """Handle a send buffer that has room again: the app may send more."""
        self._http.resume_writing()

    def eof_received(self) -> None:
        """Handle the end of the client's data."""
        self._http.eof_received()

    def get_buffer(self, sizehint: int) -> memoryview:
        """Receive buffer shared by all connections; its content is copied before the next read."""
        return self._buffer

    def buffer_updated(self, nbytes: int) -> None:
        """Handle received bytes."""
        self._http.data_received(bytes(self._buffer[:nbytes]))


class _Flow(FlowControl):
    """Pauses reading while the app asks for it, or while the connection itself is on hold."""

    def __init__(self, transport: asyncio.Transport) -> None:
        super().__init__(transport)
        self.transport = transport
        self._on_hold = False
        self._stopped = False

    def pause_reading(self) -> None:
        self.read_paused = True
        self._apply()

    def resume_reading(self) -> None:
        self.read_paused = False
        self._apply()

    def hold(self, on_hold: bool) -> None:
        self._on_hold = on_hold
        self._apply()

    def _apply(self) -> None:
        stop = self.read_paused or self._on_hold
        if stop == self._stopped or self.transport.is_closing():
            return
        self._stopped = stop
        if stop:
            self.transport.pause_reading()
        else:
            self.transport.resume_reading()


class _Http(HttpToolsProtocol):
    """uvicorn's protocol with bounds and deadlines."""

    shared: SharedState
    admission: Admission
    flow: _Flow
    _unread_timer: asyncio.TimerHandle | None = None
    _discard_timer: asyncio.TimerHandle | None = None
    _close_timer: asyncio.TimerHandle | None = None
    _head_timer: asyncio.TimerHandle | None = None
    _held_since_s = 0.0
    _no_head_since_s: float | None = None
    _has_sent = False
    _is_over = False
    """True once data that arrive are ignored: the connection has ended, or refused a request."""
    _answering: RequestResponseCycle | None = None
    _in_body = False
    _section_bytes = _fields = 0
    """Size in bytes and number of fields of the head or trailers that the parser has reported."""
    _head_bytes = 0
    """Number of bytes read for a head, with up to `READ_BYTES` from before it."""
    _body_bytes = _framing_bytes = 0

    # ---- the connection ------------------------------------------------------------------------

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.logger = _LOG

    # uvicorn narrows what asyncio's protocol takes, and ignores that as well.
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.flow = _Flow(transport)
        if not self.admission.admit(self, self.client[0] if self.client else ""):
            self._is_over = True
            transport.write(RAW_RESPONSES[HTTPStatus.SERVICE_UNAVAILABLE])
            transport.close()
            return
        self._no_head_since_s = self.loop.time()
        self._head_timer = self.loop.call_later(FIRST_BYTE_S, self._check_head_deadline)

    def connection_lost(self, exc: Exception | None) -> None:
        self._is_over = True
        self.admission.remove(self)
        self._stop_unread_timer()
        for each in (self._head_timer, self._discard_timer, self._close_timer):
            if each is not None:
                each.cancel()
        super().connection_lost(exc)

    def abort(self) -> None:
        self._is_over = True
        self._disconnect()
        self.transport.abort()

    def _disconnect(self) -> None:
        """Tell running handlers that their client has left; their output is dropped."""
        for cycle in (self._answering, self.cycle, *(each for each, _ in self.pipeline)):
            if cycle is not None and not cycle.response_complete:
                cycle.disconnected = True
                cycle.message_event.set()

    # ---- what arrives --------------------------------------------------------------------------

    def data_received(self, data: bytes) -> None:
        if self._is_over:
            return
        self._has_sent = True
        discarded = self._is_answered_early()
        begun_s = time.thread_time() if discarded else 0.0
        super().data_received(data)
        if not self.transport.is_closing():
            self._count(data, discarded, begun_s)

    def _count(self, data: bytes, discarded: bool, begun_s: float) -> None:
        """Check received data against the limits; `discarded` began at a processor time."""
        if self._is_over:
            return
        if self._in_body:
            self._framing_bytes += len(data)
            # Chunks of a few bytes, an endless extension of a chunk, an endless trailer.
            free_bytes = self._body_bytes // 64 if discarded else MAX_HEAD_BYTES + self._body_bytes
            if self._framing_bytes > READ_BYTES + free_bytes:
                self._refuse()
            elif self._is_answered_early():
                taken_s = time.thread_time() - begun_s if discarded else 0.0
                self._hold(max(len(data) / DISCARDED_PER_S, taken_s / DISCARDING_SHARE))
            elif self.cycle.body:
                # The app has not asked for more: the rest waits in the system's own buffers.
                self.flow.pause_reading()
        else:
            self._head_bytes += len(data)
            if self._head_bytes > MAX_HEAD_BYTES + READ_BYTES:
                self._refuse()

    def _is_answered_early(self) -> bool:
        return self._in_body and self.cycle.response_complete

    def on_message_begin(self) -> None:
        super().on_message_begin()
        self._section_bytes = self._fields = self._head_bytes = 0

    def on_url(self, url: bytes) -> None:
        if self._has_room_for(len(url)):
            super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        self._fields += 1
        if self._has_room_for(len(name) + len(value) + 4) and not self._in_body:
            # Trailer fields are dropped: no request needs them.
            super().on_header(name, value)

    def _has_room_for(self, length: int) -> bool:
        self._section_bytes += length
        if self._section_bytes > MAX_HEAD_BYTES or self._fields > MAX_FIELDS:
            self._refuse()
        return not self._is_over

    def on_headers_complete(self) -> None:
        if self._is_over:
            return
        refusal = refusal_of(self.url, self.parser.get_http_version(), self.headers)
        if refusal is not None:
            self._refuse(_raw_response(*refusal))
            return
        before: RequestResponseCycle | None = self.cycle
        is_next = before is None or before.response_complete
        super().on_headers_complete()
        if is_next:
            self._answering = self.cycle
        self._no_head_since_s = None
        self._in_body = True
        self._section_bytes = self._fields = self._body_bytes = self._framing_bytes = 0
        self.admission.set_busy(self)
        if len(self.pipeline) > MAX_PIPELINED:
            self._refuse()

    def on_body(self, body: bytes) -> None:
        if self._is_over:
            return
        self._body_bytes += len(body)
        self._framing_bytes -= len(body)
        super().on_body(body)

    def on_message_complete(self) -> None:
        self._in_body = False
        if not self._is_over:
            super().on_message_complete()

    def on_response_complete(self) -> None:
        if self.pipeline:
            # The next begins after a pause, in which nothing is read either.
            self._answering, _ = self.pipeline[-1]
            self.loop.call_later(PIPELINED_PAUSE_S, super().on_response_complete)
            return
        super().on_response_complete()
        self._no_head_since_s = self.loop.time()
        self.admission.set_idle(self)

    def send_400_response(self, msg: str) -> None:
        if not self._is_over:
            super().send_400_response(msg)

    # ---- what is refused -----------------------------------------------------------------------

    def _refuse(self, response: bytes | None = None) -> None:
        """Refuse a request, by default with 431 if an answer is still possible, and close."""
        if self._is_over:
            return
        self._is_over = True
        cycle: RequestResponseCycle | None = self.cycle
        is_answering = cycle is not None and not cycle.response_complete
        is_answered = self._in_body and not is_answering
        if not is_answered and (not is_answering or self._can_interrupt()):
            self._disconnect()
            too_large = RAW_RESPONSES[HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE]
            self.transport.write(response or too_large)
        # Closed at once, with bytes unread, it would be reset, and the answer perhaps lost; and
        # a client that connects again at once would cost as much as before.
        self.flow.hold(True)
        self._close_timer = self.loop.call_later(LINGER_S, self.abort)

    def _can_interrupt(self) -> bool:
        """True if the request being read has no answer yet."""
        return self._in_body and not self.pipeline and not self.cycle.response_started

    # ---- bodies that are answered already ------------------------------------------------------

    def _hold(self, seconds: float) -> None:
        """Pause reading until this connection's turn to discard data."""
        now = self.loop.time()
        turn_s = max(self.shared.discarding_until_s, now) + seconds
        self.shared.discarding_until_s = turn_s
        if self._discard_timer is None and turn_s - now > LEAST_PAUSE_S:
            self._held_since_s = now
            self.flow.hold(True)
            self._discard_timer = self.loop.call_at(turn_s, self._read_on)

    def _read_on(self) -> None:
        self._discard_timer = None
        if self._is_over:
            return
        if self._no_head_since_s is not None:
            self._no_head_since_s += self.loop.time() - self._held_since_s
        self.flow.hold(False)

    # ---- deadlines -----------------------------------------------------------------------------

    def _check_head_deadline(self) -> None:
        # One timer a connection: a timer for every request would take measurable time.
        longest_s = HEAD_S if self._has_sent else FIRST_BYTE_S
        waited_s = 0.0
        if self._no_head_since_s is not None:
            waited_s = self.loop.time() - self._no_head_since_s
        if waited_s >= longest_s:
            self.abort()
        else:
            self._head_timer = self.loop.call_later(longest_s - waited_s, self._check_head_deadline)

    def pause_writing(self) -> None:
        """Handle a full send buffer: the client reads more slowly than the app sends."""
        super().pause_writing()
        self._start_unread_timer()

    def resume_writing(self) -> None:
        """Handle a send buffer that has room again: the app may send more."""
        self._stop_unread_timer()
        super().resume_writing()

    def _start_unread_timer(self) -> None:
        left = self.transport.get_write_buffer_size()
        self._unread_timer = self.loop.call_later(UNREAD_S, self._check_unread, left)

    def _check_unread(self, left_before: int) -> None:
        if self.transport.get_write_buffer_size() >= left_before:
            self.abort()
        else:
            self._start_unread_timer()

    def _stop_unread_timer(self) -> None:
        if self._unread_timer is not None:
            self._unread_timer.cancel()
            self._unread_timer = None


MAX_HEAD_BYTES = 64 << 10
"""Greatest size in bytes of a request head, and of the trailers after a chunked body."""
MAX_FIELDS = 100
"""Greatest number of header fields, or trailer fields."""


def _raw_response(status: HTTPStatus, detail: str, *headers: str) -> bytes:
    problem = {"type": "about:blank", "title": status.phrase, "status": int(status)}
    body = json.dumps(problem | {"detail": detail}, separators=(",", ":"))
    lines = (
        f"HTTP/1.1 {int(status)} {status.phrase}",
        "content-type: application/problem+json",
        f"content-length: {len(body)}",
        "connection: close",
        *headers,
    )
    return ("\r\n".join(lines) + "\r\n\r\n" + body).encode()


RAW_RESPONSES = {
    status: _raw_response(status, detail, *headers)
    for status, detail, *headers in (
        (
            HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE,
            f"a head, or trailers, may have {MAX_HEAD_BYTES} bytes and {MAX_FIELDS} fields",
        ),
        (
            HTTPStatus.SERVICE_UNAVAILABLE,
            "all connections that the service or this address may have are in use",
            "retry-after: 1",
        ),
    )
}
"""Complete HTTP responses as bytes, by status, that need no running app."""
