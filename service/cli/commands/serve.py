"""`acquire serve`: serve until told to stop."""

import faulthandler
import gc
from argparse import Namespace
from typing import Any

from service.cli.arguments import add_command, add_database
from service.cli.configuration import settings_of


def add(commands: Any) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "serve",
        "Serve the API and the console.  Creates and migrates an SQLite file if needed.",
        """
        acquire serve
        acquire serve --port 8100 --database sqlite:///night.db
        """,
        run,
    )
    parser.add_argument(
        "--host",
        help="address to listen on; one that is not loopback requires a token; default: "
        "ACQUIRE_HOST, else 127.0.0.1",
    )
    parser.add_argument("--port", type=int, help="default: ACQUIRE_PORT, else 8000")
    add_database(parser)


def run(parsed: Namespace) -> int:
    """Serve until told to stop."""
    # Nearly everything loaded at the start stays: looking for garbage takes a sixth of the
    # start.  `ready` enables collection again.
    gc.disable()
    settings = settings_of(parsed)
    if not faulthandler.is_enabled():
        # A fault in compiled code ends the process; this says where.
        faulthandler.enable()
    from service import logs
    from service.web.ports import require_free

    require_free(settings.host, settings.port)
    logs.configure(settings.logs, "server")
    from service.web.server import serve as serve_forever

    serve_forever(settings)
    return 0
