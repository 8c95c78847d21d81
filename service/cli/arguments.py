"""How commands are declared: parsers with examples, and arguments that several commands share.

Modules of commands import nothing heavy before they run: help answers at once.
"""

import argparse
import textwrap
from collections.abc import Callable
from typing import Any, NoReturn

LOCAL = "http://127.0.0.1:8000"
MISSION = "XTE, SWAS, SOHO, or one of your own"
CAMERA_MISSION = "IMAGER, or one of your own whose tracker has a camera"

Function = Callable[[argparse.Namespace], int]


class Parser(argparse.ArgumentParser):
    """A parser whose error messages fit on one line and point to the help."""

    def error(self, message: str) -> NoReturn:
        """Print the message and exit with code 2."""
        self.exit(2, f"acquire: {message} (see `{self.prog} --help`)\n")


def add_command(
    parent: Any,
    name: str,
    summary: str,
    examples: str,
    function: Function | None = None,
    notes: str = "",
) -> argparse.ArgumentParser:
    """Add a command that runs `function`, which returns the exit code.

    `parent` None makes the parser of the whole command.  `notes` follow the examples in the help.
    """
    lines = [line.strip() for line in examples.strip().splitlines()]
    epilog = "examples:\n" + "\n".join(f"  {line}" for line in lines)
    arguments: dict[str, Any] = {
        "description": textwrap.fill(summary, 79),
        "epilog": f"{epilog}\n\n{notes}" if notes else epilog,
        "formatter_class": argparse.RawDescriptionHelpFormatter,
        "allow_abbrev": False,
    }
    if parent is None:
        return Parser(prog=name, **arguments)
    made: argparse.ArgumentParser = parent.add_parser(name, help=summary, **arguments)
    made.set_defaults(function=function)
    return made


def add_group(parent: Any, name: str, summary: str, examples: str) -> Any:
    """Add a command that has commands of its own; returns what takes these."""
    return add_subcommands(add_command(parent, name, summary, examples))


def add_subcommands(parser: argparse.ArgumentParser) -> Any:
    """Let a parser require one of several commands."""
    return parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, parser_class=Parser
    )


def add_database(parser: argparse.ArgumentParser) -> None:
    """Add `--database`."""
    parser.add_argument(
        "--database",
        metavar="URL",
        help="SQLAlchemy URL of the database; default: ACQUIRE_DATABASE, else sqlite:///acquire.db",
    )


def add_period(parser: argparse.ArgumentParser, run_help: str) -> None:
    """Add `--run`, `--from` and `--to`; see `configuration.period_of`."""
    parser.add_argument("--run", metavar="NAME", help=run_help)
    parser.add_argument(
        "--from", dest="start", metavar="UTC", help="start of the period (batch time), included"
    )
    parser.add_argument(
        "--to", dest="end", metavar="UTC", help="end of the period (batch time), excluded"
    )


def count(text: str) -> int:
    """Parse a whole number of at least one."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1 (got {text!r})")
    return number


def table(text: str) -> int | str:
    """Parse the number of a table, or the name of one such as ptp-5."""
    return count(text) if text.lstrip("-").isdigit() else text


def speed(text: str) -> float | None:
    """Parse a factor above zero; `max` gives None."""
    if text == "max":
        return None
    try:
        factor = float(text)
    except ValueError:
        factor = 0.0
    if not 0 < factor < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number above 0, or max (got {text!r})")
    return factor


def positive(text: str) -> float:
    """Parse a number above zero."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number above 0 (got {text!r})")
    return number


def degrees(text: str) -> float:
    """Parse a field of view."""
    number = positive(text)
    if number >= 120:
        raise argparse.ArgumentTypeError(f"must be below 120 degrees (got {text!r})")
    return number
