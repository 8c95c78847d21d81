"""The parser of `acquire`: every module of `service.cli.commands` adds its command."""

import argparse
import pkgutil
from importlib import import_module

from service import __version__
from service.cli import commands
from service.cli.arguments import add_command, add_subcommands


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command; `function` of what it parses runs the chosen command."""
    parser = add_command(
        None,
        "acquire",
        "Star identification and attitude: from observed stars to a recorded attitude.",
        """
        acquire demo                                 start the service and replay sample passes
        acquire serve                                serve on http://127.0.0.1:8000
        acquire replay pass.ndjson --results out.ndjson
        acquire COMMAND --help                       the arguments of a command
        """,
    )
    parser.add_argument("--version", action="version", version=f"acquire {__version__}")
    added = add_subcommands(parser)
    for module in pkgutil.iter_modules(commands.__path__):
        import_module(f"{commands.__name__}.{module.name}").add(added)
    return parser
