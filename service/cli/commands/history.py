"""`acquire history`: the quantities of recorded batches as a table."""

import sys
from argparse import Namespace
from typing import Any

from service.app.output_formats import OUTPUT_FORMATS
from service.cli.arguments import MISSION, add_command, add_database, add_period
from service.cli.configuration import period_of, settings_of_existing


def add(commands: Any) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "history",
        "Print the quantities of every recorded batch of a spacecraft, a row a batch.",
        """
        acquire history --spacecraft XTE --format csv
        acquire history --spacecraft XTE --run pass-7 --from 1996-010T00:00:00Z
        """,
        run,
    )
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=MISSION)
    add_period(parser, "the run that is read; default live")
    parser.add_argument(
        "--format", choices=tuple(OUTPUT_FORMATS), default="csv", help="default csv"
    )
    add_database(parser)


def run(parsed: Namespace) -> int:
    """Write the table to the standard output, page by page."""
    from service.app.factory import open_app
    from service.app.history_table import batch_table

    start, end = period_of(parsed)
    app = open_app(settings_of_existing(parsed))
    try:
        pages = app.spacecraft.every_batch(parsed.spacecraft, run=parsed.run, start=start, end=end)
        table = batch_table(pages)
        for text in OUTPUT_FORMATS[parsed.format].write(table.columns, table.pages):
            sys.stdout.write(text)
    finally:
        app.close()
    return 0
