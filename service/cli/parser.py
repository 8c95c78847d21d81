"""What can be asked of `acquire`: commands, arguments, and help that shows examples."""

import argparse
import textwrap
from pathlib import Path
from typing import Any, NoReturn

from service import __version__
from service.cli.checks import count, speed, table
from service.cli.frame_arguments import add_frame_command, add_simulated_frames_command
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

PTP_HELP = """\
tables by name, each algorithm on the same fields (10 deg square, stars to V 6):
  ptp-5       slave stars of the guide database: memory, rate, time
  ptp-6       PTP, P-vector, planar triangle, Liebe's triangles, pyramid at 1 px, 0.5 mag
  figure-10   stars in the field of view; the paper's cannot be had from the sky
  figure-11   rate against the stars in the field
  figure-12   rate against the noise of position
  figure-13   rate against the noise of magnitude
  ptp         all of these
strict: every star that the algorithm names is right, three at least; checked: the
same behind the attitude check of the identifier `ptp`."""


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
    _advise(commands)
    _reprocess(commands)
    add_frame_command(commands, _command, _database_option)
    _catalog(commands)
    _simulate(commands)
    _database(commands)
    _token(commands)
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
        acquire replay pass.ndjson --alarms            and watch it as live batches are
        acquire replay pass.ndjson --speed 60          a minute of telemetry a second
        acquire replay pass.ndjson --carry-attitude    each attitude is the next batch's a priori
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
        "--alarms", action="store_true", help="hold the spacecraft's limits against the run"
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
        "--concurrency",
        type=count,
        metavar="N",
        help="post batch by batch, so many at a time; so are --results (default 4) and --speed. "
        "Without any of these the service takes the files as a whole, which is faster",
    )
    parser.add_argument(
        "--carry-attitude",
        action="store_true",
        help="write the last good attitude of the same spacecraft, turned with the body rates, "
        "into each batch's a_priori before it is sent; one batch at a time",
    )
    parser.add_argument(
        "--progress", action="store_true", help="show the bar without a terminal too"
    )
    _database_option(parser)


def _stretch(parser: argparse.ArgumentParser, run_help: str) -> None:
    parser.add_argument("--run", metavar="NAME", help=run_help)
    parser.add_argument(
        "--from", dest="start", metavar="UTC", help="the first batch time, itself included"
    )
    parser.add_argument(
        "--to", dest="end", metavar="UTC", help="the last batch time, itself excluded"
    )


def _advise(commands: Any) -> None:
    parser = _command(
        commands,
        "advise",
        "Say what recorded batches tell of a mission's settings: tolerances that are too tight "
        "or too wide, the trackers' noise, magnitudes and alignment, what other settings would "
        "have come to, and the lines to change in the mission file.  Nothing is changed.",
        """
        acquire advise --spacecraft XTE
        acquire advise --spacecraft XTE --from 1996-010T00:00:00Z --to 1996-020T00:00:00Z
        acquire advise --spacecraft SOHO --run pass-7 --sample 2000 --try separation_deg=0.01
        """,
        "advise",
    )
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=MISSION)
    _stretch(parser, "the run whose batches are looked at; default live")
    parser.add_argument(
        "--sample",
        type=count,
        default=500,
        metavar="N",
        help="the most batches that are run again, drawn over the whole range; default 500",
    )
    parser.add_argument(
        "--try",
        dest="tolerance",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a tolerance to be tried as well; may be given several times, for all together",
    )
    parser.add_argument("--json", action="store_true", help="as the API answers it")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    _database_option(parser)


