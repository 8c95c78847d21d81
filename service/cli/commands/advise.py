"""`acquire advise`: what recorded batches say of a mission's settings."""

from argparse import Namespace
from typing import Any

from service.cli.arguments import (
    MISSION,
    add_command,
    add_database,
    add_json,
    add_period,
    count,
    print_json,
)
from service.cli.configuration import period_of, settings_of_existing


def add(commands: Any) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "advise",
        "Recommend settings of a mission from recorded batches: the size of its zone, tolerances "
        "that are too tight or too wide, the trackers' noise, magnitudes and alignment, the "
        "outcomes with other settings, and the lines to change in the mission file.  Changes "
        "nothing.",
        """
        acquire advise --spacecraft XTE
        acquire advise --spacecraft XTE --start 1996-010T00:00:00Z --end 1996-020T00:00:00Z
        acquire advise --spacecraft SOHO --run pass-7 --sample 2000 --try separation_deg=0.01
        """,
        run,
    )
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=MISSION)
    add_period(parser, "the run to examine; default live")
    parser.add_argument(
        "--sample",
        type=count,
        default=500,
        metavar="N",
        help="maximum number of batches to process again, taken from the whole period; default 500",
    )
    parser.add_argument(
        "--try",
        dest="tolerance",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="try this tolerance too; may be repeated, to try several together",
    )
    add_json(parser, "the answer of the API")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    add_database(parser)


def run(parsed: Namespace) -> int:
    """Print what recorded batches say of a mission's settings."""
    import msgspec
    from tqdm import tqdm

    from service.app.factory import open_app
    from service.cli.texts import advice_text
    from service.observations.schema import tolerances_from_text

    start, end = period_of(parsed)
    tolerances = tolerances_from_text(parsed.tolerance, "--try")
    app = open_app(settings_of_existing(parsed), reads_only=True)
    try:
        with tqdm(
            total=None, unit=" batches", desc="running again", disable=parsed.quiet or None
        ) as bar:
            advice = app.advice.of_spacecraft(
                parsed.spacecraft,
                run=parsed.run,
                start=start,
                end=end,
                sample=parsed.sample,
                tolerances=tolerances,
                step=bar.update,
            )
    finally:
        app.close()
    if parsed.json:
        print_json(msgspec.to_builtins(advice))
    else:
        print(advice_text(advice))
    return 0
