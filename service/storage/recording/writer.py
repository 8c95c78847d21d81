"""Writer: the one connection that writes; threads take turns, each with one transaction.

    caller's thread ──► its turn ──► one transaction, committed ──► return value

Chunks of a bulk load and turns of the projector let other callers go first, but wait for at most
one transaction of theirs.
"""

import logging
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from typing import TypeVar

from sqlalchemy import Connection, Engine, exc, update

from service.errors import Busy, Stopping
from service.storage.recording import events
from service.storage.recording.events import Bell
from service.storage.recording.identity import ArchivedMeanwhile
from service.storage.recording.results import RecordOutcome, record
from service.storage.recording.unsaved_result import UnsavedResult
from service.storage.sql.database_file import DatabaseFile, FileLock
from service.storage.sql.dialects import dialect_of
from service.storage.sql.engines import TO_WRITE, PersistentConnection, RolledBack, patience
from service.storage.sql.projector_lock import Attempt, ProjectorLock
from service.storage.sql.statements import execute
from service.storage.sql.tables import WRITTEN_BY_POSTS, event_counter

log = logging.getLogger(__name__)

T = TypeVar("T")

WriteOutcome = RecordOutcome | Exception
WriteOutcomes = list[WriteOutcome]

MAX_ATTEMPTS = 5
RETRY_AFTER_S = 5

# PostgreSQL's codes for two transactions in conflict; the one that it stopped starts again.
_CROSSED = ("40001", "40P01")


class Crossed(Busy):
    """Error: PostgreSQL stopped a transaction, since another one wrote the same rows."""


@dataclass(frozen=True)
class WriterState:
    """State of the writer: number of waiting records, age of the oldest in seconds, failures."""

    queued: int
    oldest_s: float
    succeeded: bool
    """True if the last write succeeded."""
    failed: int
    """Number of batches and changes that could not be written since the start."""


@dataclass(eq=False, frozen=True)
class _Ticket:
    """Ticket of a thread in the queue for the writer, with the number of its records."""

    records: int
    low_priority: bool
    since_s: float = field(default_factory=time.monotonic)


