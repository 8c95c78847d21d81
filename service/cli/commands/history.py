"""Command `acquire history`: quantities of recorded batches as a table."""

import json
from argparse import Namespace
from collections.abc import Iterator
from contextlib import closing
from typing import Any

from service.cli import arguments
from service.cli.arguments import period_of, settings_of_existing
from service.table_files.formats import TABLE_FORMATS, write_table
from service.table_files.table import Table


def add(commands: Any) -> None:
    """Declare the command `history`."""
    parser = arguments.add_command(commands, "history", run)
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=arguments.MISSION)
    arguments.add_period(parser, "the run that is read; default live")
    way = parser.add_mutually_exclusive_group()
    way.add_argument("--format", choices=tuple(TABLE_FORMATS), default="csv", help="default csv")
    way.add_argument("--json", action="store_true", help="write one JSON object per line")
    arguments.add_output(parser)
    arguments.add_database(parser)


def run(parsed: Namespace) -> int:
    """Write the quantities of every recorded batch of a spacecraft, one row per batch.

    acquire history --spacecraft XTE --format csv
    acquire history --spacecraft XTE --run pass-7 --start 1996-010T00:00:00Z
    """
    from service.app.factory import open_app
    from service.app.fleet import batch_table

    start, end = period_of(parsed)
    with closing(open_app(settings_of_existing(parsed), reads_only=True)) as app:
        pages = app.spacecraft.every_batch(parsed.spacecraft, run=parsed.run, start=start, end=end)
        table = batch_table(pages)
        arguments.written_to(
            parsed.output, _lines(table) if parsed.json else write_table(parsed.format, table)
        )
    return 0


def _lines(table: Table) -> Iterator[bytes]:
    for page in table.pages:
        for row in zip(*page, strict=True):
            yield f"{json.dumps(dict(zip(table.names, row, strict=True)))}\n".encode()
