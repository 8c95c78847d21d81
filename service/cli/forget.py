"""`acquire database forget`: a run, or some of its batches and gyro blocks, removed."""

import getpass
import json
import sys
from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.cli.arguments import MISSION, add_command, add_database, add_json, print_json
from service.cli.configuration import settings_of_existing

if TYPE_CHECKING:
    from sqlalchemy import Connection

    from service.storage.models.runs import Forgotten


def add_forget(group: Any) -> None:
    """Declare the command."""
    parser = add_command(
        group,
        "forget",
        "Remove what was recorded wrongly: a run, or some of its batches and gyro blocks, with "
        "their results, their part in the trends, the filtered attitudes that were computed with "
        "them, and what is archived of them.  Afterwards the right file can be replayed.  The "
        "command shows what it will remove and asks; the audit list says who did it.  This cannot "
        "be undone: make a backup first.  With SQLite, stop the service first, or use its API.",
        """
        acquire database forget --run pass-7
        acquire database forget --run live --spacecraft XTE --batch 1996-010-0001 1996-010-0002
        acquire database forget --run pass-7 --gyro-block g1 --yes
        """,
        forget,
    )
    parser.add_argument("--run", required=True, metavar="NAME", help="the run")
    parser.add_argument("--spacecraft", metavar="NAME", help=MISSION)
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
    add_json(parser, "the counts")
    add_database(parser)


def forget(parsed: Namespace) -> int:
    """Show what is removed, ask, and remove it."""
    from tqdm import tqdm

    from service.storage.store import Store
    from service.storage.upkeep import forget as forgetting

    settings = settings_of_existing(parsed)
    selected = forgetting.ForgetFilter(
        parsed.run, parsed.spacecraft, tuple(parsed.batch), tuple(parsed.gyro_block)
    )
    folder = parsed.archive or settings.archive_folder
    store = Store(settings.database, create=False)
    try:
        with store.reading() as connection:
            total = forgetting.found(connection, selected)
        print(_told(total), file=sys.stderr if parsed.json else sys.stdout)
        if not parsed.yes and not _is_confirmed(parsed.run):
            print("nothing was removed", file=sys.stderr)
            return 1
        with tqdm(total=None, unit=" batches", desc="removing", disable=None, leave=False) as b:

            def step(done: int, whole: "Forgotten") -> None:
                b.total = whole.batches + whole.archived_batches
                b.update(done - b.n)

            forgetting.forget(store, selected, folder, note=_note(parsed), step=step)
    finally:
        store.close()
    if parsed.json:
        from msgspec import to_builtins

        print_json(to_builtins(total))
    else:
        print("it was removed")
    return 0


def _told(total: "Forgotten") -> str:
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
    """What adds the entry of the audit list."""
    asked = {
        "spacecraft": parsed.spacecraft,
        "batches": parsed.batch,
        "gyro_blocks": parsed.gyro_block,
    }
    return lambda connection, total: note(connection, "forget_run", parsed.run, asked)


def note(connection: "Connection", action: str, about: str, asked: dict[str, Any]) -> None:
    """Add an entry to the audit list: the user of this command did this."""
    from service.access.audit import add_entry
    from service.storage.recording.ids import Ulids
    from service.times import utc_now

    add_entry(
        connection,
        id=Ulids().new(),
        moment=utc_now().text,
        who=f"command:{getpass.getuser()}"[:80],
        action=action,
        about=about,
        body=json.dumps(asked),
    )
