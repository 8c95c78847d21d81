"""Command `acquire reprocess`: process recorded batches again into another run, and compare."""

import sys
from argparse import Namespace
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli import arguments
from service.cli.arguments import period_of, settings_of_existing
from service.errors import BadConfiguration, BadInput, Fault

if TYPE_CHECKING:
    from service.missions.mission import Mission

SCHEDULER = """\
A Dask scheduler runs whatever code it is sent: use tls://, with the certificates that Dask's own
settings name, and tcp:// only in a network that you trust.  The extra `dask` has the packages."""


def add(commands: Any) -> None:
    """Declare the command `reprocess`."""
    parser = arguments.add_command(
        commands, "reprocess", run, notes=SCHEDULER, first="--spacecraft --source --run --mission"
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
        "--archive",
        type=Path,
        metavar="FOLDER",
        help="also process the batches in this archive, and write the results there",
    )
    parser.add_argument(
        "--scheduler",
        metavar="tls://HOST:PORT",
        help="with --archive: compute on the workers of this Dask scheduler",
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
    file, and record the results in a separate run; then compare both runs.  With --archive,
    process archived batches too, and write the results to the archive: one file for each file of
    the archive and for each day of batches in the database.  After an interruption, run the same
    command again to continue.  With SQLite, stop the service first.

    acquire reprocess --start 1996-010T00:00:00Z --end 1996-020T00:00:00Z
    acquire reprocess --mission wider.toml --run wider
    acquire reprocess --spacecraft XTE --run xte-tracked --track
    acquire reprocess --source pass-7 --spacecraft XTE --run pass-7-again --json
    acquire reprocess --mission wider.toml --run wider --archive /archive
    acquire reprocess --run again --archive /archive --scheduler tls://10.0.0.1:8786
    """
    import dataclasses

    import msgspec
    from tqdm import tqdm

    from service.app.context import checked_run_name
    from service.app.factory import open_app
    from service.cli.texts import comparison_text, progress_text
    from service.ingest.reprocess import ReprocessProgress, require_other_run

    start, end = period_of(parsed)
    mission, spacecraft = _chosen(parsed)
    if parsed.run is not None:
        require_other_run(checked_run_name(parsed.run), parsed.source)
    _check_track(parsed)
    _check_archive(parsed)
    settings = settings_of_existing(parsed)
    if parsed.archive is not None:
        settings = dataclasses.replace(settings, archive_folder=parsed.archive)
    with closing(open_app(settings, mission)) as app:
        with tqdm(
            total=None, unit=" batches", desc="running again", disable=parsed.quiet or None
        ) as bar:

            def step(progress: ReprocessProgress) -> None:
                bar.total = progress.total
                if progress.partitions:
                    done = f"{progress.partitions_done} of {progress.partitions} partitions"
                    bar.set_postfix_str(done, refresh=False)
                bar.update(progress.before + progress.recorded + progress.refused - bar.n)

            period: dict[str, Any] = {"source": parsed.source, "spacecraft": spacecraft}
            period |= {"start": start, "end": end}
            processes = parsed.processes or 0
            if parsed.archive is None:
                progress = app.runs.reprocess(
                    parsed.run, **period, processes=processes, track=parsed.track, step=step
                )
            else:
                progress = app.runs.reprocess_into_archive(
                    parsed.run,
                    parsed.archive,
                    **period,
                    processes=processes,
                    scheduler=parsed.scheduler,
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


def _check_track(parsed: Namespace) -> None:
    """Raise `BadInput` for options that contradict `--track`."""
    if not parsed.track:
        return
    if parsed.archive is not None:
        message = (
            "cannot be used with --archive: each batch needs the result of the one before, and "
            "the parts of an archive are computed in any order"
        )
        raise BadInput(Fault("--track", message))
    if parsed.processes is not None:
        message = "leave it out with --track, which computes one batch after another"
        raise BadInput(Fault("--processes", message))


def _check_archive(parsed: Namespace) -> None:
    """Raise `BadInput` or `BadConfiguration` for invalid use of `--archive` and `--scheduler`."""
    from service.extras import require_extra

    if parsed.scheduler is not None and parsed.archive is None:
        raise BadInput(Fault("--scheduler", "needs --archive", parsed.scheduler))
    if parsed.scheduler is not None and parsed.processes is not None:
        wanted = "is the number of processes on this machine: leave it out with --scheduler"
        raise BadInput(Fault("--processes", wanted))
    if parsed.archive is None:
        return
    if not parsed.archive.is_dir():
        raise BadConfiguration(f"{parsed.archive}: there is no such folder")
    # A worker on another machine has another working folder.
    parsed.archive = parsed.archive.resolve()
    require_extra("tables", "pyarrow", "--archive", str(parsed.archive))
    if parsed.scheduler is not None:
        from service.ingest.dask_workers import require_scheduler

        require_scheduler(parsed.scheduler)
        if parsed.scheduler.startswith("tcp://"):
            print(
                "acquire: --scheduler: tcp:// is neither encrypted nor authenticated, and whoever "
                "reaches the scheduler can run code on its workers: use tls://",
                file=sys.stderr,
            )
