"""Command `acquire reprocess`: process recorded batches again into another run, and compare."""

import sys
from argparse import Namespace
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli import arguments
from service.cli.arguments import period_of, settings_of_existing
from service.errors import BadInput, Fault

if TYPE_CHECKING:
    from collections.abc import Callable

    from service.app.factory import App
    from service.ingest.reprocess import ReprocessProgress
    from service.missions.mission import Mission


def add(commands: Any) -> None:
    """Declare the command `reprocess`."""
    parser = arguments.add_command(
        commands, "reprocess", run, first="--spacecraft --source --run --mission"
    )
    arguments.add_period(
        parser, "the run for the results; default: a name derived from the settings"
    )
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
    parser.add_argument(
        "--processes", type=arguments.count, metavar="N", help="default: one per core"
    )
    parser.add_argument(
        "--track",
        action="store_true",
        help="search each batch about the attitude that is predicted from the last good one of "
        "the results, one batch after another",
    )
    parser.add_argument("--no-comparison", action="store_true", help="do not compare both runs")
    arguments.add_json(parser, "the comparison")
    parser.add_argument("--quiet", action="store_true", help="no progress bar")
    arguments.add_database(parser)


def run(parsed: Namespace) -> int:
    """Process recorded batches again, on all cores, with the present settings or with a mission
    file, and record the results in a separate run; then compare both runs.  After an
    interruption, run the same command again to continue.  With SQLite, stop the service first.

    acquire reprocess --start 1996-010T00:00:00Z --end 1996-020T00:00:00Z
    acquire reprocess --mission wider.toml --run wider
    acquire reprocess --spacecraft XTE --run xte-tracked --track
    acquire reprocess --source pass-7 --spacecraft XTE --run pass-7-again --json
    """
    if parsed.track and parsed.processes is not None:
        message = "leave it out with --track, which computes one batch after another"
        raise BadInput(Fault("--processes", message))

    def process(app: "App", **asked: Any) -> "ReprocessProgress":
        return app.runs.reprocess(parsed.run, track=parsed.track, **asked)

    return process_again(parsed, process)


def process_again(
    parsed: Namespace, process: "Callable[..., ReprocessProgress]", **settings: Any
) -> int:
    """Let `process` process the batches of the options again, compare, and print; the exit code.

    `process` gets the app, `source`, `spacecraft`, `start`, `end`, `processes` and `step`.
    `settings` replace those of the environment.
    """
    import dataclasses

    import msgspec
    from tqdm import tqdm

    from service.app.context import checked_run_name
    from service.app.factory import open_app
    from service.cli.texts import comparison_text, progress_text
    from service.ingest.reprocess import require_other_run

    start, end = period_of(parsed)
    mission, spacecraft = _chosen(parsed)
    if parsed.run is not None:
        require_other_run(checked_run_name(parsed.run), parsed.source)
    used = dataclasses.replace(settings_of_existing(parsed), **settings)
    with closing(open_app(used, mission)) as app:
        with tqdm(
            total=None, unit=" batches", desc="running again", disable=parsed.quiet or None
        ) as bar:

            def step(progress: "ReprocessProgress") -> None:
                bar.total = progress.total
                if progress.partitions:
                    done = f"{progress.partitions_done} of {progress.partitions} partitions"
                    bar.set_postfix_str(done, refresh=False)
                bar.update(progress.before + progress.recorded + progress.refused - bar.n)

            progress = process(
                app,
                source=parsed.source,
                spacecraft=spacecraft,
                start=start,
                end=end,
                processes=parsed.processes or 0,
                step=step,
            )
        compared = None
        if not parsed.no_comparison:
            compared = app.runs.compare(parsed.source, progress.run, spacecraft, start, end)
    for refusal in progress.refusals:
        print(f"refused: {refusal}", file=sys.stderr)
    if parsed.json:
        counts = {
            name: getattr(progress, name) for name in ("total", "before", "recorded", "refused")
        }
        arguments.print_json(counts | ({} if compared is None else msgspec.to_builtins(compared)))
    else:
        print(progress_text(progress))
        if compared is not None:
            print(comparison_text(compared))
    return 1 if progress.refused else 0


def _chosen(parsed: Namespace) -> "tuple[Mission | None, str | None]":
    """Mission of `--mission`, and the spacecraft whose batches are processed; None: any."""
    from service.missions.mission import read_mission

    spacecraft: str | None = parsed.spacecraft
    if parsed.mission is None:
        if spacecraft is not None:
            arguments.mission_and_file(spacecraft)
        return None, spacecraft
    mission = read_mission(parsed.mission)
    if spacecraft not in (None, mission.name):
        message = f"is of {mission.name}, and only batches of {spacecraft} are asked for"
        raise BadInput(Fault("--mission", message, str(parsed.mission)))
    return mission, mission.name
