"""Command `acquire database`: maintenance of the whole database."""

import getpass
import json
import os
import sys
from argparse import Namespace
from collections.abc import Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli import arguments
from service.cli.arguments import (
    existing_store,
    progress_bar,
    settings_of,
    settings_of_existing,
)
from service.errors import BadConfiguration

if TYPE_CHECKING:
    from sqlalchemy import Connection

    from service.contract.runs import Forgotten


MAX_PROBLEMS = 100
UNKNOWN_TABLES = "tables that no installed code knows, as those of a feature that was removed"


def add(commands: Any) -> None:
    """Declare the command `database` with its subcommands."""
    group = arguments.add_group(
        commands,
        "database",
        "Maintain the database: schema, backup, verification, and deleting old batches.",
        """
        acquire database upgrade --database postgresql+psycopg://user@host/attitudes
        acquire database backup night.db
        acquire database restore night.db --database sqlite:///again.db
        acquire database verify
        """,
    )
    parser = arguments.add_command(group, "upgrade", upgrade)
    arguments.add_database(parser)
    parser = arguments.add_command(group, "check", check)
    parser.add_argument(
        "--fresh", action="store_true", help="check the migrations on an empty database"
    )
    arguments.add_json(parser, "the differences")
    arguments.add_database(parser)
    parser = arguments.add_command(group, "backup", backup)
    parser.add_argument("output", type=Path, metavar="FILE", help="must not exist yet")
    arguments.add_database(parser)
    parser = arguments.add_command(group, "restore", restore)
    parser.add_argument("backup", type=Path, metavar="FILE", help="made by `database backup`")
    arguments.add_database(parser)
    parser = arguments.add_command(group, "verify", verify)
    parser.add_argument(
        "--public-key",
        type=Path,
        metavar="FILE",
        help="the public key (PEM) of the key that signs the heads of the record",
    )
    parser.add_argument(
        "--head",
        metavar="FILE|VALUE",
        help="heads that were noted elsewhere: a log, or `NUMBER SHA256`",
    )
    arguments.add_json(parser, "the faults")
    arguments.add_database(parser)
    parser = arguments.add_command(group, "copy", copy)
    parser.add_argument("source", metavar="FROM", help="URL of the database to copy")
    parser.add_argument("target", metavar="TO", help="URL of the empty database")
    parser = arguments.add_command(group, "rebuild", rebuild)
    arguments.add_database(parser)
    parser = arguments.add_command(group, "split-trackers", split_trackers)
    arguments.add_database(parser)
    parser = arguments.add_command(group, "prune", prune)
    parser.add_argument(
        "--before", required=True, metavar="UTC", help="delete batches before this batch time"
    )
    parser.add_argument("--run", metavar="NAME", help="only this run; default: all runs")
    parser.add_argument("--dry-run", action="store_true", help="only print the number of batches")
    arguments.add_database(parser)
    parser = arguments.add_command(group, "forget", forget)
    parser.add_argument("--run", required=True, metavar="NAME", help="the run")
    parser.add_argument("--spacecraft", metavar="NAME", help=arguments.MISSION)
    parser.add_argument(
        "--batch", nargs="+", default=[], metavar="BATCH", help="only these batches"
    )
    parser.add_argument(
        "--gyro-block", nargs="+", default=[], metavar="BLOCK", help="only these gyro blocks"
    )
    parser.add_argument(
        "--archive",
        type=Path,
        metavar="FOLDER",
        help="the archive with batches of the run; default: ACQUIRE_ARCHIVE_FOLDER",
    )
    parser.add_argument("--yes", action="store_true", help="remove without asking")
    arguments.add_json(parser, "the counts")
    arguments.add_database(parser)


def upgrade(parsed: Namespace) -> int:
    """Create missing tables and migrate the schema to this version; all data are kept.

    acquire database upgrade
    """
    from service.storage.sql.migrations import upgrade as upgrade_schema

    upgrade_schema(settings_of(parsed).database)
    print("the schema is up to date")
    return 0


