"""What can be asked of `acquire`: commands, arguments, and help that shows examples."""

import argparse
import textwrap
from pathlib import Path
from typing import Any, NoReturn

from service import __version__
from service.cli.checks import count, speed
from service.cli.passes import MISSION, add_pass_arguments

LOCAL = "http://127.0.0.1:8000"

CSV_HELP = """\
CSV files have a header and one star a row; consecutive rows of one (spacecraft,
run, batch) are a batch.  Cells may be empty.  The columns, named after the JSON:
  spacecraft batch run time frame aberration options
  q1 q2 q3 qc boresight_ra_deg boresight_dec_deg sun_pointed
  rate_x_deg_per_s rate_y_deg_per_s rate_z_deg_per_s
  velocity_x_km_per_s velocity_y_km_per_s velocity_z_km_per_s
  position_x_km position_y_km position_z_km sun_vector_x sun_vector_y sun_vector_z
  tracker x y z h_deg v_deg magnitude time_offset_s sigma_arcsec
spacecraft, batch, time, tracker and x y z or h_deg v_deg must be there."""


class _Parser(argparse.ArgumentParser):
    """A parser whose complaints fit on one line and point to the help."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"acquire: {message} (see `{self.prog} --help`)\n")


def build_parser() -> argparse.ArgumentParser:
    """The parser of the whole command; `command` names a function of `service.cli.commands`."""
    parser = _command(
        None,
        "acquire",
        "Star identification and attitude: from observed stars to a recorded attitude.",
        """
        acquire demo                                 the whole service at work on sample passes
        acquire serve                                serve on http://127.0.0.1:8000
        acquire replay pass.ndjson --results out.ndjson
        acquire COMMAND --help                       what each command takes
        """,
    )
    parser.add_argument("--version", action="version", version=f"acquire {__version__}")
    commands = parser.add_subparsers(
        title="commands", metavar="COMMAND", required=True, parser_class=_Parser
    )
    _serve(commands)
    _replay(commands)
    _catalog(commands)
    _simulate(commands)
    _database(commands)
    _openapi(commands)
    _demo(commands)
    _command(commands, "version", "Print the version.", "acquire version", "version")
    return parser


def _command(
    parent: Any, name: str, summary: str, examples: str, function: str | None = None
) -> argparse.ArgumentParser:
    lines = [line.strip() for line in examples.strip().splitlines()]
    arguments: dict[str, Any] = {
        "description": textwrap.fill(summary, 79),
        "epilog": "examples:\n" + "\n".join(f"  {line}" for line in lines),
        "formatter_class": argparse.RawDescriptionHelpFormatter,
        "allow_abbrev": False,
    }
    if parent is None:
        return _Parser(prog=name, **arguments)
    made: argparse.ArgumentParser = parent.add_parser(name, help=summary, **arguments)
    made.set_defaults(command=function)
    return made


def _group(parent: Any, name: str, summary: str, examples: str) -> Any:
    made = _command(parent, name, summary, examples)
    return made.add_subparsers(
        title="commands", metavar="COMMAND", required=True, parser_class=_Parser
    )


def _database_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--database",
        metavar="URL",
        help="SQLAlchemy URL of the records; default: ACQUIRE_DATABASE, else sqlite:///acquire.db",
    )


def _serve(commands: Any) -> None:
    parser = _command(
        commands,
        "serve",
        "Serve the API and its page; creates and migrates an SQLite file itself.",
        """
        acquire serve
        acquire serve --port 8100 --database sqlite:///night.db
        """,
        "serve",
    )
    parser.add_argument("--host", help="loopback address; default: ACQUIRE_HOST, else 127.0.0.1")
    parser.add_argument("--port", type=int, help="default: ACQUIRE_PORT, else 8000")
    _database_option(parser)


def _replay(commands: Any) -> None:
    parser = _command(
        commands,
        "replay",
        "Send files of batches (NDJSON, or CSV by the name) through the service.  A second time "
        "adds nothing: what is recorded already is answered from the records.",
        """
        acquire replay pass.ndjson
        acquire replay pass.csv --in-process --run trial --results answers.ndjson
        acquire replay pass.ndjson --speed 60          a minute of telemetry a second
        """,
        "replay",
    )
    parser.epilog = f"{parser.epilog}\n\n{CSV_HELP}"
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="FILE", help=".csv is CSV, else NDJSON"
    )
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--url", default=LOCAL, help=f"the service; default {LOCAL}")
    way.add_argument("--in-process", action="store_true", help="without a server, in this process")
    parser.add_argument(
        "--run", help="the run that takes every batch; default: the first file's stem"
    )
    parser.add_argument(
        "--results", type=Path, metavar="OUT.ndjson", help="one answer a line, in input order"
    )
    parser.add_argument(
        "--speed",
        type=speed,
        default=None,
        metavar="FACTOR|max",
        help="times real time by the batches' own times; default max",
    )
    parser.add_argument(
        "--concurrency", type=count, default=4, metavar="N", help="posts at a time; default 4"
    )
    parser.add_argument(
        "--progress", action="store_true", help="show the bar without a terminal too"
    )
    _database_option(parser)


def _catalog(commands: Any) -> None:
    group = _group(
        commands,
        "catalog",
        "Star catalogs: build the embedded one, import a site's own, export what is used.",
        """
        acquire catalog import skymap.csv skymap.npz
        acquire catalog export --spacecraft XTE --epoch 1996 xte-1996.csv
        """,
    )
    build = _command(
        group,
        "build",
        "Build the embedded catalog from its source packages (in a checkout).",
        """
        acquire catalog build
        acquire catalog build downloads/ stars.npz
        """,
        "catalog_build",
    )
    build.add_argument(
        "packages",
        type=Path,
        nargs="?",
        default=Path("packages"),
        help="folder that holds the source packages; default: ./packages",
    )
    build.add_argument("output", type=Path, nargs="?", help="default: the checkout's own file")
    load = _command(
        group,
        "import",
        "Check a site's own catalog (CSV: id, ra_deg, dec_deg, magnitude) and store it for use.",
        """
        acquire catalog import skymap.csv
        ACQUIRE_CATALOG=skymap.npz acquire serve
        """,
        "catalog_import",
    )
    load.add_argument("file", type=Path, metavar="FILE.csv")
    load.add_argument("output", type=Path, nargs="?", metavar="OUT.npz", help="default: FILE.npz")
    for name, summary, what in (
        ("export", "Write the run catalog of an epoch: exactly what the identifier uses.", "used"),
        (
            "rejected",
            "Write the stars that a run catalog leaves out, with the reasons.",
            "rejected",
        ),
    ):
        parser = _command(
            group,
            name,
            summary,
            f"acquire catalog {name} --spacecraft SOHO --epoch 1996 {what}.csv",
            f"catalog_{name}",
        )
        parser.add_argument("--spacecraft", required=True, metavar="NAME", help=MISSION)
        parser.add_argument(
            "--epoch",
            required=True,
            type=float,
            metavar="YEAR",
            help="rounded as a batch's time is: to the whole year for the shipped missions",
        )
        parser.add_argument("output", type=Path, metavar="OUT.csv")


def _simulate(commands: Any) -> None:
    group = _group(
        commands,
        "simulate",
        "Draw skies whose truth is known.",
        "acquire simulate telemetry --spacecraft XTE --batches 2000 --seed 7 xte.ndjson",
    )
    parser = _command(
        group,
        "telemetry",
        "Draw a pass from the real sky: NDJSON (or CSV by the name), the truth in "
        "OUT.truth.ndjson beside it.  The same arguments always give the same pass.",
        """
        acquire simulate telemetry --spacecraft XTE --batches 2000 --seed 7 xte.ndjson
        acquire simulate telemetry --spacecraft SOHO --batches 300 --seed 1 --nominal soho.csv
        acquire simulate telemetry --spacecraft SWAS --batches 500 --seed 2 --serious swas.ndjson
        acquire simulate telemetry --spacecraft XTE --batches 9 --aberration ignore xte.ndjson
        """,
        "simulate_telemetry",
    )
    add_pass_arguments(parser)
    paper = _command(
        group,
        "paper",
        "Fly the paper's experiments (Fink & Shoup 1994) and print its tables beside ours.",
        """
        acquire simulate paper --table 3 --stars 2000
        acquire simulate paper --json rates.json
        acquire simulate paper --seed 1 2 3 --plots docs/plots --report docs/paper.md
        """,
        "simulate_paper",
    )
    paper.add_argument("--table", type=count, metavar="N", help="2 to 14; default all")
    paper.add_argument("--stars", type=count, metavar="N", help="at least, per run; default 20000")
    paper.add_argument("--seed", type=int, nargs="+", default=[1], metavar="S", help="default 1")
    paper.add_argument("--json", type=Path, metavar="OUT", help="rates of Tables 2 to 10")
    paper.add_argument("--plots", type=Path, metavar="FOLDER", help="the figures")
    paper.add_argument(
        "--report", type=Path, metavar="FILE", help="all of it as a page, instead of printing it"
    )
    paper.add_argument("--processes", type=count, metavar="N", help="default: one a core")


def _database(commands: Any) -> None:
    group = _group(
        commands,
        "database",
        "The schema of the records.",
        """
        acquire database upgrade --database postgresql+psycopg://user@host/attitudes
        acquire database check
        """,
    )
    upgrade = _command(
        group,
        "upgrade",
        "Create what is missing and bring the schema to this version; data is kept.",
        "acquire database upgrade",
        "database_upgrade",
    )
    _database_option(upgrade)
    check = _command(
        group,
        "check",
        "Compare the schema with the code; exit code 1 where they differ.",
        """
        acquire database check
        acquire database check --fresh
        """,
        "database_check",
    )
    check.add_argument(
        "--fresh", action="store_true", help="check the migrations themselves, on an empty database"
    )
    _database_option(check)


def _openapi(commands: Any) -> None:
    parser = _command(
        commands,
        "openapi",
        "Print the API's description (OpenAPI 3.1, YAML).",
        """
        acquire openapi --output openapi.yaml
        acquire openapi --check                        compare with ./openapi.yaml
        """,
        "openapi",
    )
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--output", type=Path, metavar="FILE")
    way.add_argument(
        "--check",
        type=Path,
        nargs="?",
        const=Path("openapi.yaml"),
        metavar="FILE",
        help="exit code 1 where FILE (default openapi.yaml) is not the description",
    )


def _demo(commands: Any) -> None:
    parser = _command(
        commands,
        "demo",
        "Serve, replay sample passes of XTE, SWAS and SOHO through HTTP, print how well the stars "
        "were identified, and keep serving.",
        """
        acquire demo
        acquire demo --batches 1000 --seed 3 --port 8100 --once
        """,
        "demo",
    )
    parser.add_argument("--host", help="loopback address; default 127.0.0.1")
    parser.add_argument("--port", type=int, help="default 8000")
    parser.add_argument(
        "--folder",
        type=Path,
        default=Path("var"),
        help="where samples and records go; default ./var",
    )
    parser.add_argument(
        "--batches", type=count, default=300, metavar="N", help="batches a mission; default 300"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    parser.add_argument("--once", action="store_true", help="stop after the table")