class _Turns:
    """Queue that lets one thread at a time write, in the order of arrival.

    Tickets of low priority let the others go first, but for one turn only.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._first: deque[_Ticket] = deque()
        self._last: deque[_Ticket] = deque()
        self._has_waited = False
        self._is_taken = False
        self.is_closing = False

    @contextmanager
    def turn(self, ticket: _Ticket, wait_s: float | None) -> Iterator[None]:
        """Context manager that waits for a ticket's turn to write, and holds it during the block.

        Raises `Busy` after `wait_s`, and `Stopping` after a call of `close`.
        """
        queue = self._last if ticket.low_priority else self._first
        with self._changed:
            if self.is_closing:
                raise Stopping("the service is stopping")
            queue.append(ticket)
            if not self._changed.wait_for(lambda: self._is_next(ticket), wait_s):
                queue.remove(ticket)
                self._changed.notify_all()
                raise Busy("what was to be written before is not written yet", RETRY_AFTER_S)
            queue.popleft()
            self._is_taken = True
            self._has_waited = bool(self._last) and not ticket.low_priority
        try:
            yield
        finally:
            with self._changed:
                self._is_taken = False
                self._changed.notify_all()

    def _is_next(self, ticket: _Ticket) -> bool:
        if self._is_taken:
            return False
        queue = self._last if self._last and (self._has_waited or not self._first) else self._first
        return queue[0] is ticket

    def waiting(self) -> tuple[int, float]:
        """Number of records in the queue, and the waiting time of the oldest in seconds."""
        with self._changed:
            tickets = [*self._first, *self._last]
        oldest_s = min((each.since_s for each in tickets), default=time.monotonic())
        return sum(each.records for each in tickets), time.monotonic() - oldest_s

    def close(self) -> None:
        """Refuse further tickets, and wait until all threads have had their turn."""
        with self._changed:
            self.is_closing = True
            self._changed.wait_for(lambda: not (self._is_taken or self._first or self._last))


class Writer:
    """Writer of all threads' records and changes, one transaction after another."""

    def __init__(
        self,
        engine: Engine,
        *,
        file: DatabaseFile | None = None,
        wait_s: float | None = None,
        lock: ProjectorLock | None = None,
        file_lock: FileLock | None = None,
    ) -> None:
        """Prepare the writer; `file` is SQLite's, `wait_s` bounds the wait of posts for a turn.

        Results of a bulk load, and other changes, wait as long as it takes.  With a `lock` only the
        session that holds it projects; see `take_lock`.  `file_lock` is taken before the first
        write.
        """
        self._lock, self._file_lock = lock, file_lock
        self._connection = PersistentConnection(engine, TO_WRITE, file)
        self._wait_s = wait_s
        self._turns = _Turns()
        self._noting = threading.Lock()
        self._failures = 0
        self._is_failing = False
        self._behind = ThreadPoolExecutor(1, "write-behind")
        self.commits = 0
        """Number of committed transactions, without those of the projector."""
        self.bell = Bell()
        """Notifier that is rung after each transaction that recorded events."""

    def record(
        self, unsaved_results: Sequence[UnsavedResult], low_priority: bool = False
    ) -> WriteOutcomes:
        """Record results in one transaction; one outcome for each, in order.

        An outcome is a stored answer, or the error that kept this result alone from being recorded.
        Raises `Busy` where the database itself fails, or other transactions take too long.
        """
        if not unsaved_results:
            return []

        def write(careful: bool) -> WriteOutcomes:
            wait_s = None if low_priority else self._wait_s
            with self._transaction(len(unsaved_results), low_priority, wait_s) as connection:
                if careful:
                    return _record(connection, unsaved_results)
                return list(record(connection, unsaved_results, assume_new=True))

        outcomes = self._attempted(write, len(unsaved_results))
        # Check before locking: the flag rarely changes.  A successful small change does not show
        # that there is room for a batch.
        if self._is_failing:
            with self._noting:
                self._is_failing = False
        return outcomes

    def change(self, change: Callable[[Connection], T], *, of_posts: bool = False) -> T:
        """Make a change in one transaction; returns its result. After a conflict it is repeated.

        Changes of posts wait no longer for their turn than results do; raises `Busy` after that.
        """

        def write(_: bool) -> T:
            wait_s = self._wait_s if of_posts else None
            with self._transaction(wait_s=wait_s) as connection:
                return change(connection)

        return self._attempted(write, 1)

    @contextmanager
    def projection(self) -> Iterator[Connection]:
        """Context manager of a transaction of the projector, which lets other writers go first.

        Raises `NotProjecting` where another service that shares the database projects.
        """
        if self._lock is not None:
            self._lock.require()
        with self._transaction(low_priority=True, is_projection=True) as connection:
            if self._lock is not None:
                self._lock.require_in(connection)
            yield connection

    def take_lock(self) -> Attempt:
        """Try to take the projector's lock; returns whether it was taken, refused or had before."""
        if self._lock is None:
            return "kept"
        with self._transaction(low_priority=True, is_projection=True) as connection:
            return self._lock.take(connection)

    def later(self, write: Callable[[], T]) -> "Future[T]":
        """Call a writing function in a background thread, after earlier ones; returns its future.

        Meanwhile the caller can compute the next results.
        """
        try:
            return self._behind.submit(write)
        except RuntimeError:
            raise Stopping("the service is stopping") from None

    def require(self) -> None:
        """Raise `Stopping` if the writer is closed."""
        if self._turns.is_closing:
            raise Stopping("nothing is recorded any more: restart the service")

    def note_failure(self, count: int) -> None:
        """Count records that could not be written, or not even be looked up beforehand."""
        with self._noting:
            self._failures += count
            self._is_failing = True

    def require_written(self) -> None:
        """Raise `Busy` if the last write failed and a trial write of a batch's size fails too.

        Without the trial, only the next client's batch could show that the database accepts writes
        again.
        """
        if not self._is_failing:
            return
        before = self._failures
        self.change(_write_as_a_batch)
        self.change(remove_probe)
        with self._noting:
            self._is_failing = self._failures != before

    def state(self) -> WriterState:
        """Present state of the writer and its queue."""
        queued, oldest_s = self._turns.waiting()
        return WriterState(queued, oldest_s, not self._is_failing, self._failures)

    def close(self) -> None:
        """Refuse further work, and return when all queued work is written."""
        self._behind.shutdown()
        self._turns.close()
        self._connection.close()

    def _attempted(self, write: Callable[[bool], T], records: int) -> T:
        """Call a writing function; repeat it after a crossed transaction, once after another error.

        `write` gets True if an attempt has failed before, so that care is needed.
        """
        attempt = 1
        while True:
            try:
                return write(attempt > 1)
            except Crossed:
                if attempt == MAX_ATTEMPTS:
                    self.note_failure(records)
                    raise
            except Exception as error:
                if attempt > 1 or isinstance(error, Busy):
                    raise
                log.debug("a transaction is made again, with care: %s", type(error).__name__)
            attempt += 1

    @contextmanager
    def _transaction(
        self,
        records: int = 1,
        low_priority: bool = False,
        wait_s: float | None = None,
        is_projection: bool = False,
    ) -> Iterator[Connection]:
        """Context manager of a transaction in this thread's turn, committed after the block.

        An error raised by the block rolls the transaction back.  Raises `Busy` where the database
        fails or the turn does not come within `wait_s`, and `Crossed` where PostgreSQL stopped the
        transaction for another one.
        """
        if self._file_lock is not None:
            self._file_lock.take()
        own_error: Exception | None = None
        has_events = False
        try:
            with self._turns.turn(_Ticket(records, low_priority), wait_s), suppress(RolledBack):
                with (
                    self._connection.transaction() as connection,
                    patience(connection) if low_priority else nullcontext(),
                ):
                    try:
                        with events.numbered(connection):
                            yield connection
                    except Exception as error:
                        if is_of_the_database(error):
                            raise
                        own_error = error
                        raise RolledBack from error
                    has_events = events.noted(connection) > 0
                if not is_projection:
                    self.commits += 1
        except exc.DBAPIError as error:
            if getattr(error.orig, "sqlstate", None) in _CROSSED:
                raise Crossed("other transactions came in the way", RETRY_AFTER_S) from error
            log.error("%d records could not be written: %s", records, error.orig)
            if not is_of_the_database(error) or (is_projection and is_of_the_statement(error)):
                raise
            if not is_projection:
                self.note_failure(records)
            # The error names files and hosts, which belong in the log only.
            raise Busy("the database cannot be written now", RETRY_AFTER_S) from error
        except Busy:
            if not is_projection:
                self.note_failure(records)
            raise
        if own_error is not None:
            raise own_error
        if has_events:
            self.bell.ring()


