"""Command line of the service, `acquire`.

Modules are imported only when needed: help answers at once, and each command loads just its own
part of the service.
"""

import argparse
import os
import pkgutil
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import entry_points
from io import TextIOWrapper

from service import __version__
from service.cli import commands
from service.cli.arguments import add_command, add_subcommands, name_spacecraft
from service.errors import AcquisitionError, BadInput, UnknownSpacecraft
from service.feature import SETTING, feature_modules
from service.settings import Settings

USAGE_ERROR = 2
INTERRUPTED = 130


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command of `acquire` and return its exit code.

    0: done; 1: done, with faults or differences reported; 2: refused for its usage, configuration
    or input, or no service to talk to.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            # A locale may have no sign for a name of a star, or of a file.
            stream.reconfigure(errors="backslashreplace")
    parsed = None
    try:
        parsed = build_parser(os.environ.get(SETTING, "")).parse_args(arguments)
        name_spacecraft(parsed)
        code: int = parsed.function(parsed)
        sys.stdout.flush()
        return code
    except BadInput as error:
        for fault in error.faults:
            _complain(str(fault))
    except UnknownSpacecraft as error:
        _complain(f"{error}; looked for in {Settings.from_environment().mission_places_text}")
    except AcquisitionError as error:
        text = str(error)
        if getattr(parsed, "database", None) is not None:
            # The option replaces the setting of the environment.
            text = text.replace("ACQUIRE_DATABASE", "--database")
        _complain(text)
    except KeyboardInterrupt:
        _complain("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader closed the pipe: further output would raise again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        _complain(f"{where}{error.strerror or error}")
    return USAGE_ERROR


def _complain(text: str) -> None:
    for line in text.splitlines() or [""]:
        print(f"acquire: {line}", file=sys.stderr)


def build_parser(features_off: str = "") -> argparse.ArgumentParser:
    """Argument parser of `acquire`; the parsed `function` runs the chosen command.

    `features_off` are the features whose commands are left out; see `service.feature`.  An
    installed package adds commands by an entry point of the group `acquire.commands`: a function
    with the arguments of `add` in the modules of `commands`.
    """
    parser = add_command(
        None,
        "acquire",
        summary="Star identification and attitude: from observed stars to a recorded attitude.",
        examples="""
        acquire demo                                 start the service and replay sample passes
        acquire serve                                serve on http://127.0.0.1:8000
        acquire replay pass.ndjson --results out.ndjson
        acquire COMMAND --help                       the arguments of a command
        """,
        first="mission simulate serve replay frame export demo",
    )
    parser.add_argument("--version", action="version", version=f"acquire {__version__}")
    added = add_subcommands(parser)
    for found in pkgutil.iter_modules(commands.__path__):
        import_module(f"{commands.__name__}.{found.name}").add(added)
    for module in feature_modules("command", features_off):
        module.add(added)
    for module in feature_modules("telemetry", features_off):
        module.add_options(added.choices["replay"])
    for entry in entry_points(group="acquire.commands"):
        entry.load()(added)
    return parser
