"""Declaration of commands, and shared parts: arguments, settings, missions, periods, progress.

Modules of commands import nothing heavy before they run: help answers at once.
"""

import argparse
import dataclasses
import difflib
import inspect
import sys
import textwrap
from argparse import Namespace
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from service.errors import BadInput, Fault, shown_value
from service.settings import Settings, url_of

if TYPE_CHECKING:
    import httpx

    from service.missions.mission import Mission
    from service.sky.catalog.star_catalog import Catalog
    from service.storage.store import Store
    from service.times import Utc


SERVICE = "the service; default: ACQUIRE_HOST and ACQUIRE_PORT, else http://127.0.0.1:8000"
MISSION = "XTE, SWAS, SOHO, the name of one of your own, or its file (.toml)"
FILE_OR_NAME = "a mission file (.toml), or the name of a spacecraft"

MOST_OPTIONS, MOST_FIRST = 8, 7
"""Greatest number of options in a single help list, and of options shown first in a longer one."""

Function = Callable[[argparse.Namespace], int]


def print_json(value: Any) -> None:
    """Print a plain value as JSON; numbers that are not finite become null."""
    import msgspec

    print(msgspec.json.format(msgspec.json.encode(value), indent=1).decode())


_Section = tuple[str | None, str | None, Sequence[argparse.Action]]
"""Section of a help text: title, description, and arguments or commands."""


