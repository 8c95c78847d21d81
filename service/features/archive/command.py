"""Command `acquire archive`: move old batches to Parquet files, verified before deletion.

`acquire reprocess` is extended here, too.
"""

from argparse import Namespace
from contextlib import closing
from pathlib import Path
from typing import Any

from service.cli import arguments
from service.cli.arguments import (
    existing_store,
    period_of,
    progress_bar,
    settings_of,
    settings_of_existing,
)
from service.errors import BadConfiguration, BadInput, Fault
from service.features.archive import reprocess_command

FOLDER = "the archive; default: ACQUIRE_ARCHIVE_FOLDER"


def add(commands: Any) -> None:
    """Declare `archive` with `verify` and `restore`, and extend `reprocess`."""
    reprocess_command.extend(commands.choices["reprocess"])
    parser = arguments.add_command(commands, "archive", archive)
    parser.add_argument("--before", metavar="UTC", help="archive batches before this batch time")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help=FOLDER)
    arguments.add_json(parser, "the counts")
    arguments.add_database(parser)
    group = arguments.add_subcommands(parser)
    verified = arguments.add_command(group, "verify", verify)
    verified.add_argument("--archive", dest="folder", type=Path, metavar="FOLDER", help=FOLDER)
    arguments.add_json(verified, "the faults")
    arguments.add_database(verified)
    restored = arguments.add_command(group, "restore", restore)
    restored.add_argument("--archive", dest="folder", type=Path, metavar="FOLDER", help=FOLDER)
    restored.add_argument("--spacecraft", metavar="NAME", help=arguments.MISSION)
    arguments.add_period(restored, "only this run; default: all runs")
    arguments.add_json(restored, "the counts")
    arguments.add_database(restored)


def archive(parsed: Namespace) -> int:
    """Move the batches before a time to an archive: a folder of Parquet files.  Each file is
    compared with the record before its batches are deleted.  Trends, and the recognition of
    repeats, stay in the database; gyro blocks stay too.  After an interruption, run the same
    command again to continue.  With SQLite, stop the service first.

    acquire archive --before 1996-01-01T00:00:00Z --to /archive
    acquire archive verify --archive /archive
    acquire archive restore --archive /archive --spacecraft XTE --start 1996-010T00:00:00Z
    """
    from service.extras import require_extra
    from service.times import parse_utc, utc_now

    if parsed.before is None:
        raise BadInput(Fault("--before", "must be given"))
    before = parse_utc(parsed.before, "--before")
    if before.tai_ns > utc_now().tai_ns:
        raise BadInput(Fault("--before", "must not be in the future", before.text))
    folder = _folder(parsed.to, "--to")
    require_extra("tables", "pyarrow", "--to", str(folder))
    from service.features.archive import archiving
    from service.storage.projections.projector import projected

    with closing(existing_store(parsed)) as store:
        store.require_writing()
        with projected(store), progress_bar("batches", "archiving") as bar:
            done = archiving.archive(
                store, folder, before, step=lambda done: bar(done.batches, done.total)
            )
    if parsed.json:
        arguments.print_json({"batches": done.batches, "files": done.parts, "bytes": done.bytes})
    else:
        print(f"{done.batches} batches before {before.text} were archived")
        print(f"{done.parts} files, {done.bytes} bytes, in {folder}")
    return 0


def verify(parsed: Namespace) -> int:
    """Read every file of an archive and report faults; exit code 1 if there is one.  With
    --database, also report files that the database needs and the archive lacks.

    acquire archive verify --archive /archive
    acquire archive verify --archive /archive --database sqlite:///acquire.db
    """
    from service.extras import require_extra

    folder = _folder(parsed.folder, "--archive")
    require_extra("tables", "pyarrow", "--archive", str(folder))
    from service.features.archive.archiving import verify_archive

    needed = {} if parsed.database is None else _parts(parsed)
    with progress_bar("batches", "reading") as bar:
        problems = list(verify_archive(folder, needed, bar))
    if parsed.json:
        arguments.print_json({"batches": bar.done, "faults": problems})
        return 1 if problems else 0
    for problem in problems:
        print(problem)
    if not problems:
        print(f"nothing is wrong with {bar.done} batches")
    return 1 if problems else 0


def restore(parsed: Namespace) -> int:
    """Record archived batches again, also in another database, byte for byte.  Files that have a
    batch of the period are restored whole; they stay in the archive.  With SQLite, stop the
    service first.

    acquire archive restore --archive /archive --spacecraft XTE
    acquire archive restore --archive /archive --database sqlite:///again.db
    """
    from service.extras import require_extra
    from service.storage.store import Store

    folder = _folder(parsed.folder, "--archive")
    require_extra("tables", "pyarrow", "--archive", str(folder))
    from service.features.archive import archiving

    start, end = period_of(parsed)
    selected = archiving.PartFilter(parsed.spacecraft, parsed.run, start, end)
    with closing(Store(settings_of(parsed).database)) as store:
        store.require_writing()
        with progress_bar("batches", "restoring") as bar:
            done = archiving.restore(
                store, folder, selected, step=lambda done: bar(done.batches, done.total)
            )
    if parsed.json:
        arguments.print_json({"batches": done.batches, "restored": done.restored})
    else:
        before = done.batches - done.restored
        print(f"{done.restored} batches were restored; {before} were recorded already")
    return 0


def _folder(path: Path | None, option: str) -> Path:
    from service.settings import Settings

    folder = path or Settings.from_environment().archive_folder
    if folder is None:
        raise BadInput(Fault(option, "must be given, or ACQUIRE_ARCHIVE_FOLDER set"))
    if not folder.is_dir():
        raise BadConfiguration(f"{folder}: there is no such folder")
    return folder


def _parts(parsed: Namespace) -> dict[str, str]:
    """Hashes of the archive files that the database refers to, by path."""
    from service.storage.archived import archived_paths
    from service.storage.readers import Readers

    with (
        closing(Readers(settings_of_existing(parsed).database)) as readers,
        readers.reading() as connection,
    ):
        return archived_paths(connection)
