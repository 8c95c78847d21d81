"""`acquire simulate paper`: the experiments of the papers beside their tables."""

import io
from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli.arguments import (
    STANDARD_OUTPUT,
    add_command,
    add_json_file,
    count,
    print_json,
    table,
)
from service.errors import BadInput, Fault, shown_value
from service.missions.identifiers import IDENTIFIERS

IN_ZONES = [name for name, entry in IDENTIFIERS.items() if entry.searches_zone]
"""The identifiers that search a zone, as the paper's does."""

PTP_HELP = """\
tables by name, each algorithm on the same fields (10 deg square, stars to V 6):
  ptp-1       projections of the nine printed triangles
  ptp-2       the k-vector of the projections
  ptp-3       the sharing stars of the four printed triangles
  figure-6    triangles on the projection axis
  figure-7    projection and index of the triangles
  ptp-5       slave stars of the guide database: memory, rate, time
  ptp-6       PTP, P-vector, planar triangle, Liebe's triangles, pyramid at 1 px, 0.5 mag
  figure-10   stars in the field of view; the paper's figure cannot be reproduced
  figure-11   rate against the stars in the field
  figure-12   rate against the noise of position
  figure-13   rate against the noise of magnitude
  ptp-false   mirrored skies and random points that PTP accepts
  ptp         all of these
strict: all stars that the algorithm names are correct, at least three; checked: the
same after the attitude check of the identifier `ptp`."""


def add(group: Any) -> None:
    """Declare the command."""
    parser = add_command(
        group,
        "paper",
        "Repeat the experiments of a paper and compare its tables with our results: Fink & "
        "Shoup 1994 by table number, Zhou & Ye 2015 (PTP, lost in space) by table name.",
        """
        acquire simulate paper --table 3 --stars 2000
        acquire simulate paper --table ptp-6 --scenes 2000 --seed 7
        acquire simulate paper --table ptp --plots docs/plots --report docs/ptp.md
        acquire simulate paper --json rates.json
        acquire simulate paper --table 3 --stars 2000 --json
        acquire simulate paper --identifier starid --seed 1 2 3 --plots docs/plots --report paper.md
        acquire simulate paper --identifier verified --report verified.md
        """,
        run,
        PTP_HELP,
    )
    parser.add_argument(
        "--table", type=table, metavar="N|NAME", help="2 to 14 (default: all of these), or a name"
    )
    parser.add_argument(
        "--stars", type=count, metavar="N", help="minimum number of stars per run; default 20000"
    )
    parser.add_argument(
        "--scenes",
        type=count,
        metavar="N",
        help="named tables: fields per condition; default 10000",
    )
    parser.add_argument("--seed", type=int, nargs="+", metavar="S", help="default 1")
    add_json_file(parser, "the rates, one row per run,")
    parser.add_argument("--plots", type=Path, metavar="FOLDER", help="write the figures")
    parser.add_argument(
        "--report",
        type=Path,
        metavar="FILE",
        help="write everything to a page instead of printing it",
    )
    parser.add_argument(
        "--identifier",
        choices=IN_ZONES,
        nargs="+",
        default=IN_ZONES,
        metavar="NAME",
        help=f"{', '.join(IN_ZONES)}; default all of these",
    )
    parser.add_argument("--processes", type=count, metavar="N", help="default: one per core")


def run(parsed: Namespace) -> int:
    """Fly the experiments of a paper and print its tables."""
    if isinstance(parsed.table, str):
        return _run_ptp(parsed)
    if parsed.scenes is not None:
        raise BadInput(
            Fault(
                "--scenes", "goes with a table by name, such as --table ptp-6", str(parsed.scenes)
            )
        )
    from studies.paper_1994.command import DEFAULT_STARS, run_paper
    from studies.paper_1994.report import PROPORTIONS, TIMES

    if parsed.stars is not None and parsed.table in (*TIMES, *PROPORTIONS):
        message = f"has no effect on table {parsed.table}, whose zones are as many as the paper's"
        raise BadInput(Fault("--stars", message, str(parsed.stars)))
    prints_json = parsed.json == STANDARD_OUTPUT
    rows = run_paper(
        parsed.table,
        parsed.stars or DEFAULT_STARS,
        parsed.seed or [1],
        None if prints_json else parsed.json,
        parsed.identifier,
        processes=parsed.processes,
        plots=parsed.plots,
        report_path=parsed.report,
        out=io.StringIO() if prints_json else None,
    )
    if prints_json:
        print_json(rows)
    return 0


def _run_ptp(parsed: Namespace) -> int:
    from studies.ptp_2015.command import DEFAULT_SCENES, rows_of, run_ptp
    from studies.ptp_2015.tables import OF_PROJECTIONS

    if parsed.stars is not None:
        message = "goes with a table by number; a named one takes --scenes"
        raise BadInput(Fault("--stars", message, str(parsed.stars)))
    if parsed.table in OF_PROJECTIONS:
        message = f"has no effect on {parsed.table}, for which nothing is drawn"
        for option, value in (("--scenes", parsed.scenes), ("--seed", parsed.seed)):
            if value is not None:
                raise BadInput(Fault(option, message, shown_value(value)))
    seeds = parsed.seed or [1]
    if len(seeds) > 1:
        raise BadInput(Fault("--seed", "is one with a table by name", shown_value(seeds)))
    prints_json = parsed.json == STANDARD_OUTPUT
    found = run_ptp(
        parsed.table,
        parsed.scenes or DEFAULT_SCENES,
        seeds[0],
        None if prints_json else parsed.json,
        parsed.processes,
        parsed.plots,
        parsed.report,
        io.StringIO() if prints_json else None,
    )
    if prints_json:
        print_json(rows_of(found))
    return 0
