"""`acquire reprocess`: run recorded batches again into another run, and compare both."""

import sys
from argparse import Namespace
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from service.cli.arguments import (
    add_command,
    add_database,
    add_json,
    add_period,
    count,
    print_json,
)
from service.cli.configuration import period_of, settings_of, settings_of_existing
from service.errors import BadInput, Fault


def add(commands: Any) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "reprocess",
        "Process recorded batches again, on all cores, with the present settings or with a "
        "mission file, and record the results in a separate run; then compare both runs.  After "
        "an interruption, run the same command again to continue.  With SQLite, stop the "
        "service first.",
        """
        acquire reprocess --start 1996-010T00:00:00Z --end 1996-020T00:00:00Z
        acquire reprocess --mission wider.toml --run wider
        acquire reprocess --source pass-7 --spacecraft XTE --run pass-7-again --json
        """,
        run,
    )
    add_period(parser, "the run for the results; default: a name derived from the settings")
    parser.add_argument(
        "--source", metavar="NAME", default="live", help="the run to read; default live"
    )
    parser.add_argument(
        "--spacecraft", metavar="NAME", help="only batches of this spacecraft; default all"
    )
    parser.add_argument(
        "--mission",
        type=Path,
        metavar="FILE.toml",
        help="use this mission file in place of the mission of the same name, and process only "
        "its batches",
    )
    parser.add_argument("--processes", type=count, metavar="N", help="default: one per core")
    add_json(parser, "the comparison")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    add_database(parser)


def run(parsed: Namespace) -> int:
    """Run recorded batches again into another run, and print how both compare."""
    import msgspec
    from tqdm import tqdm

    from service.app.context import checked_run_name
    from service.app.factory import open_app
    from service.cli.run_comparison import comparison_text
    from service.ingest.reprocess import ReprocessProgress, require_other_run
    from service.missions.mission import load_missions, mission_named, read_mission
    from service.storage.sql.served import unserved

    start, end = period_of(parsed)
    mission = None if parsed.mission is None else read_mission(parsed.mission)
    spacecraft = parsed.spacecraft
    if mission is not None:
        spacecraft = spacecraft or mission.name
        if spacecraft != mission.name:
            message = f"is of {mission.name}, and only batches of {spacecraft} are asked for"
            raise BadInput(Fault("--mission", message, str(parsed.mission)))
    elif spacecraft is not None:
        mission_named(load_missions(settings_of(parsed).missions), spacecraft)
    if parsed.run is not None:
        require_other_run(checked_run_name(parsed.run), parsed.source)
    settings = settings_of_existing(parsed)
    with ExitStack() as held:
        held.enter_context(unserved(settings.database))
        app = open_app(settings, mission)
        held.callback(app.close)
        with tqdm(
            total=None, unit=" batches", desc="running again", disable=parsed.quiet or None
        ) as bar:

            def step(progress: ReprocessProgress) -> None:
                bar.total = progress.total
                bar.update(progress.before + progress.recorded + progress.refused - bar.n)

            progress, compared = app.runs.reprocess(
                parsed.run,
                source=parsed.source,
                spacecraft=spacecraft,
                start=start,
                end=end,
                processes=parsed.processes or 0,
                step=step,
            )
    for refusal in progress.refusals:
        print(f"refused: {refusal}", file=sys.stderr)
    if parsed.json:
        counts = {
            name: getattr(progress, name) for name in ("total", "before", "recorded", "refused")
        }
        print_json(counts | msgspec.to_builtins(compared))
    else:
        print(comparison_text(progress, compared))
    return 1 if progress.refused else 0
