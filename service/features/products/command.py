"""Commands `acquire export`, which writes files for other programs, and `acquire score`."""

from argparse import ArgumentParser, Namespace
from dataclasses import asdict
from typing import Any

from service.cli import arguments
from service.cli.arguments import period_of, settings_of_existing
from service.features.products import score
from service.features.products.attitude_formats import attitude_formats, write_attitudes
from service.table_files.formats import TABLE_FORMATS, write_table

TABLES = {
    "batches": (
        "Write the recorded batches of a spacecraft with their quantities, one row per batch."
    ),
    "gyro": "Write the recorded gyro samples of a spacecraft, one row per sample.",
    "stars": "Write the stars of a spacecraft's batches with their outcomes, one row per star.",
}
"""Help texts of the commands that export tables; see `Products.table`."""


def add(commands: Any) -> None:
    """Declare the commands `export` and `score`."""
    group = arguments.add_group(
        commands,
        "export",
        "Write recorded data to files that other programs read.",
        "acquire export attitude --spacecraft XTE --format aem --output xte.aem",
    )
    _add_attitude(group)
    _add_attitude_at(group)
    for kind, summary in TABLES.items():
        _add_table(group, kind, summary)
    score.add(commands)


def _add_attitude(commands: Any) -> None:
    parser = arguments.add_command(
        commands, "attitude", _write_attitude, first="--run --start --end --format --grade --output"
    )
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=arguments.MISSION)
    arguments.add_period(parser, "the run that is read; default live")
    parser.add_argument("--format", choices=tuple(attitude_formats()), default="csv")
    arguments.add_grade(parser)
    _add_status(parser)
    parser.add_argument(
        "--order",
        choices=("oldest", "newest"),
        default="oldest",
        help="which attitudes come first; `newest` only for JSON and tables",
    )
    _add_largest_gap(parser)
    parser.add_argument(
        "--object-id", metavar="ID", help="OBJECT_ID of CCSDS messages; default: the mission's"
    )
    parser.add_argument(
        "--naif-id",
        type=int,
        metavar="ID",
        help="NAIF's id of the spacecraft; default: the mission's",
    )
    arguments.add_output(parser)
    arguments.add_database(parser)


def _add_status(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--status", choices=("good", "suspect", "all"), default="good", help="default good"
    )


def _add_largest_gap(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--largest-gap",
        type=arguments.positive,
        metavar="SECONDS",
        help="attitudes farther apart belong to two stretches; default: the mission's",
    )


def _write_attitude(parsed: Namespace) -> int:
    """Write the attitudes of a spacecraft in any of the formats.

    acquire export attitude --spacecraft XTE --format aem --output xte.aem
    acquire export attitude --spacecraft XTE --run pass-7 --start 1996-010T00:00:00Z
    acquire export attitude --spacecraft XTE --grade smoothed --format acm --output xte.acm
    """
    from service.features.products.part import open_products

    start, end = period_of(parsed)
    overrides = {
        name: value
        for name, value in (
            ("largest_gap_s", parsed.largest_gap),
            ("object_id", parsed.object_id),
            ("naif_id", parsed.naif_id),
        )
        if value is not None
    }
    with open_products(settings_of_existing(parsed)) as products:
        series = products.attitudes(
            parsed.spacecraft,
            run=parsed.run,
            start=start,
            end=end,
            status=parsed.status,
            grade=parsed.grade,
            order=parsed.order,
            most_batches=attitude_formats()[parsed.format].most_batches,
            **overrides,
        )
        arguments.written_to(parsed.output, write_attitudes(parsed.format, series))
    return 0


def _add_attitude_at(commands: Any) -> None:
    parser = arguments.add_command(commands, "attitude-at", _print_attitude_at)
    parser.add_argument("time", metavar="UTC", help="the time")
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=arguments.MISSION)
    parser.add_argument("--run", metavar="NAME", help="the run that is read; default live")
    parser.add_argument(
        "--method",
        choices=("nearest", "interpolated"),
        default="interpolated",
        help="the nearest attitude, or one interpolated within a stretch; default interpolated",
    )
    arguments.add_grade(parser)
    _add_status(parser)
    _add_largest_gap(parser)
    arguments.add_database(parser)


def _print_attitude_at(parsed: Namespace) -> int:
    """Print the attitude of a spacecraft at a given time as JSON, with its covariance.

    acquire export attitude-at 1996-01-10T12:00:00.5Z --spacecraft XTE
    acquire export attitude-at 1996-010T12:00:00Z --spacecraft XTE --method nearest
    acquire export attitude-at 1996-010T12:00:00Z --spacecraft XTE --grade smoothed
    """
    from service.features.products.part import open_products
    from service.times import parse_utc

    moment = parse_utc(parsed.time, "UTC")
    with open_products(settings_of_existing(parsed)) as products:
        found = products.attitude_at(
            parsed.spacecraft,
            moment,
            parsed.method,
            run=parsed.run,
            status=parsed.status,
            grade=parsed.grade,
            largest_gap_s=parsed.largest_gap,
        )
    arguments.print_json(asdict(found))
    return 0


def _add_table(commands: Any, kind: str, summary: str) -> None:
    """Declare `acquire export KIND` for a table; see `Products.table`."""
    parser = arguments.add_command(
        commands,
        kind,
        _write_table,
        summary=f"{summary} Oldest first; units and descriptions are in the metadata of Parquet "
        "files.",
        examples=f"""
        acquire export {kind} --spacecraft XTE --format parquet --output {kind}.parquet
        acquire export {kind} --spacecraft XTE --run pass-7 --start 1996-010T00:00:00Z
        """,
    )
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=arguments.MISSION)
    arguments.add_period(parser, "the run that is read; default live")
    parser.add_argument("--format", choices=tuple(TABLE_FORMATS), default="csv")
    arguments.add_output(parser)
    parser.set_defaults(kind=kind)
    arguments.add_database(parser)


def _write_table(parsed: Namespace) -> int:
    from service.features.products.part import open_products

    start, end = period_of(parsed)
    with open_products(settings_of_existing(parsed)) as products:
        table = products.table(
            parsed.spacecraft,
            parsed.kind,
            run=parsed.run,
            start=start,
            end=end,
            most_batches=TABLE_FORMATS[parsed.format].most_batches,
        )
        arguments.written_to(parsed.output, write_table(parsed.format, table))
    return 0