def _reprocess(commands: Any) -> None:
    parser = _command(
        commands,
        "reprocess",
        "Run recorded batches again, over all cores, with the settings as they are now or with a "
        "mission file, into a run of their own; then compare both runs.  Stopped, it goes on when "
        "the same is asked again.  On SQLite, stop the service first.",
        """
        acquire reprocess --from 1996-010T00:00:00Z --to 1996-020T00:00:00Z
        acquire reprocess --mission wider.toml --run wider
        acquire reprocess --source pass-7 --spacecraft XTE --run pass-7-again --json
        """,
        "reprocess",
    )
    _stretch(parser, "the run that takes the results; default: a name that tells the settings")
    parser.add_argument(
        "--source", metavar="NAME", default="live", help="the run that is read; default live"
    )
    parser.add_argument("--spacecraft", metavar="NAME", help="only its batches; default all")
    parser.add_argument(
        "--mission",
        type=Path,
        metavar="FILE.toml",
        help="a mission file to use in the place of the one of that name, for its batches alone",
    )
    parser.add_argument("--processes", type=count, metavar="N", help="default: one a core")
    parser.add_argument("--json", action="store_true", help="print the comparison as JSON")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
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
        "Check a site's own catalog and store it for use: CSV (id, ra_deg, dec_deg, magnitude), or "
        "SKYMAP's SKY2000 fixed-width records (CDS V/109), whose numbers stay the stars' ids.",
        """
        acquire catalog import skymap.csv
        acquire catalog import sky2kv4.dat.gz skymap.npz
        ACQUIRE_CATALOG=skymap.npz acquire serve
        """,
        "catalog_import",
    )
    load.add_argument("file", type=Path, metavar="FILE", help="SKY2000 may be compressed by gzip")
    load.add_argument(
        "output", type=Path, nargs="?", metavar="OUT.npz", help="default: FILE's name with .npz"
    )
    load.add_argument(
        "--format", choices=("csv", "sky2000"), help="default: what the file's beginning tells"
    )
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
    add_simulated_frames_command(group, _command)
    paper = _command(
        group,
        "paper",
        "Fly the experiments of a paper and print its tables beside ours: those of Fink & Shoup "
        "1994 by number, those of Zhou & Ye 2015 (PTP, lost in space) by name.",
        """
        acquire simulate paper --table 3 --stars 2000
        acquire simulate paper --table ptp-6 --scenes 2000 --seed 7
        acquire simulate paper --table ptp --plots docs/plots --report docs/ptp.md
        acquire simulate paper --json rates.json
        acquire simulate paper --identifier starid --seed 1 2 3 --plots docs/plots --report paper.md
        acquire simulate paper --identifier verified --report verified.md
        """,
        "simulate_paper",
    )
    paper.epilog = f"{paper.epilog}\n\n{PTP_HELP}"
    paper.add_argument(
        "--table", type=table, metavar="N|NAME", help="2 to 14 (default all of these), or a name"
    )
    paper.add_argument("--stars", type=count, metavar="N", help="at least, per run; default 20000")
    paper.add_argument(
        "--scenes", type=count, metavar="N", help="named tables: fields a condition; default 10000"
    )
    paper.add_argument("--seed", type=int, nargs="+", default=[1], metavar="S", help="default 1")
    paper.add_argument("--json", type=Path, metavar="OUT", help="the rates, one row a run")
    paper.add_argument("--plots", type=Path, metavar="FOLDER", help="the figures")
    paper.add_argument(
        "--report", type=Path, metavar="FILE", help="all of it as a page, instead of printing it"
    )
    paper.add_argument(
        "--identifier",
        choices=("starid", "verified"),
        nargs="+",
        default=["starid", "verified"],
        metavar="NAME",
        help="the paper's votes starid, or verified; default both",
    )
    paper.add_argument("--processes", type=count, metavar="N", help="default: one a core")
    imaging = _command(
        group,
        "imaging",
        "Hold every claim of the star image detection report beside what is measured here: crosses "
        "of wire meshes, correlation, estimation, scans and their noise, pattern constants.",
        """
        acquire simulate imaging --row IM-4
        acquire simulate imaging --seed 7 --json claims.json
        acquire simulate imaging --plots docs/plots --report docs/imaging.md
        """,
        "simulate_imaging",
    )
    imaging.add_argument(
        "--row", nargs="+", default=[], metavar="IM-N", help="IM-1 to IM-11; default all"
    )
    imaging.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    imaging.add_argument("--quick", action="store_true", help="small samples and coarser grids")
    imaging.add_argument("--json", type=Path, metavar="OUT", help="the claims with their figures")
    imaging.add_argument("--plots", type=Path, metavar="FOLDER", help="the figures (matplotlib)")
    imaging.add_argument(
        "--report", type=Path, metavar="FILE", help="all of it as a page, instead of printing it"
    )


