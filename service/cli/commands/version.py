"""Command `acquire version`: print the version."""

from argparse import Namespace
from typing import Any

from service import __version__
from service.cli.arguments import add_command


def add(commands: Any) -> None:
    """Declare the command `version`."""
    add_command(commands, "version", run)


def run(parsed: Namespace) -> int:
    """Print the version.

    acquire version
    """
    print(f"acquire {__version__}")
    return 0
