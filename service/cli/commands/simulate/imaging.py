"""`acquire simulate imaging`: the claims of the star image detection report."""

import io
from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli.arguments import STANDARD_OUTPUT, add_command, add_json_file


def add(group: Any) -> None:
    """Declare the command."""
    parser = add_command(
        group,
        "imaging",
        "Compare every claim of the star image detection report with a measurement: crosses of "
        "wire meshes, correlation, estimation, scans and their noise, pattern constants.",
        """
        acquire simulate imaging --row IM-4
        acquire simulate imaging --seed 7 --json claims.json
        acquire simulate imaging --plots docs/plots --report docs/imaging.md
        """,
        run,
    )
    parser.add_argument(
        "--row", nargs="+", default=[], metavar="IM-N", help="IM-1 to IM-11; default all"
    )
    parser.add_argument("--seed", type=int, default=1, metavar="S", help="default 1")
    parser.add_argument("--quick", action="store_true", help="small samples and coarser grids")
    add_json_file(parser, "the claims with their figures")
    parser.add_argument(
        "--plots", type=Path, metavar="FOLDER", help="write the figures (needs matplotlib)"
    )
    parser.add_argument(
        "--report",
        type=Path,
        metavar="FILE",
        help="write everything to a page instead of printing it",
    )


def run(parsed: Namespace) -> int:
    """Hold the star image detection report beside what is measured; 1 where a claim is off."""
    from studies.star_image_report.command import as_json, run_imaging

    prints_json = parsed.json == STANDARD_OUTPUT
    rows = run_imaging(
        parsed.row,
        parsed.seed,
        parsed.quick,
        json_path=None if prints_json else parsed.json,
        plots_folder=parsed.plots,
        report_path=parsed.report,
        out=io.StringIO() if prints_json else None,
    )
    if prints_json:
        print(as_json(rows), end="")
    return 0 if all(row.holds for row in rows) else 1
