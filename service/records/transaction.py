"""One transaction of the writer: much work at once, and no failure reaches its neighbours."""

import logging
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection
from sqlalchemy.exc import (
    DataError,
    DBAPIError,
    IntegrityError,
    InterfaceError,
    OperationalError,
    ProgrammingError,
)

from service.records import events
from service.records.draft import Draft
from service.records.engines import TakenBack
from service.records.prepared import execute
from service.records.recording import Outcome, record

Results = list[Outcome | Exception]

MAX_LOOKS = 5

log = logging.getLogger(__name__)


@dataclass
class Job:
    """Drafts to record, or another change to make."""

    drafts: Sequence[Draft] = ()
    change: Callable[[Connection], Any] | None = None
    patient: bool = False
    """Whether it has time, as a bulk load has, and is written by itself."""

    @property
    def weight(self) -> int:
        """How much there is to write."""
        return len(self.drafts) or 1


def transact_at_once(connection: Connection, jobs: Sequence[Job]) -> list[Any]:
    """`transact` of drafts alone that are new, in all likelihood.

    Nothing is looked up again, and there is no savepoint, for which SQLite keeps what
    every page was before.  Raises `TakenBack` where something failed that is no trouble of
    the database itself: what is called after that is `transact`.
    """
    try:
        with events.numbered(connection):
            return _shared_out(connection, record(connection, _drafts(jobs), unseen=True), jobs)
    except Exception as error:
        # Whatever is wrong with one draft: made again with savepoints, it spoils no other.
        if is_of_the_database(error):
            raise
        log.debug("a transaction is made again, with care: %s", type(error).__name__)
        raise TakenBack from error


def transact(connection: Connection, jobs: Sequence[Job]) -> list[Any]:
    """One outcome for each job: a result, or the error that concerns it alone."""
    with events.numbered(connection):
        return _shared_out(connection, _record(connection, _drafts(jobs)), jobs)


def _drafts(jobs: Sequence[Job]) -> list[Draft]:
    return [draft for job in jobs for draft in job.drafts]


def _shared_out(
    connection: Connection, recorded: Sequence[Outcome | Exception], jobs: Sequence[Job]
) -> list[Any]:
    """To each job what was recorded of its drafts, or what its change comes to."""
    outcomes = iter(recorded)
    return [
        [next(outcomes) for _ in job.drafts]
        if job.change is None
        else _change(connection, job.change)
        for job in jobs
    ]


def _record(connection: Connection, drafts: Sequence[Draft]) -> Results:
    """All drafts together; where that fails, each by itself, so that one spoils no other."""
    if not drafts:
        return []
    failure: Exception
    for _ in range(MAX_LOOKS):
        try:
            with _savepoint(connection):
                return list(record(connection, drafts))
        except IntegrityError as error:
            failure = error  # perhaps another process was faster: look again
        except Exception as error:
            if is_of_the_database(error):
                raise
            failure = error
            break
    if len(drafts) == 1:
        return [failure]
    return [outcome for draft in drafts for outcome in _record(connection, [draft])]


def _change(connection: Connection, change: Callable[[Connection], Any]) -> Any:
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
    """Whether an error is the database's, its disk's or its connection's, and no single row's."""
    about_a_row = (IntegrityError, DataError, ProgrammingError)
    return isinstance(error, DBAPIError) and not isinstance(error, about_a_row)


def may_pass(error: DBAPIError) -> bool:
    """Whether the trouble is with the database's disk or connection, and not with what was asked.

    SQLite says of a table that is missing, and of a write through a connection
    for readers, that they are operational errors too.
    """
    code = getattr(error.orig, "sqlite_errorcode", None)
    ours = code is not None and code & 0xFF in (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_READONLY)
    return isinstance(error, OperationalError | InterfaceError) and not ours