def check(parsed: Namespace) -> int:
    """Compare the schema with the code; exit code 1 if they differ.

    acquire database check
    acquire database check --fresh
    """
    from service.storage.sql.migrations import check as check_schema
    from service.storage.sql.migrations import check_fresh, unknown_tables

    database = settings_of(parsed).database
    differences = check_fresh() if parsed.fresh else check_schema(database)
    unknown = [] if parsed.fresh else unknown_tables(database)
    if parsed.json:
        arguments.print_json({"differences": differences, "unknown_tables": unknown})
        return 1 if differences else 0
    if unknown:
        print(f"note: {UNKNOWN_TABLES}: {', '.join(unknown)}")
    for difference in differences:
        print(difference if len(difference) <= 120 else difference[:119] + "…")
    if not differences:
        print("the schema is that of the code")
    return 1 if differences else 0


def backup(parsed: Namespace) -> int:
    """Copy the whole database as it is now, also while the service is running: SQLite to a database
    file, PostgreSQL to a file for pg_restore.

    acquire database backup night.db
    acquire database backup night.dump --database postgresql://user@host/attitudes
    """
    from service.storage.upkeep.backup import back_up

    with progress_bar("pages", "copying") as bar:
        database = settings_of(parsed).database
        head = back_up(database, parsed.output, lambda left, total: bar(total - left, total))
    print(f"{parsed.output}: {parsed.output.stat().st_size} bytes")
    if head is not None:
        print(f"record head {head.text}")
    return 0


def restore(parsed: Namespace) -> int:
    """Make a database from a backup: an SQLite file that does not exist yet, or an empty PostgreSQL
    database.  It appears whole or not at all, with the schema of the backup.

    acquire database restore night.db --database sqlite:///acquire.db
    acquire database restore night.dump --database postgresql://user@host/attitudes
    """
    from service.storage.sql.migrations import remedy
    from service.storage.upkeep.backup import restore as restore_backup

    with progress_bar("pages", "restoring") as bar:
        database = settings_of(parsed).database
        revision = restore_backup(
            database, parsed.backup, lambda left, total: bar(total - left, total)
        )
    print(f"{parsed.backup}: restored; its schema is at {revision}")
    if differs := remedy(database):
        print(differs)
    return 0


def verify(parsed: Namespace) -> int:
    """Read everything and report faults: the file, the schema, every batch with its results, the
    trends, the gyro blocks, the filtered and smoothed attitudes.  Exit code 1 if there is a
    fault.  Changes nothing.

    acquire database verify
    acquire database verify --database sqlite:///night.db
    acquire database verify --public-key record.pub.pem --head heads.log
    """
    from service.storage.recording.signing import PublicKey
    from service.storage.upkeep.verify import earlier_results
    from service.storage.upkeep.verify import verify as verify_records
    from service.storage.upkeep.verify_chain import anchors_in

    database = settings_of(parsed).database
    public_key = None if parsed.public_key is None else PublicKey(parsed.public_key)
    anchors = [] if parsed.head is None else anchors_in(_text_of(parsed.head))
    with progress_bar("batches", "reading") as bar:
        problems = verify_records(database, bar, public_key=public_key, anchors=anchors)
    if parsed.json:
        arguments.print_json({"batches": bar.done, "faults": problems})
        return 1 if problems else 0
    _print_problems(problems)
    if problems:
        return 1
    print(f"nothing is wrong with {bar.done} batches")
    if public_key is None and not anchors:
        print("without --public-key and --head this finds accidents, not intruders")
    without, later = earlier_results(database)
    if later:
        print(f"{later} results got their digest at an upgrade: changes before it are not found")
    if without:
        print(f"{without} results have no digest yet: the service makes them while it runs")
    return 0


