"""`acquire export attitude`: attitudes in the formats of flight dynamics, or as a table."""

from argparse import Namespace
from typing import Any

from service.cli.arguments import (
    MISSION,
    add_command,
    add_database,
    add_grade,
    add_output,
    add_period,
    positive,
)
from service.cli.configuration import period_of, settings_of_existing
from service.cli.output import written_to
from service.products.formats import attitude_formats, write_attitudes


def add(commands: Any) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "attitude",
        "Write the attitudes of a spacecraft in any of the formats.",
        """
        acquire export attitude --spacecraft XTE --format aem --output xte.aem
        acquire export attitude --spacecraft XTE --run pass-7 --start 1996-010T00:00:00Z
        acquire export attitude --spacecraft XTE --grade smoothed --format acm --output xte.acm
        """,
        run,
    )
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=MISSION)
    add_period(parser, "the run that is read; default live")
    parser.add_argument("--format", choices=tuple(attitude_formats()), default="csv")
    add_grade(parser)
    parser.add_argument(
        "--status", choices=("good", "suspect", "all"), default="good", help="default good"
    )
    parser.add_argument(
        "--order",
        choices=("oldest", "newest"),
        default="oldest",
        help="which attitudes come first; `newest` only for JSON and tables",
    )
    parser.add_argument(
        "--largest-gap",
        type=positive,
        metavar="SECONDS",
        help="attitudes farther apart belong to two stretches; default: the mission's",
    )
    parser.add_argument(
        "--object-id", metavar="ID", help="OBJECT_ID of CCSDS messages; default: the mission's"
    )
    parser.add_argument(
        "--naif-id",
        type=int,
        metavar="ID",
        help="NAIF's id of the spacecraft; default: the mission's",
    )
    add_output(parser)
    add_database(parser)


def run(parsed: Namespace) -> int:
    """Write the attitudes, as they are read."""
    from service.app.products import open_products

    start, end = period_of(parsed)
    given = {
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
            **given,
        )
        written_to(parsed.output, write_attitudes(parsed.format, series))
    return 0
