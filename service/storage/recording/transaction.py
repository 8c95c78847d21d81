"""One transaction of the writer: much work at once, and no failure reaches its neighbours."""

import sqlite3
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection, exc

from service.storage.recording import events
from service.storage.recording.identity import ArchivedMeanwhile
from service.storage.recording.results import RecordOutcome, record
from service.storage.recording.unsaved_result import UnsavedResult
from service.storage.sql.statements import execute

WriteOutcome = RecordOutcome | Exception
WriteOutcomes = list[WriteOutcome]

MAX_LOOKS = 5


@dataclass(eq=False)
class QueuedJob:
    """Results to record, or another change to make, and the function that takes the outcome.

    The results of a `pending` submission are added when the thread comes to it, see
    `Writer.solve_posts`.
    """

    settle: Callable[[Any], object]
    """Called with the `WriteOutcomes`, with what the change returns, or with an error."""
    unsaved_results: Sequence[UnsavedResult] = ()
    change: Callable[[Connection], Any] | None = None
    low_priority: bool = False
    """True for a bulk load: it is written by itself, after what else waits."""
    needs_lock: bool = False
    """True for a step of the projector: only the session that holds its lock may run it."""
    pending: Any = None
    since_s: float = field(default_factory=time.monotonic)

    @property
    def weight(self) -> int:
        """How much there is to write."""
        return len(self.unsaved_results) or 1

    @property
    def is_projection(self) -> bool:
        """True for a step of the projector, which is alone in its transaction."""
        return self.low_priority and self.change is not None


def transact(connection: Connection, jobs: Sequence[QueuedJob], careful: bool) -> list[Any]:
    """One outcome for each job: what comes of it, or the error that concerns it alone.

    A first try assumes that every result is new and looks nothing up, and it has no
    savepoints, for which SQLite keeps each page as it was: whatever fails ends the
    transaction.  A `careful` try looks up recorded batches first and isolates each failure.
    """
    with events.numbered(connection):
        unsaved_results = [unsaved for job in jobs for unsaved in job.unsaved_results]
        recorded: Sequence[WriteOutcome]
        if careful:
            recorded = _record(connection, unsaved_results)
        else:
            recorded = record(connection, unsaved_results, assume_new=True)
        outcomes = iter(recorded)
        return [
            [next(outcomes) for _ in job.unsaved_results]
            if job.change is None
            else _change(connection, job.change, careful)
            for job in jobs
        ]


def _record(connection: Connection, unsaved_results: Sequence[UnsavedResult]) -> WriteOutcomes:
    """Record all together; if that fails, each by itself, so that one fails no other."""
    if not unsaved_results:
        return []
    failure: Exception
    for _ in range(MAX_LOOKS):
        try:
            with _savepoint(connection):
                return list(record(connection, unsaved_results))
        except (exc.IntegrityError, ArchivedMeanwhile) as error:
            failure = error  # perhaps another process was faster: look again
        except Exception as error:
            if is_of_the_database(error):
                raise
            failure = error
            break
    if len(unsaved_results) == 1:
        return [failure]
    return [outcome for unsaved in unsaved_results for outcome in _record(connection, [unsaved])]


def _change(connection: Connection, change: Callable[[Connection], Any], careful: bool) -> Any:
    if not careful:
        return change(connection)
    try:
        with _savepoint(connection):
            return change(connection)
    except Exception as error:
        if is_of_the_database(error):
            raise
        return error


@contextmanager
def _savepoint(connection: Connection) -> Iterator[None]:
    """Keep what the block does whole, or none of it.

    Trouble of the database itself ends the whole transaction: SQLite, its disk
    full, may have rolled it back already, and what came before would be lost.
    """
    noted = events.noted(connection)
    execute(connection, "SAVEPOINT block")
    try:
        yield
    except BaseException as error:
        events.undone(connection, noted)
        if not is_of_the_database(error):
            execute(connection, "ROLLBACK TO SAVEPOINT block")
            execute(connection, "RELEASE SAVEPOINT block")
        raise
    execute(connection, "RELEASE SAVEPOINT block")


def is_of_the_database(error: BaseException) -> bool:
    """True if an error is the database's, its disk's or its connection's, and no single row's."""
    about_a_row = (exc.IntegrityError, exc.DataError, exc.ProgrammingError)
    return isinstance(error, exc.DBAPIError) and not isinstance(error, about_a_row)


def may_pass(error: exc.DBAPIError) -> bool:
    """True if the trouble is with the database's disk or connection, and not with what was asked.

    SQLite says of a table that is missing, and of a write through a connection
    for readers, that they are operational errors too.
    """
    code = getattr(error.orig, "sqlite_errorcode", None)
    ours = code is not None and code & 0xFF in (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_READONLY)
    return isinstance(error, exc.OperationalError | exc.InterfaceError) and not ours
