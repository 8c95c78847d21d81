"""Serving the app with uvicorn, on this machine alone."""

import resource

import uvicorn

from service.operations import Operations
from service.settings import Settings
from service.web.app import create_app

MAX_FILES = 4096

GRACE_S = 10
"""How long running requests may still take when the server is told to stop."""


def serve(settings: Settings) -> None:
    """Open the operations and serve until told to stop (SIGINT, SIGTERM).

    The settings have made sure that the host is a loopback address: nobody is
    asked who they are yet, so nobody but this machine may ask.
    """
    app = create_app(Operations.open(settings))
    uvicorn.run(
        app,
        host=settings.host,
        port=settings.port,
        http="httptools",
        loop="uvloop",
        ws="none",
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
        limit_concurrency=_connections(),
    )


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