def _database(commands: Any) -> None:
    group = _group(
        commands,
        "database",
        "The records as a whole: their schema, copies, whether all is there, and old ones out.",
        """
        acquire database upgrade --database postgresql+psycopg://user@host/attitudes
        acquire database backup night.db
        acquire database verify
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
    backup = _command(
        group,
        "backup",
        "Copy the whole database as it is at this moment, while it is being served: SQLite into a "
        "file of its own, PostgreSQL into what pg_restore reads.",
        """
        acquire database backup night.db
        acquire database backup night.dump --database postgresql://user@host/attitudes
        """,
        "database_backup",
    )
    backup.add_argument("output", type=Path, metavar="FILE", help="must not be there yet")
    _database_option(backup)
    verify = _command(
        group,
        "verify",
        "Read everything and tell what is wrong: the file, the schema, every batch with its "
        "results, the trends; exit code 1 where anything is.  Nothing is changed.",
        """
        acquire database verify
        acquire database verify --database sqlite:///night.db
        """,
        "database_verify",
    )
    _database_option(verify)
    prune = _command(
        group,
        "prune",
        "Delete the batches before a time, with all that was made of them and their part in the "
        "trends, while the database is being served.  What is gone is gone: back up first.",
        """
        acquire database prune --before 1996-01-01T00:00:00Z --dry-run
        acquire database prune --before 1996-001T00:00:00Z --run pass-7
        """,
        "database_prune",
    )
    prune.add_argument("--before", required=True, metavar="UTC", help="batch time, itself excluded")
    prune.add_argument("--run", metavar="NAME", help="of this run alone; default: of every run")
    prune.add_argument("--dry-run", action="store_true", help="only tell how many there are")
    _database_option(prune)


def _token(commands: Any) -> None:
    group = _group(
        commands,
        "token",
        "Who may ask: tokens for programs and people.  Until the first one is made, access on "
        "this machine is open; from then on everything but /livez and /readyz asks for one.",
        """
        acquire token create pipeline --scope submit --spacecraft XTE
        acquire token create "J. Operator" --scope read --scope operate --days 30
        acquire token list
        acquire token revoke pipeline
        """,
    )
    create = _command(
        group,
        "create",
        "Make a token and print it, once: of it the database keeps only a digest.  Its name signs "
        "what is done with it.",
        """
        acquire token create pipeline --scope submit --spacecraft XTE
        ACQUIRE_TOKEN=acq_... acquire replay pass.ndjson
        curl -H "Authorization: Bearer acq_..." http://127.0.0.1:8000/api/v1/spacecraft
        """,
        "token_create",
    )
    create.add_argument("name", metavar="NAME", help="a program's or a person's")
    create.add_argument(
        "--scope",
        action="append",
        required=True,
        choices=("read", "submit", "operate"),
        help="read: look at everything; submit: send batches; operate: change limits, acknowledge "
        "alarms, keep what-ifs, drop zones.  May be given several times",
    )
    create.add_argument(
        "--spacecraft", action="append", metavar="NAME", help="only about this one; may be repeated"
    )
    create.add_argument(
        "--days", type=count, default=365, metavar="N", help="how long it holds; default 365"
    )
    create.add_argument(
        "--rate", type=float, metavar="N", help="requests a second at most; default no bound"
    )
    _database_option(create)
    listed = _command(
        group, "list", "Show every token, without its secret.", "acquire token list", "token_list"
    )
    _database_option(listed)
    revoke = _command(
        group,
        "revoke",
        "End a token, and the browser sessions begun with it, within a second.",
        "acquire token revoke pipeline",
        "token_revoke",
    )
    revoke.add_argument("name", metavar="NAME")
    _database_option(revoke)


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
