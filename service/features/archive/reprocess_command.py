"""`acquire reprocess` into an archive, on local processes or on a Dask scheduler."""

import sys
from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.arguments import describe
from service.cli.commands import reprocess
from service.errors import BadConfiguration, BadInput, Fault

if TYPE_CHECKING:
    from service.app.factory import App
    from service.ingest.reprocess import ReprocessProgress

SCHEDULER = """\
A Dask scheduler runs whatever code it is sent: use tls://, with the certificates that Dask's own
settings name, and tcp:// only in a network that you trust.  The extra `dask` has the packages."""


def extend(parser: ArgumentParser) -> None:
    """Let `acquire reprocess` process archived batches too, and write to their archive."""
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
    describe(parser, run, SCHEDULER)


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
    if parsed.scheduler is not None and parsed.archive is None:
        raise BadInput(Fault("--scheduler", "needs --archive", parsed.scheduler))
    if parsed.archive is None:
        return reprocess.run(parsed)
    _check(parsed)

    def process(app: "App", **asked: Any) -> "ReprocessProgress":
        from service.features.archive.part import Reprocessings

        reprocessings = app.part(Reprocessings)
        return reprocessings.reprocess(
            parsed.run, parsed.archive, scheduler=parsed.scheduler, **asked
        )

    return reprocess.process_again(parsed, process, archive_folder=parsed.archive)


def _check(parsed: Namespace) -> None:
    """Raise `BadInput` or `BadConfiguration` for invalid use of `--archive` and `--scheduler`."""
    from service.extras import require_extra

    if parsed.track:
        message = (
            "cannot be used with --archive: each batch needs the result of the one before, and "
            "the parts of an archive are computed in any order"
        )
        raise BadInput(Fault("--track", message))
    if parsed.scheduler is not None and parsed.processes is not None:
        wanted = "is the number of processes on this machine: leave it out with --scheduler"
        raise BadInput(Fault("--processes", wanted))
    if not parsed.archive.is_dir():
        raise BadConfiguration(f"{parsed.archive}: there is no such folder")
    # A worker on another machine has another working folder.
    parsed.archive = parsed.archive.resolve()
    require_extra("tables", "pyarrow", "--archive", str(parsed.archive))
    if parsed.scheduler is not None:
        from service.features.archive.dask_workers import require_scheduler

        require_scheduler(parsed.scheduler)
        if parsed.scheduler.startswith("tcp://"):
            print(
                "acquire: --scheduler: tcp:// is neither encrypted nor authenticated, and whoever "
                "reaches the scheduler can run code on its workers: use tls://",
                file=sys.stderr,
            )
