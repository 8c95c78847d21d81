"""Serving the app with uvicorn: on this machine alone, until there are tokens."""

import asyncio
import resource
import socket
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import cast

import uvicorn
from starlette.types import ASGIApp

from service import logs
from service.backend.front import Front
from service.backend.start import Started, start_backend
from service.errors import BadConfiguration
from service.records.store import warn_of_old_sqlite
from service.settings import Settings, is_loopback, networks
from service.web.admission import Admission
from service.web.app import create_app
from service.web.connection import Connection, State
from service.web.middleware import ProbesAlone

MAX_FILES = 4096

START_FAILED = 3
TURN_S = 0.001
"""How long a thread keeps others waiting that want to go on, such as the one that speaks HTTP."""
GRACE_S = 10
"""How long running requests may still take when the server is told to stop."""
PROBE_CONNECTIONS = 64
"""Connections of the port for probes: they are outside the bound of all others."""


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
    try:
        probes = _listening(settings.host, settings.probe_port)
    except BadConfiguration:
        operations.close()
        raise
    app = create_app(operations)
    sys.setswitchinterval(TURN_S)

    def configured(app: ASGIApp) -> uvicorn.Config:
        return uvicorn.Config(
            app,
            host=settings.host,
            port=settings.port,
            http=cast(type[asyncio.Protocol], Connection),
            loop="uvloop",
            ws="none",
            # As `service.logs` has it; requests are logged where their caller is known.
            log_config=None,
            access_log=False,
            server_header=False,
            timeout_graceful_shutdown=GRACE_S,
            forwarded_allow_ips=settings.trusted_proxies,
        )

    admission = Admission(
        _connections(), settings.connections_per_address, networks(settings.trusted_proxies)
    )
    server = Server(configured(app), app.state.live.stop, admission)
    if probes is not None:
        server.add_probes(probes, configured(ProbesAlone(app)))
    with suppress(KeyboardInterrupt):
        server.run()
    if not server.started:
        raise SystemExit(START_FAILED)


class Server(uvicorn.Server):
    """uvicorn's server with bounds for its connections and, where wanted, a port for probes.

    It ends the event streams before it waits for connections to end.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        stop_streams: Callable[[], None],
        admission: Admission | None = None,
    ) -> None:
        super().__init__(config)
        self.server_state = self._state = State(admission or Admission(_connections()))
        self._stop_streams = stop_streams
        self._probes: tuple[socket.socket, uvicorn.Config] | None = None

    def add_probes(self, listening: socket.socket, config: uvicorn.Config) -> None:
        """Serve the app of another configuration on a socket of its own."""
        self._probes = listening, config

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the app and listen."""
        await super().startup(sockets)
        if self._probes is None:
            return
        listening, config = self._probes
        config.load()
        connect = partial(
            Connection,
            config,
            self._state,
            self.lifespan.state,
            admission=Admission(PROBE_CONNECTIONS),
        )
        loop = asyncio.get_running_loop()
        self.servers.append(await loop.create_server(connect, sock=listening))

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """End the streams, then everything else."""
        self._stop_streams()
        await super().shutdown(sockets)
        logs.finish()


def _listening(host: str, port: int | None) -> socket.socket | None:
    """A socket on which probes are answered; None without a port for them."""
    if port is None:
        return None
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family)
    except OSError as error:
        raise BadConfiguration(
            f"ACQUIRE_PROBE_PORT: cannot listen on port {port} of {host} ({error.strerror}); "
            "choose another port, or stop the program that has it"
        ) from None


def _connections() -> int:
    """How many connections may be open at once.

    Without a bound idle connections would use up the files that the process may
    open, and it could accept none.  Half of the files are left to the database.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    return max(16, min(MAX_FILES, wanted if soft == resource.RLIM_INFINITY else soft) // 2)
