"""`acquire export attitude-at`: the attitude at a moment."""

from argparse import Namespace
from dataclasses import asdict
from typing import Any

from service.cli.arguments import (
    MISSION,
    add_command,
    add_database,
    add_grade,
    positive,
    print_json,
)
from service.cli.configuration import settings_of_existing


def add(commands: Any) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "attitude-at",
        "Print the attitude of a spacecraft at a given time as JSON, with its covariance.",
        """
        acquire export attitude-at 1996-01-10T12:00:00.5Z --spacecraft XTE
        acquire export attitude-at 1996-010T12:00:00Z --spacecraft XTE --method nearest
        acquire export attitude-at 1996-010T12:00:00Z --spacecraft XTE --grade smoothed
        """,
        run,
    )
    parser.add_argument("time", metavar="UTC", help="the time")
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=MISSION)
    parser.add_argument("--run", metavar="NAME", help="the run that is read; default live")
    parser.add_argument(
        "--method",
        choices=("nearest", "interpolated"),
        default="interpolated",
        help="the nearest attitude, or one interpolated within a stretch; default interpolated",
    )
    add_grade(parser)
    parser.add_argument(
        "--status", choices=("good", "suspect", "all"), default="good", help="default good"
    )
    parser.add_argument(
        "--largest-gap",
        type=positive,
        metavar="SECONDS",
        help="attitudes farther apart belong to two stretches; default: the mission's",
    )
    add_database(parser)


def run(parsed: Namespace) -> int:
    """Print the attitude."""
    from service.app.products import open_products
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
    print_json(asdict(found))
    return 0