def _text_of(given: str) -> str:
    """Content of a file, or the argument itself if it is not a file."""
    if not os.path.isfile(given):
        return given
    try:
        return Path(given).read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise BadConfiguration(f"--head: {given}: {error.strerror}") from None


def _print_problems(problems: Sequence[str]) -> None:
    for problem in problems[:MAX_PROBLEMS]:
        print(problem)
    if len(problems) > MAX_PROBLEMS:
        print(f"and {len(problems) - MAX_PROBLEMS} more")


def copy(parsed: Namespace) -> int:
    """Copy the whole record to another database, SQLite to PostgreSQL or back, compare every row of
    the two, and verify the copy.  Stop the services on both first.  FROM stays as it is; TO must
    be empty, and an SQLite file is made if it is missing.  You can stop the command at any time:
    it continues when you start it again.

    acquire database copy sqlite:///acquire.db postgresql://user@host/attitudes
    acquire database copy postgresql://user@host/attitudes sqlite:///acquire.db
    """
    from tqdm import tqdm

    from service.storage.sql.migrations import unknown_tables
    from service.storage.upkeep.copy import copy_record

    with tqdm(total=None, disable=None, leave=False) as bar:

        def step(what: str, done: int, total: int) -> None:
            bar.total = total
            bar.set_description(what, refresh=False)
            bar.update(done - bar.n)

        rows, problems = copy_record(parsed.source, parsed.target, step)
    if unknown := unknown_tables(parsed.source):
        print(f"not copied: {UNKNOWN_TABLES}: {', '.join(unknown)}")
    _print_problems(problems)
    if problems:
        print(f"the copy equals its source in {rows} rows; both have these faults")
        return 1
    print(f"{rows} rows were copied and compared; nothing is wrong with the copy")
    return 0


def rebuild(parsed: Namespace) -> int:
    """Count the trends anew from the recorded batches.  They are kept up by themselves: this is for
    a database whose `verify` reports wrong trends.  Alarms and events stay: they hold what
    people did, and the limits of their time.  On SQLite no service may be running.

    acquire database rebuild
    """
    from service.storage.projections.projector import projected, rebuild_trends

    with (
        closing(existing_store(parsed)) as store,
        projected(store),
        progress_bar("hours", "counting") as bar,
    ):
        hours = rebuild_trends(store, bar)
    print(f"the trends of {hours} hours were counted anew")
    return 0


def split_trackers(parsed: Namespace) -> int:
    """Split batches by tracker that were recorded before their spacecraft had several trackers, for
    the trends of each.  The service does the same by itself, more slowly.  You can stop the
    command at any time; it continues when you start it again.

    acquire database split-trackers
    """
    from service.app.factory import open_app

    with (
        closing(open_app(settings_of_existing(parsed))) as app,
        progress_bar("batches", "splitting") as bar,
    ):
        done = app.upgrade.splitter.split(bar)
    print(f"{done} batches were looked at; every batch is split by tracker")
    return 0


def prune(parsed: Namespace) -> int:
    """Delete the batches before a time, with their results and their part in the trends, and the
    gyro blocks and days of filtered attitudes that end before it.  On SQLite no service may be
    running.  This cannot be undone: make a backup first.

    acquire database prune --before 1996-01-01T00:00:00Z --dry-run
    acquire database prune --before 1996-001T00:00:00Z --run pass-7
    """
    from service.storage.projections.projector import projected
    from service.storage.upkeep.prune import prune as prune_records
    from service.times import parse_utc

    before = parse_utc(parsed.before, "--before")
    with (
        closing(existing_store(parsed)) as store,
        projected(store),
        progress_bar("batches", "deleting") as bar,
    ):
        if not parsed.dry_run:
            asked = {"before": before.text, "run": parsed.run}
            store.writer.change(partial(note, action="prune", about="database", asked=asked))
        pruned = prune_records(
            store,
            before,
            parsed.run,
            dry_run=parsed.dry_run,
            step=lambda pruned: bar(pruned.batches, pruned.total),
        )
    if parsed.dry_run:
        more = _beside(pruned.total_gyro_blocks, pruned.total_graded_days)
        print(f"{pruned.total} batches{more} are before {before.text}; nothing was deleted")
    else:
        more = _beside(pruned.gyro_blocks, pruned.graded_days)
        print(f"{pruned.batches} batches{more} before {before.text} were deleted")
    return 0


