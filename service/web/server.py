"""Serving the app with uvicorn: on this machine alone, until there are tokens."""

import asyncio
import resource
import socket
import sys
from collections.abc import Callable
from contextlib import suppress

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from service import logs
from service.backend.front import Front
from service.backend.start import Started, start_backend
from service.errors import BadConfiguration
from service.records.store import warn_of_old_sqlite
from service.settings import Settings, is_loopback
from service.web.app import create_app

MAX_FILES = 4096

START_FAILED = 3
TURN_S = 0.001
"""How long a thread keeps others waiting that want to go on, such as the one that speaks HTTP."""
GRACE_S = 10
"""How long running requests may still take when the server is told to stop."""
HEAD_S = 30
"""So long may a client be silent between two requests, or be at the head of one."""
PASSED_BY_PER_S = 50e6
"""Bytes of a body that was refused.  It is taken off to its end, for many clients look for an
answer only then; as fast as several can send it, that would keep a processor from all others."""
UNREAD_S = 60
"""An answer of which so long nothing was read is given up: it takes memory until it is gone."""


def serve(settings: Settings, started: Started | None = None) -> None:
    """Serve until told to stop (SIGINT, SIGTERM); the operations have a process of their own.

    That process may have been `started` before.
    Raises `BadConfiguration` for a host beyond this machine while there are no
    tokens: nobody would be asked who they are.
    """
    operations = Front(start_backend(settings) if started is None else started)
    if not is_loopback(settings.host) and not operations.access.has_tokens():
        operations.close()
        raise BadConfiguration(
            f"ACQUIRE_HOST: {settings.host} is beyond this machine, and anybody there could ask "
            "and submit: make a token first with `acquire token create`"
        )
    warn_of_old_sqlite(settings.database)
    app = create_app(operations)
    sys.setswitchinterval(TURN_S)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        http=Connection,
        loop="uvloop",
        ws="none",
        # As `service.logs` has it; requests are logged where their caller is known.
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        limit_concurrency=_connections(),
    )
    server = Server(config, app.state.live.stop)
    with suppress(KeyboardInterrupt):
        server.run()
    if not server.started:
        raise SystemExit(START_FAILED)


class Connection(HttpToolsProtocol):
    """A connection that ends where its client sends no whole head, or leaves an answer unread.

    uvicorn would keep both: it counts the seconds between two requests alone, and
    no longer as soon as a byte arrives.  Bodies have deadlines of their own.
    """

    _looking: asyncio.TimerHandle | None = None
    _passing_by: asyncio.TimerHandle | None = None
    _read_until_s = _read_on_s = 0.0
    _waiting: asyncio.TimerHandle | None = None
    _no_head_since_s: float | None = None

    # uvicorn narrows what asyncio's protocol takes, and ignores that as well.
    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """A client is there."""
        super().connection_made(transport)
        self._no_head_since_s = self.loop.time()
        self._waiting = self.loop.call_later(HEAD_S, self._look_for_head)

    def on_headers_complete(self) -> None:
        """A request has begun, and its handler says how long it may take."""
        super().on_headers_complete()
        self._no_head_since_s = None

    def on_body(self, body: bytes) -> None:
        """A piece of a body, perhaps of one that is answered already."""
        super().on_body(body)
        if self.cycle.response_complete:
            self._pass_by(len(body) / PASSED_BY_PER_S)

    def _pass_by(self, seconds: float) -> None:
        """Read nothing for so long, and do not count that as the client's silence."""
        if self._passing_by is None:
            self._read_until_s = self._read_on_s = self.loop.time()
            self.flow.pause_reading()
        else:
            self._passing_by.cancel()
        self._read_on_s += seconds
        self._passing_by = self.loop.call_at(self._read_on_s, self._read_on)

    def _read_on(self) -> None:
        self._passing_by = None
        if self._no_head_since_s is not None:
            self._no_head_since_s += self.loop.time() - self._read_until_s
        self.flow.resume_reading()

    def on_response_complete(self) -> None:
        """The next request may come; of some of them the head is there already."""
        super().on_response_complete()
        if self.cycle.response_complete:
            self._no_head_since_s = self.loop.time()

    def _look_for_head(self) -> None:
        # One timer a connection: to set one for every request would be felt.
        waited_s = 0.0
        if self._no_head_since_s is not None:
            waited_s = self.loop.time() - self._no_head_since_s
        if waited_s >= HEAD_S:
            self.transport.abort()
        else:
            self._waiting = self.loop.call_later(HEAD_S - waited_s, self._look_for_head)

    def pause_writing(self) -> None:
        """More is to be sent than the client takes off."""
        super().pause_writing()
        self._look_again()

    def resume_writing(self) -> None:
        """It has taken most of it."""
        self._look_no_more()
        super().resume_writing()

    def connection_lost(self, exc: Exception | None) -> None:
        """There is nobody any more."""
        self._look_no_more()
        for each in (self._waiting, self._passing_by):
            if each is not None:
                each.cancel()
        super().connection_lost(exc)

    def _look_again(self) -> None:
        left = self.transport.get_write_buffer_size()
        self._looking = self.loop.call_later(UNREAD_S, self._look, left)

    def _look(self, left_before: int) -> None:
        if self.transport.get_write_buffer_size() >= left_before:
            self.transport.abort()
        else:
            self._look_again()

    def _look_no_more(self) -> None:
        if self._looking is not None:
            self._looking.cancel()
            self._looking = None


class Server(uvicorn.Server):
    """uvicorn's server, which tells those who listen for events before it waits for them to go."""

    def __init__(self, config: uvicorn.Config, stop_streams: Callable[[], None]) -> None:
        super().__init__(config)
        self._stop_streams = stop_streams

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams, then everything else."""
        self._stop_streams()
        await super().shutdown(sockets)
        logs.finish()


def _connections() -> int:
    """How many connections may be open at once; whoever comes beyond that is told 503.

    Without a bound idle connections use up the files that the process may
    open, and then nobody is told anything.  Half are left to the database.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    return max(16, min(MAX_FILES, wanted if soft == resource.RLIM_INFINITY else soft) // 2)
