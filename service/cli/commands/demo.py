"""Command `acquire demo`: run the service with simulated passes."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli.arguments import add_command, add_json, count, settings_of


def add(commands: Any) -> None:
    """Declare the command `demo`."""
    parser = add_command(commands, "demo", run)
    parser.add_argument("--host", help="loopback address; default 127.0.0.1")
    parser.add_argument("--port", type=int, help="default 8000")
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path("var"),
        help="folder for samples and database, in place of ACQUIRE_DATABASE; default ./var",
    )
    parser.add_argument(
        "--batches", type=count, default=300, metavar="N", help="batches per mission; default 300"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    parser.add_argument("--once", action="store_true", help="stop after printing the table")
    add_json(parser, "the table's figures")


def run(parsed: Namespace) -> int:
    """Start the service, replay sample passes of XTE, SWAS and SOHO over HTTP, print the
    identification rates, and keep serving.

    acquire demo
    acquire demo --batches 1000 --seed 3 --port 8100 --once
    """
    from service.demo import run_demo

    return run_demo(
        folder=parsed.folder,
        settings=settings_of(parsed),
        batches=parsed.batches,
        seed=parsed.seed,
        once=parsed.once,
        as_json=parsed.json,
    )