def _beside(gyro_blocks: int, graded_days: int) -> str:
    """Text about deleted gyro blocks and filtered days, empty without any."""
    counts = [f"{gyro_blocks} gyro blocks"] if gyro_blocks else []
    counts += [f"{graded_days} days of filtered attitudes"] if graded_days else []
    return "".join(f" and {each}" for each in counts)


def forget(parsed: Namespace) -> int:
    """Remove what was recorded wrongly: a run, or some of its batches and gyro blocks, with their
    results, their part in the trends, the filtered attitudes that were computed with them, and
    what is archived of them.  Afterwards the right file can be replayed.  The command shows what
    it will remove and asks; the audit list says who did it.  This cannot be undone: make a
    backup first.  With SQLite, stop the service first, or use its API.

    acquire database forget --run pass-7
    acquire database forget --run live --spacecraft XTE --batch 1996-010-0001 1996-010-0002
    acquire database forget --run pass-7 --gyro-block g1 --yes
    """
    from service.storage.store import Store
    from service.storage.upkeep import forget as forgetting

    settings = settings_of_existing(parsed)
    selected = forgetting.ForgetFilter(
        parsed.run, parsed.spacecraft, tuple(parsed.batch), tuple(parsed.gyro_block)
    )
    folder = parsed.archive or settings.archive_folder
    off = settings.features_off
    with closing(Store(settings.database, create=False, features_off=off)) as store:
        with store.reading() as connection:
            total = forgetting.found(connection, selected)
        print(_removal_text(total), file=sys.stderr if parsed.json else sys.stdout)
        if not parsed.yes and not _is_confirmed(parsed.run):
            print("nothing was removed", file=sys.stderr)
            return 1
        with progress_bar("batches", "removing") as bar:

            def step(done: int, whole: "Forgotten") -> None:
                bar(done, whole.batches + whole.archived_batches)

            forgetting.forget(store, selected, folder, note=_note(parsed), step=step)
    if parsed.json:
        from msgspec import to_builtins

        arguments.print_json(to_builtins(total))
    else:
        print("it was removed")
    return 0


def _removal_text(total: "Forgotten") -> str:
    of = "" if total.spacecraft is None else f" of {total.spacecraft}"
    counts = [
        (total.batches, "batches with their results"),
        (total.archived_batches, "archived batches"),
        (total.gyro_blocks, "gyro blocks"),
        (total.graded_days, "days of filtered attitudes"),
    ]
    lines = [f"  {count} {what}" for count, what in counts if count]
    return "\n".join([f"from run {total.run}{of} will be removed:", *lines])


def _is_confirmed(run: str) -> bool:
    try:
        return input(f"Type the name of the run ({run}) to remove them: ").strip() == run
    except EOFError:
        return False


def _note(parsed: Namespace) -> Any:
    asked = {
        "spacecraft": parsed.spacecraft,
        "batches": parsed.batch,
        "gyro_blocks": parsed.gyro_block,
    }
    return lambda connection, total: note(connection, "forget_run", parsed.run, asked)


def note(connection: "Connection", action: str, about: str, asked: dict[str, Any]) -> None:
    """Add an audit entry for a change made by the user of this command."""
    from service.access import Entry
    from service.storage.recording.ids import Ulids
    from service.times import utc_now

    who = f"command:{getpass.getuser()}"[:80]
    entry = Entry(Ulids().new(), utc_now().text, who, action, about, json.dumps(asked))
    entry.add_to(connection)