class Parser(argparse.ArgumentParser):
    """Argument parser with one-line error messages that suggest the likely word and name the help.

    A command with subcommands prints its help if none is given.
    """

    commands: Any = None
    """Action that holds the subcommands; None for a command without."""
    first: Sequence[str] = ()
    """Most common options or commands, which the help shows before all others."""

    def format_help(self) -> str:
        """Text of the help; options in `first`, and required ones, before all others."""
        if not self.first:
            return super().format_help()
        formatter = self._get_formatter()
        if self.commands is not None:
            formatter.add_usage(None, self._actions, [])
            sections = self._sections_of_commands()
        else:
            shown = self._first_arguments()
            more = argparse.Action([], "more", nargs="?", metavar="more options")
            groups = [
                each
                for each in self._mutually_exclusive_groups
                if {*each._group_actions} <= {*shown}
            ]
            formatter.add_usage(None, [*shown, more], groups)
            sections = self._sections_of_options(shown)
        formatter.add_text(self.description)
        for title, description, members in sections:
            formatter.start_section(title)
            formatter.add_text(description)
            formatter.add_arguments(members)
            formatter.end_section()
        formatter.add_text(self.epilog)
        return formatter.format_help()

    def _sections_of_commands(self) -> list[_Section]:
        listed = {each.dest: each for each in self.commands._get_subactions()}
        # A command of a feature that is off is not there.
        shown = [listed.pop(name) for name in self.first if name in listed]
        return [
            ("commands to begin with", None, shown),
            ("more commands", None, [*listed.values()]),
            ("options", None, self._optionals._group_actions),
        ]

    def _first_arguments(self) -> list[argparse.Action]:
        return [
            each
            for each in self._actions
            if each.help != argparse.SUPPRESS
            and (each.required or not each.option_strings or {*each.option_strings} & {*self.first})
        ]

    def _sections_of_options(self, shown: list[argparse.Action]) -> list[_Section]:
        return [
            ("arguments", None, shown),
            *(
                (
                    "more options" if group is self._optionals else group.title,
                    group.description,
                    [each for each in group._group_actions if each not in shown],
                )
                for group in self._action_groups
                if group is not self._positionals
            ),
        ]

    def error(self, message: str) -> NoReturn:
        """Print an error message and exit with code 2."""
        self.exit(2, f"acquire: {message} (see `{self.prog} --help`)\n")

    # The stubs of argparse declare two overloads, by whether a namespace is given; here one
    # signature takes both.
    def parse_known_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: Any = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Parse arguments; for an unknown option the error suggests the nearest known one."""
        words = sys.argv[1:] if args is None else list(args)
        has_commands = self._subparsers is not None
        # Before a missing argument is reported: the misspelt option may be the missing one.
        self._refuse_unknown_options(words[:1] if has_commands else words)
        known: argparse.Namespace
        known, extra = super().parse_known_args(words, namespace)
        if has_commands and getattr(known, "function", None) is None and not extra:
            self.print_help()
            self.exit()
        return known, extra

    def _refuse_unknown_options(self, words: Sequence[str]) -> None:
        for word in words:
            if word == "--":
                return
            name = word.partition("=")[0]
            if not name.startswith("--") or " " in name or name in self._option_string_actions:
                continue
            shown = [
                option
                for option, action in self._option_string_actions.items()
                if action.help != argparse.SUPPRESS
            ]
            self.error(f"there is no option {name}{_meant(name, shown)}")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        try:
            super()._check_value(action, value)
        except argparse.ArgumentError as error:
            if meant := _meant(str(value), map(str, action.choices or ())):
                error.message = f"invalid choice: {value!r}{meant}"
            raise


def _meant(text: str, known: Iterable[str]) -> str:
    """Suggestion of the most similar known word, for an error message; empty without any."""
    near = difflib.get_close_matches(text, tuple(known), n=1)
    return f"; did you mean {near[0]}?" if near else ""


def add_command(
    parent: Any,
    name: str,
    function: Function | None = None,
    *,
    summary: str = "",
    examples: str = "",
    notes: str = "",
    first: str = "",
) -> argparse.ArgumentParser:
    """Add a command whose `function` runs it and returns the exit code.

    The help is the function's docstring: a summary, an empty line, examples.  A group, or a command
    whose function serves several, has `summary` and `examples` instead.  `notes` follow the
    examples.  `first` are the most common options of a command with more than `MOST_OPTIONS`, or
    the commands to begin with.  `parent` None creates the parser of the whole command.
    """
    if not summary:
        summary, examples = _help_of(function)
    options: dict[str, Any] = {
        "formatter_class": argparse.RawDescriptionHelpFormatter,
        "allow_abbrev": False,
    }
    made: argparse.ArgumentParser
    if parent is None:
        made = Parser(prog=name, **options)
    else:
        # The list of commands has their first sentences.
        brief = f"{summary.partition('. ')[0].rstrip('.')}."
        made = parent.add_parser(name, help=brief, **options)
        made.set_defaults(function=function)
    _set_texts(made, summary, examples, notes)
    if isinstance(made, Parser):
        made.first = first.split()
    return made


def describe(parser: argparse.ArgumentParser, function: Function, notes: str = "") -> None:
    """Let a command that was added before run another function, whose docstring is the help."""
    _set_texts(parser, *_help_of(function), notes)
    parser.set_defaults(function=function)


def _help_of(function: Function | None) -> tuple[str, str]:
    """The summary and the examples in the docstring of a command's function."""
    summary, _, examples = (inspect.getdoc(function) or "").partition("\n\n")
    return " ".join(summary.splitlines()), examples


def _set_texts(parser: argparse.ArgumentParser, summary: str, examples: str, notes: str) -> None:
    lines = [line.strip() for line in examples.strip().splitlines()]
    epilog = "examples:\n" + "\n".join(f"  {line}" for line in lines)
    parser.description = textwrap.fill(summary, 79)
    parser.epilog = f"{epilog}\n\n{notes}" if notes else epilog


def add_group(parent: Any, name: str, summary: str, examples: str) -> Any:
    """Add a command with subcommands; returns the action to add these to."""
    return add_subcommands(add_command(parent, name, summary=summary, examples=examples))


def add_subcommands(parser: argparse.ArgumentParser) -> Any:
    """Allow a parser one of several subcommands; without one it prints its help."""
    taken = parser.add_subparsers(title="commands", metavar="COMMAND", parser_class=Parser)
    if isinstance(parser, Parser):
        parser.commands = taken
    return taken


def commands_of(parent: Any, name: str) -> Any:
    """Action that holds the subcommands of a group, to add further ones from a package."""
    return parent.choices[name].commands


def add_database(parser: argparse.ArgumentParser) -> None:
    """Add the option `--database` to a parser."""
    parser.add_argument(
        "--database",
        metavar="URL",
        help="SQLAlchemy URL of the database; default: ACQUIRE_DATABASE, else sqlite:///acquire.db",
    )