def _record(connection: Connection, unsaved_results: Sequence[UnsavedResult]) -> WriteOutcomes:
    """Record all results together; after an error one by one, so that one fails no other."""
    failure: Exception
    for _ in range(5):
        try:
            with _savepoint(connection):
                return list(record(connection, unsaved_results))
        except (exc.IntegrityError, ArchivedMeanwhile) as error:
            failure = error  # Another process may have inserted the row first: search again.
        except Exception as error:
            if is_of_the_database(error):
                raise
            failure = error
            break
    if len(unsaved_results) == 1:
        return [failure]
    return [outcome for unsaved in unsaved_results for outcome in _record(connection, [unsaved])]


@contextmanager
def _savepoint(connection: Connection) -> Iterator[None]:
    """Context manager that undoes the changes of its block in a transaction if the block fails.

    A fault of the database itself ends the whole transaction: SQLite, its disk full, may have
    rolled it back already, and earlier changes would be lost.
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
    """True if a database error's class blames the database or connection, not a row or the SQL."""
    about_a_row = (exc.IntegrityError, exc.DataError, exc.ProgrammingError)
    return isinstance(error, exc.DBAPIError) and not isinstance(error, about_a_row)


def is_of_the_statement(error: BaseException) -> bool:
    """True for SQLite's operational error in a statement itself, such as a missing table."""
    code = getattr(getattr(error, "orig", None), "sqlite_errorcode", None)
    return code is not None and code & 0xFF == sqlite3.SQLITE_ERROR


def may_pass(error: exc.DBAPIError) -> bool:
    """True for a passing fault of the database's disk or connection, not of the statement.

    SQLite also reports as operational errors a missing table, and a write through a reading
    connection.
    """
    code = getattr(error.orig, "sqlite_errorcode", None)
    ours = code is not None and code & 0xFF in (sqlite3.SQLITE_ERROR, sqlite3.SQLITE_READONLY)
    return isinstance(error, exc.OperationalError | exc.InterfaceError) and not ours


def _write_as_a_batch(connection: Connection) -> None:
    """Take the locks of a post, and write as much as a large batch does."""
    names = [table.name for table in WRITTEN_BY_POSTS]
    dialect_of(connection).write_probe(connection, names)
    # Change the value and restore it: SQLite writes nothing for a row that keeps its value.
    for step in (1, -1):
        connection.execute(update(event_counter).values(last=event_counter.c.last + step))


def remove_probe(connection: Connection) -> None:
    """Remove the trial write, including one left by a process that was killed."""
    dialect_of(connection).remove_probe(connection)
