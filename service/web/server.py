"""Serving the app with uvicorn, on this machine alone."""

import uvicorn

from service.operations import Operations
from service.settings import Settings
from service.web.app import create_app

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
    )