def add_url_or_in_process(parser: argparse.ArgumentParser) -> None:
    """Add the exclusive options `--url` and `--in-process` to a parser."""
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--url", help=SERVICE)
    way.add_argument(
        "--in-process",
        action="store_true",
        help="process the files in this process, without a server",
    )


def add_json(parser: argparse.ArgumentParser, what: str) -> None:
    """Add the option `--json`, which prints `what` as JSON instead of text."""
    parser.add_argument("--json", action="store_true", help=f"print {what} as JSON")


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the option `--output` to the parser of a command that writes one file."""
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="the file to write; default: standard output"
    )


def add_period(parser: argparse.ArgumentParser, run_help: str) -> None:
    """Add the options `--run`, `--start` and `--end`; see `period_of`."""
    parser.add_argument("--run", metavar="NAME", help=run_help)
    parser.add_argument("--start", metavar="UTC", help="start of the period (batch time), included")
    parser.add_argument("--end", metavar="UTC", help="end of the period (batch time), excluded")
    # The words of earlier versions, which scripts may hold.
    parser.add_argument("--from", dest="start", help=argparse.SUPPRESS)
    parser.add_argument("--to", dest="end", help=argparse.SUPPRESS)


def add_grade(parser: argparse.ArgumentParser) -> None:
    """Add the option `--grade`, which selects raw, filtered or smoothed attitudes."""
    parser.add_argument(
        "--grade",
        choices=("raw", "filtered", "smoothed"),
        default="raw",
        help="raw: of batches (default); the others are recorded by `acquire smooth`",
    )


def count(text: str) -> int:
    """Parse a whole number of at least one, for an option."""
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1 (got {text!r})")
    return number


def speed(text: str) -> float | None:
    """Parse a speed factor above zero, for an option; `max` gives None."""
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
    """Parse a number above zero, for an option."""
    try:
        number = float(text)
    except ValueError:
        number = 0.0
    if not 0 < number < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a number above 0 (got {text!r})")
    return number


def add_object(parser: argparse.ArgumentParser) -> None:
    """Add the option `--object`, for files with the attitudes of several objects."""
    parser.add_argument(
        "--object",
        metavar="ID",
        help="the object whose attitudes the file gives: its name, or the NAIF id of a structure "
        "of a C-kernel, which must be chosen where the kernel has several",
    )


def degrees(text: str) -> float:
    """Parse a field of view in degrees, above 0 and at most 180, for an option."""
    number = positive(text)
    if number > 180:
        raise argparse.ArgumentTypeError(f"must be at most 180 degrees (got {text!r})")
    return number


def written_to(file: Path | None, content: Iterator[bytes]) -> None:
    """Write content to a file, or to standard output if `file` is None.

    The file appears only when complete: it is written under a temporary name in the same folder.
    """
    if file is None:
        for piece in content:
            sys.stdout.buffer.write(piece)
        sys.stdout.buffer.flush()
        return
    beside = file.with_name(f"{file.name}.part")
    try:
        with beside.open("wb") as part:
            for piece in content:
                part.write(piece)
        beside.replace(file)
    except BaseException:
        beside.unlink(missing_ok=True)
        raise


def settings_of(parsed: Namespace) -> Settings:
    """Settings from the environment, overridden by the options of a command."""
    overrides = {
        name: value
        for name in ("database", "host", "port")
        if (value := getattr(parsed, name, None)) is not None
    }
    if isinstance(spacecraft := getattr(parsed, "spacecraft", None), SpacecraftName):
        overrides["mission_file"] = spacecraft.file
    return dataclasses.replace(Settings.from_environment(), **overrides)


def service_url(parsed: Namespace) -> str:
    """Address of the service: from `--url`, otherwise from the settings."""
    settings = settings_of(parsed)
    return parsed.url or url_of(settings.host, settings.port)


def http_client(settings: Settings, url: str, timeout_s: float) -> "httpx.Client":
    """HTTP client for the service at an address, with the access token of the settings."""
    import httpx

    headers = {} if settings.token is None else {"Authorization": f"Bearer {settings.token}"}
    # The service may listen to this machine alone, where no proxy reaches it.
    return httpx.Client(base_url=url, timeout=timeout_s, trust_env=False, headers=headers)


def refusal_of(response: "httpx.Response") -> str:
    """Reason given by the service in an answer that refuses a request."""
    try:
        return str(response.json()["detail"])
    except (ValueError, KeyError, TypeError):
        return f"HTTP {response.status_code}: {response.text[:200]}"


def settings_of_existing(parsed: Namespace) -> Settings:
    """Settings for a command that reads records; raises `BadConfiguration` without a database.

    Opening a SQLite file that does not exist would create it.
    """
    from service.storage.sql.migrations import require_records

    settings = settings_of(parsed)
    require_records(settings.database)
    return settings


def existing_store(parsed: Namespace) -> "Store":
    """Open the existing database for a command that changes it; see `settings_of_existing`."""
    from service.storage.store import Store

    settings = settings_of_existing(parsed)
    return Store(settings.database, create=False, features_off=settings.features_off)


def period_of(parsed: Namespace) -> "tuple[Utc | None, Utc | None]":
    """Times of `--start` and `--end`; raises `BadInput` if they are out of order."""
    from service.times import parse_utc

    start = None if parsed.start is None else parse_utc(parsed.start, "--start")
    end = None if parsed.end is None else parse_utc(parsed.end, "--end")
    if start is not None and end is not None and start.tai_ns > end.tai_ns:
        raise BadInput(Fault("--end", "must not be before --start", shown_value(parsed.end)))
    return start, end


class SpacecraftName(str):
    """Name of a spacecraft that was given by its mission file, with the path of that file."""

    file: Path


def name_spacecraft(parsed: Namespace) -> None:
    """Replace a mission file given for a spacecraft by the spacecraft's name.

    `settings_of` then adds the mission of that file to the others.  Raises `BadConfiguration` for a
    file with an error.
    """
    from service.missions.mission import read_mission

    for option, value in vars(parsed).items():
        if option != "spacecraft" or value is None:
            continue
        names: list[str] = [value] if isinstance(value, str) else value
        for place, each in enumerate(names):
            if each.endswith(".toml"):
                name = SpacecraftName(read_mission(Path(each)).name)
                name.file = Path(each)
                names[place] = name
        parsed.spacecraft = names[0] if isinstance(value, str) else names


def mission_and_catalog(name: str) -> "tuple[Mission, Catalog]":
    """Mission with a name, and the star catalog chosen in the environment."""
    from service.sky.catalog.star_catalog import open_catalog

    return mission_and_file(name)[0], open_catalog(Settings.from_environment().catalog)


def mission_and_file(text: str) -> "tuple[Mission, Path]":
    """Mission and its file, from a path that ends in `.toml` or a spacecraft's name."""
    from service.missions.mission import mission_files, mission_named, read_mission

    if isinstance(text, SpacecraftName) or text.endswith(".toml"):
        file = text.file if isinstance(text, SpacecraftName) else Path(text)
        return read_mission(file), file
    settings = Settings.from_environment()
    found = mission_files(*settings.mission_places, shipped=settings.ships_missions)
    mission = mission_named({name: each for name, (each, _) in found.items()}, text)
    return mission, found[mission.name][1]


def mission_of_file_or_name(text: str) -> "Mission":
    """Mission from a path that ends in `.toml`, or from a spacecraft's name."""
    return mission_and_file(text)[0]


class Progress:
    """Progress of a command, shown as a bar on a terminal; calling it updates the bar."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar
        self.done = 0

    def __call__(self, done: int, total: int | None = None) -> None:
        """Show the number done and, if known, the total."""
        self._bar.total = total
        self._bar.update(done - self.done)
        self.done = done


@contextmanager
def progress_bar(
    unit: str, title: str, quiet: bool = False, leave: bool = False
) -> Iterator[Progress]:
    """Context manager of a progress bar, shown only on a terminal; with `leave` it stays."""
    from tqdm import tqdm

    disable = True if quiet else None
    with tqdm(total=None, unit=f" {unit}", desc=title, disable=disable, leave=leave) as bar:
        yield Progress(bar)
