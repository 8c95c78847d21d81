"""The commands that export recorded results as tables."""

from argparse import Namespace
from typing import Any

from service.cli.arguments import MISSION, add_command, add_database, add_output, add_period
from service.cli.configuration import period_of, settings_of_existing
from service.cli.output import written_to
from service.products.formats import table_formats, write_table


def add_table_export(commands: Any, kind: str, summary: str) -> None:
    """Declare `acquire export KIND`; see `app.products.table`."""
    parser = add_command(
        commands,
        kind,
        f"{summary} Oldest first; units and descriptions are in the metadata of Parquet files.",
        f"""
        acquire export {kind} --spacecraft XTE --format parquet --output {kind}.parquet
        acquire export {kind} --spacecraft XTE --run pass-7 --start 1996-010T00:00:00Z
        """,
        _run,
    )
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=MISSION)
    add_period(parser, "the run that is read; default live")
    parser.add_argument("--format", choices=tuple(table_formats()), default="csv")
    add_output(parser)
    parser.set_defaults(kind=kind)
    add_database(parser)


def _run(parsed: Namespace) -> int:
    from service.app.products import open_products

    start, end = period_of(parsed)
    with open_products(settings_of_existing(parsed)) as products:
        table = products.table(
            parsed.spacecraft,
            parsed.kind,
            run=parsed.run,
            start=start,
            end=end,
            most_batches=table_formats()[parsed.format].most_batches,
        )
        written_to(parsed.output, write_table(parsed.format, table))
    return 0
