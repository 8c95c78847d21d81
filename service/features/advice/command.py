"""Command `acquire advise`: recommended settings of a mission from its recorded batches."""

from argparse import Namespace
from contextlib import closing
from typing import Any

from service.cli import arguments
from service.cli.arguments import period_of, progress_bar, settings_of_existing


def add(commands: Any) -> None:
    """Declare the command `advise` and its options."""
    parser = arguments.add_command(commands, "advise", run, first="--run --try")
    parser.add_argument("--spacecraft", required=True, metavar="NAME", help=arguments.MISSION)
    arguments.add_period(parser, "the run to examine; default live")
    parser.add_argument(
        "--sample",
        type=arguments.count,
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
    arguments.add_json(parser, "the answer of the API")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    arguments.add_database(parser)


def run(parsed: Namespace) -> int:
    """Recommend settings of a mission from recorded batches: the size of its zone, tolerances that
    are too tight or too wide, the trackers' noise, magnitudes and alignment, the outcomes with
    other settings, and the lines to change in the mission file.  Changes nothing.

    acquire advise --spacecraft XTE
    acquire advise --spacecraft XTE --start 1996-010T00:00:00Z --end 1996-020T00:00:00Z
    acquire advise --spacecraft SOHO --run pass-7 --sample 2000 --try separation_deg=0.01
    """
    import msgspec

    from service.app.factory import open_app
    from service.features.advice.part import AdviceService
    from service.features.advice.text import advice_text
    from service.observations.schema import tolerances_from_text

    start, end = period_of(parsed)
    tolerances = tolerances_from_text(parsed.tolerance, "--try")
    with (
        closing(open_app(settings_of_existing(parsed), reads_only=True)) as app,
        progress_bar("batches", "running again", parsed.quiet, leave=True) as bar,
    ):
        advice = app.part(AdviceService).of_spacecraft(
            parsed.spacecraft,
            run=parsed.run,
            start=start,
            end=end,
            sample=parsed.sample,
            tolerances=tolerances,
            step=lambda: bar(bar.done + 1),
        )
    if parsed.json:
        arguments.print_json(msgspec.to_builtins(advice))
    else:
        print(advice_text(advice))
    return 0
