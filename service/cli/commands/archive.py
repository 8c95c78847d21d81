"""`acquire archive`: old batches in Parquet files, verified before they leave the database."""

from argparse import Namespace
from pathlib import Path
from typing import Any

from service.cli.arguments import (
    MISSION,
    add_command,
    add_database,
    add_json,
    add_period,
    add_subcommands,
    print_json,
)
from service.cli.configuration import period_of, settings_of, settings_of_existing
from service.errors import BadConfiguration, BadInput, Fault

FOLDER = "the archive; default: ACQUIRE_ARCHIVE_FOLDER"


def add(commands: Any) -> None:
    """Declare the command."""
    parser = add_command(
        commands,
        "archive",
        "Move the batches before a time to an archive: a folder of Parquet files.  Each file is "
        "compared with the record before its batches are deleted.  Trends, and the recognition of "
        "repeats, stay in the database; gyro blocks stay too.  After an interruption, run the "
        "same command again to continue.  With SQLite, stop the service first.",
        """
        acquire archive --before 1996-01-01T00:00:00Z --to /archive
        acquire archive verify --archive /archive
        acquire archive restore --archive /archive --spacecraft XTE --start 1996-010T00:00:00Z
        """,
        archive,
    )
    parser.add_argument("--before", metavar="UTC", help="archive batches before this batch time")
    parser.add_argument("--to", type=Path, metavar="FOLDER", help=FOLDER)
    add_json(parser, "the counts")
    add_database(parser)
    group = add_subcommands(parser)
    verified = add_command(
        group,
        "verify",
        "Read every file of an archive and report faults; exit code 1 if there is one.  With "
        "--database, also report files that the database needs and the archive lacks.",
        """
        acquire archive verify --archive /archive
        acquire archive verify --archive /archive --database sqlite:///acquire.db
        """,
        verify,
    )
    verified.add_argument("--archive", dest="folder", type=Path, metavar="FOLDER", help=FOLDER)
    add_json(verified, "the faults")
    add_database(verified)
    restored = add_command(
        group,
        "restore",
        "Record archived batches again, also in another database, byte for byte.  Files that have "
        "a batch of the period are restored whole; they stay in the archive.  With SQLite, stop "
        "the service first.",
        """
        acquire archive restore --archive /archive --spacecraft XTE
        acquire archive restore --archive /archive --database sqlite:///again.db
        """,
        restore,
    )
    restored.add_argument("--archive", dest="folder", type=Path, metavar="FOLDER", help=FOLDER)
    restored.add_argument("--spacecraft", metavar="NAME", help=MISSION)
    add_period(restored, "only this run; default: all runs")
    add_json(restored, "the counts")
    add_database(restored)


def archive(parsed: Namespace) -> int:
    """Move old batches to the archive."""
    from tqdm import tqdm

    from service.extras import require_extra
    from service.storage.store import Store
    from service.times import parse_utc, utc_now

    if parsed.before is None:
        raise BadInput(Fault("--before", "must be given"))
    before = parse_utc(parsed.before, "--before")
    if before.tai_ns > utc_now().tai_ns:
        raise BadInput(Fault("--before", "must not be in the future", before.text))
    folder = _folder(parsed.to, "--to")
    require_extra("tables", "pyarrow", "--to", str(folder))
    from service.storage.projections.projector import projected
    from service.storage.upkeep import archiving

    settings = settings_of_existing(parsed)
    store = Store(settings.database, create=False)
    try:
        store.require_writing()
        with (
            projected(store),
            tqdm(total=None, unit=" batches", desc="archiving", disable=None, leave=False) as b,
        ):

            def step(archived: archiving.Archived) -> None:
                b.total = archived.total
                b.update(archived.batches - b.n)

            done = archiving.archive(store, folder, before, step=step)
    finally:
        store.close()
    if parsed.json:
        print_json({"batches": done.batches, "files": done.parts, "bytes": done.bytes})
    else:
        print(f"{done.batches} batches before {before.text} were archived")
        print(f"{done.parts} files, {done.bytes} bytes, in {folder}")
    return 0


def verify(parsed: Namespace) -> int:
    """Tell what is wrong with an archive."""
    from tqdm import tqdm

    from service.extras import require_extra

    folder = _folder(parsed.folder, "--archive")
    require_extra("tables", "pyarrow", "--archive", str(folder))
    from service.storage.upkeep.restoring import verify_archive

    needed = {} if parsed.database is None else _parts(parsed)
    seen = 0
    with tqdm(total=None, unit=" batches", desc="reading", disable=None, leave=False) as bar:

        def step(batches: int) -> None:
            nonlocal seen
            bar.update(batches - seen)
            seen = batches

        problems = list(verify_archive(folder, needed, step))
    if parsed.json:
        print_json({"batches": seen, "faults": problems})
        return 1 if problems else 0
    for problem in problems:
        print(problem)
    if not problems:
        print(f"nothing is wrong with {seen} batches")
    return 1 if problems else 0


def restore(parsed: Namespace) -> int:
    """Record archived batches again."""
    from tqdm import tqdm

    from service.extras import require_extra
    from service.storage.store import Store

    folder = _folder(parsed.folder, "--archive")
    require_extra("tables", "pyarrow", "--archive", str(folder))
    from service.storage.upkeep import restoring

    start, end = period_of(parsed)
    selected = restoring.PartFilter(parsed.spacecraft, parsed.run, start, end)
    settings = settings_of(parsed)
    store = Store(settings.database)
    try:
        store.require_writing()
        with tqdm(total=None, unit=" batches", desc="restoring", disable=None, leave=False) as b:

            def step(restored: restoring.Restored) -> None:
                b.total = restored.total
                b.update(restored.batches - b.n)

            done = restoring.restore(store, folder, selected, step=step)
    finally:
        store.close()
    if parsed.json:
        print_json({"batches": done.batches, "restored": done.restored})
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
    """The hashes of the parts that the database has batches in, by path."""
    from service.storage.archive.reading import archived_paths
    from service.storage.store import Readers

    readers = Readers(settings_of_existing(parsed).database)
    try:
        with readers.reading() as connection:
            return archived_paths(connection)
    finally:
        readers.close()
