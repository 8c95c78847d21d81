"""HTTP server (uvicorn) of the app, on loopback only until there are tokens."""

import asyncio
import os
import resource
import socket
import sys
from collections.abc import Callable
from contextlib import ExitStack, suppress
from functools import partial
from typing import cast

import uvicorn
from fastapi import FastAPI
from starlette.types import ASGIApp

from service import logs
from service.app.factory import App, open_app
from service.errors import BadConfiguration
from service.feature import feature_modules
from service.settings import Settings, is_loopback, networks
from service.storage.sql.database_file import warn_of_readers
from service.web.app import create_app
from service.web.middleware import ProbesOnly
from service.web.slow_clients import Admission, Connection, SharedState

MAX_FILES = 4096
KEPT_FILES = 96
"""Number of files kept free for later: database readers, sky maps, pipes of workers.

A service on SQLite with a replay in two processes had 41 more than at its start.
"""
LEAST_CONNECTIONS = 32

START_FAILED = 3
SWITCH_INTERVAL_S = 0.001
"""Longest time in seconds that a thread holds the interpreter while others wait."""
GRACE_S = 10
"""Seconds that running requests may take after the server is told to stop."""
PROBE_CONNECTIONS = 64
"""Greatest number of connections of the probe port, apart from the limit of all others."""


def serve(settings: Settings) -> None:
    """Serve until told to stop (SIGINT, SIGTERM).

    Raises `BadConfiguration` for settings that cannot be used, and for a host other than
    a loopback address while there are no tokens: every client could submit there.
    """
    # Report a mistake in the settings before the database is opened.
    for module in feature_modules("serving", settings.features_off):
        module.check(settings)
    app, probes = _opened(settings)
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    _run(settings, create_app(app), probes)


def _opened(settings: Settings) -> tuple[App, socket.socket | None]:
    """The opened app, and the listening socket of the probe port, or None without such a port."""
    with ExitStack() as on_failure:
        app = open_app(settings, serving=True)
        on_failure.callback(app.close)
        if not is_loopback(settings.host) and not app.access.has_tokens():
            raise BadConfiguration(
                f"ACQUIRE_HOST: {settings.host} is not a loopback address: create a token first, "
                "with `acquire token create`"
            )
        if app.store.file is not None:
            warn_of_readers(app.store.file.path)
        warn_of_readers(settings.spool_folder)
        probes = _listening(settings.host, settings.probe_port)
        on_failure.pop_all()
    return app, probes


def configuration(settings: Settings, web_app: ASGIApp) -> uvicorn.Config:
    """Configuration of uvicorn for an app."""
    return uvicorn.Config(
        web_app,
        host=settings.host,
        port=settings.port,
        http=cast(type[asyncio.Protocol], Connection),
        loop="uvloop",
        ws="none",
        # Logging is configured by `service.logs`; requests are logged where their caller is known.
        log_config=None,
        access_log=False,
        server_header=False,
        timeout_keep_alive=settings.keep_alive_seconds,
        timeout_graceful_shutdown=GRACE_S,
        forwarded_allow_ips=settings.trusted_proxies,
    )


def _run(settings: Settings, web_app: FastAPI, probes: socket.socket | None) -> None:
    admission = Admission(
        _connections(), settings.connections_per_address, networks(settings.trusted_proxies)
    )
    server = Server(configuration(settings, web_app), web_app.state.live.stop, admission)
    if probes is not None:
        server.add_probes(probes, configuration(settings, ProbesOnly(web_app)))
    with suppress(KeyboardInterrupt):
        server.run()
    if not server.started:
        raise SystemExit(START_FAILED)


class Server(uvicorn.Server):
    """uvicorn server with connection limits and an optional port for probes.

    Event streams end before the server waits for connections to close.
    """

    def __init__(
        self,
        config: uvicorn.Config,
        stop_streams: Callable[[], None],
        admission: Admission | None = None,
    ) -> None:
        super().__init__(config)
        self.server_state = self._state = SharedState(admission or Admission(_connections()))
        self._stop_streams = stop_streams
        self._probes: tuple[socket.socket, uvicorn.Config] | None = None

    def add_probes(self, listening: socket.socket, config: uvicorn.Config) -> None:
        """Serve another app on a socket of its own, for probes."""
        self._probes = listening, config

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Open the app and listen on all ports."""
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
        """End the event streams, then the connections."""
        self._stop_streams()
        await super().shutdown(sockets)
        logs.finish()


def _listening(host: str, port: int | None) -> socket.socket | None:
    """Listening socket for probes; None without a probe port."""
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
    """Greatest number of simultaneous connections.

    Without a limit idle connections would use up the process's open files, and no more could be
    accepted.  Raises `BadConfiguration` if too few files are left for connections.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = MAX_FILES if hard == resource.RLIM_INFINITY else min(hard, MAX_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    files = wanted if soft == resource.RLIM_INFINITY else min(soft, MAX_FILES)
    opened = len(os.listdir("/dev/fd"))
    left = files - opened - KEPT_FILES
    if left < LEAST_CONNECTIONS:
        raise BadConfiguration(
            f"open files: this process may have {files}, has {opened}, and keeps {KEPT_FILES} for "
            f"the database, the sky and replays; allow at least {files - left + LEAST_CONNECTIONS} "
            "(ulimit -n, or LimitNOFILE in a unit of systemd)"
        )
    return min(left, MAX_FILES // 2)
