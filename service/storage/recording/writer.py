"""The one connection that writes, and the thread behind it.

The thread takes whatever is queued, has the posts among it solved, writes all in one
transaction, commits, and only then answers: under load many share a commit, and alone
nothing waits for others.  There is no timer.  Chunks of a bulk load are written by
themselves, in turn with everything else.
"""

import logging
import sqlite3
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, TypeVar

from sqlalchemy import Connection, Engine, exc, update

from service.errors import AcquisitionError, Busy, Stopping
from service.storage.recording import events
from service.storage.recording.identity import ArchivedMeanwhile
from service.storage.recording.results import RecordOutcome, record
from service.storage.recording.unsaved_result import UnsavedResult
from service.storage.sql.database_file import DatabaseFile, FileLock
from service.storage.sql.engines import TO_WRITE, PersistentConnection, RolledBack, patience
from service.storage.sql.projector_lock import Attempt, NotProjecting, ProjectorLock
from service.storage.sql.statements import execute
from service.storage.sql.tables import WRITTEN_BY_POSTS, event_counter

log = logging.getLogger(__name__)

T = TypeVar("T")

WriteOutcome = RecordOutcome | Exception
WriteOutcomes = list[WriteOutcome]

MAX_QUEUED = 10_000
"""Results that may wait: a matter of seconds."""
TOGETHER = 64
"""The most pieces of work of one transaction."""
MAX_ATTEMPTS = 5
MAX_LOOKS = 5
STALLED_S = 20.0
"""Posts that are not solved by then are a failure; a look-up takes at most five seconds."""
RETRY_AFTER_S = 5
PROBE_BYTES = 1 << 20
"""The probe that readiness writes after a failed write: as much as a batch of many stars."""
PROBE_TABLE = "probe_of_room"

# PostgreSQL's codes for two writers that crossed; it stopped one, which begins again.
_CROSSED = ("40001", "40P01")


@dataclass(frozen=True)
class WriterState:
    """Records that wait to be written, the age of the oldest, and how writing goes."""

    queued: int
    oldest_s: float
    succeeded: bool
    """True if the last write did."""
    failed: int
    """Batches and changes that could not be written since the start."""


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


class Writer:
    """Writes what is queued, from one thread over one connection."""

    def __init__(
        self,
        engine: Engine,
        max_queued: int = MAX_QUEUED,
        *,
        file: DatabaseFile | None = None,
        wait_s: float | None = None,
        lock: ProjectorLock | None = None,
        file_lock: FileLock | None = None,
    ) -> None:
        """`file` is that of SQLite; `wait_s` bounds how long results wait to be written.

        Those of a bulk load, and other changes, wait as long as it takes.  With a `lock` the
        session that holds it projects, and no other one; see `take_lock`.  `file_lock` is taken
        before anything is queued.
        """
        self._lock, self._file_lock = lock, file_lock
        self._connection = PersistentConnection(engine, TO_WRITE, file)
        self._max_queued = max_queued
        self._wait_s = wait_s
        self._failures = 0
        self._is_failing = False
        self._queue: deque[QueuedJob] = deque()
        self._low_priority: deque[QueuedJob] = deque()
        self._has_waited = False
        self._queued = 0
        self._closing = False
        self._changed = threading.Condition()
        self.commits = 0
        """Transactions that were committed, without those of the projector."""
        self.solve_posts: Callable[[Sequence[QueuedJob]], list[QueuedJob]] = list
        """Adds the results of posts; gives those that are to be written now.  Of the others it
        answers some, and puts the rest again with their results.  Called by the writer's thread."""
        self._solving_since_s: float | None = None
        self.after_jobs: list[Callable[[], object]] = []
        """Called by the writer's thread, which waits for it, after each group of jobs: also where
        it failed, or nothing was to be written."""
        self.after_events: list[Callable[[], object]] = []
        """Called after those transactions that recorded events."""
        self._has_events = False
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)
        self._thread.start()

    def record(
        self, unsaved_results: Sequence[UnsavedResult], low_priority: bool = False
    ) -> "Future[WriteOutcomes]":
        """Queue results for one transaction; raises `Busy` when too much is waiting.

        Those of `low_priority` get a transaction of their own, and what else is queued
        goes first.  The future gives one outcome for each, in order: an answer, stored, or the
        error that kept this result, and no other, from being recorded.  Where the database
        itself fails it raises `Busy`.
        """
        done: Future[WriteOutcomes] = Future()
        self.put(QueuedJob(_settling(done), unsaved_results, low_priority=low_priority))
        return done

    def change(self, change: Callable[[Connection], T]) -> "Future[T]":
        """Queue another change, which is kept whole or not at all, and may be made twice over."""
        done: Future[T] = Future()
        self.put(QueuedJob(_settling(done), change=change))
        return done

    def project(self, step: Callable[[Connection], T]) -> "Future[T]":
        """Queue a step of the projector: a change with a transaction of its own.

        It waits for one transaction of other work at most, and the queue is never too full for
        it.  Raises `NotProjecting` where another service that shares the database projects.
        """
        if self._lock is not None:
            self._lock.require()
        return self._put_step(step, needs_lock=True)

    def take_lock(self) -> Attempt:
        """Take the projector's lock, if no other session has it; raises `Busy`."""
        if self._lock is None:
            return "kept"
        return self._put_step(self._lock.take, needs_lock=False).result()

    def _put_step(self, step: Callable[[Connection], T], needs_lock: bool) -> "Future[T]":
        done: Future[T] = Future()
        self.put(QueuedJob(_settling(done), change=step, low_priority=True, needs_lock=needs_lock))
        return done

    def require(self) -> None:
        """Raise `Stopping` unless what is queued will be written."""
        since_s = self._solving_since_s
        is_stalled = since_s is not None and time.monotonic() - since_s > STALLED_S
        if self._closing or is_stalled or not self._thread.is_alive():
            raise Stopping("nothing is recorded any more: restart the service")

    def note_failure(self, count: int) -> None:
        """Count work that could not be written, or not even be looked up before that."""
        with self._changed:
            self._failures += count
            self._is_failing = True

    def require_written(self) -> None:
        """Raise `Busy` where the last write failed, and one of a batch's size fails now, too.

        Otherwise only the next client's batch could show that the database can be
        written again.
        """
        if not self._is_failing:
            return
        before = self._failures
        self.change(_write_as_a_batch).result()
        self.change(remove_probe).result()
        with self._changed:
            self._is_failing = self._failures != before

    def state(self) -> WriterState:
        """The state of the writes and of their queue."""
        with self._changed:
            heads = [queue[0].since_s for queue in (self._queue, self._low_priority) if queue]
            oldest_s = time.monotonic() - min(heads) if heads else 0.0
            return WriterState(self._queued, oldest_s, not self._is_failing, self._failures)

    def close(self) -> None:
        """Refuse new work, write what is queued, and end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        self._connection.close()

    def put(self, job: QueuedJob) -> None:
        """Queue a job, whose `settle` is called by the writer's thread; raises as `record` does."""
        with self._changed:
            if self._closing:
                raise Stopping("the service is stopping")
            if job.pending is None and self._file_lock is not None:
                self._file_lock.take()
            # A job that alone is larger than the queue is still taken by an empty one.
            is_full = self._queued and self._queued + job.weight > self._max_queued
            if is_full and not job.is_projection:
                raise Busy(f"{self._queued} records are waiting to be written")
            (self._low_priority if job.low_priority else self._queue).append(job)
            self._queued += job.weight
            self._changed.notify()

    # ---- the writer's thread -----------------------------------------------------------------

    def _run(self) -> None:
        try:
            while jobs := self._take():
                self._process(jobs)
                self._call_listeners()
        finally:
            # Empty after closing in order; otherwise nothing that is queued will be written.
            with self._changed:
                self._closing = True
                left = [*self._queue, *self._low_priority]
                self._queue.clear()
                self._low_priority.clear()
            for job in left:
                job.settle(Stopping("the writer has ended"))
            self._call_listeners()

    def _take(self) -> list[QueuedJob]:
        """The jobs of the next transaction; empty after `close`."""
        with self._changed:
            while not (self._queue or self._low_priority) and not self._closing:
                self._changed.wait()
            # Low-priority jobs wait for the others, but for one transaction only.
            if self._low_priority and (self._has_waited or not self._queue):
                jobs = [self._low_priority.popleft()]
                self._has_waited = False
            else:
                jobs = [self._queue.popleft() for _ in range(min(TOGETHER, len(self._queue)))]
                self._has_waited = bool(self._low_priority)
            self._queued -= sum(job.weight for job in jobs)
        return jobs

    def _process(self, jobs: Sequence[QueuedJob]) -> None:
        jobs = self._in_time(self._solved(jobs))
        if not jobs:
            return
        try:
            outcomes = self._write(jobs)
        except BaseException as error:
            cause = error.orig if isinstance(error, exc.DBAPIError) else repr(error)
            log.error("%d pieces of work could not be written: %s", len(jobs), cause)
            shown = _error_for_client(error)
            is_trouble = isinstance(shown, Busy) and not isinstance(shown, NotProjecting | Stopping)
            if is_trouble and not jobs[0].is_projection:
                self.note_failure(sum(job.weight for job in jobs))
            for job in jobs:
                job.settle(shown)
            if not isinstance(error, Exception):
                raise
            return
        # Read first: the lock is for the rare case that something changes.  A small change that
        # succeeds says nothing of room for a batch.
        if self._is_failing and any(job.unsaved_results for job in jobs):
            with self._changed:
                self._is_failing = False
        if not jobs[0].is_projection:
            self.commits += 1
        for job, outcome in zip(jobs, outcomes, strict=True):
            job.settle(outcome)

    def _solved(self, jobs: Sequence[QueuedJob]) -> Sequence[QueuedJob]:
        """The jobs, with those posts that have results now."""
        posts = [job for job in jobs if job.pending is not None]
        if not posts:
            return jobs
        self._solving_since_s = time.monotonic()
        try:
            solved = self.solve_posts(posts)
        except Exception as error:
            # The thread goes on for others, and no client waits for ever.
            log.exception("a group of submissions failed")
            for job in posts:
                job.settle(error)
            solved = []
        finally:
            self._solving_since_s = None
        try:
            if solved and self._file_lock is not None:
                self._file_lock.take()
        except AcquisitionError as error:
            for job in solved:
                job.settle(error)
            solved = []
        return [job for job in jobs if job.pending is None] + solved

    def _in_time(self, jobs: Sequence[QueuedJob]) -> Sequence[QueuedJob]:
        """The jobs that have not waited too long; clients of the others are told."""
        if self._wait_s is None:
            return jobs
        since_s = time.monotonic() - self._wait_s
        late = [j for j in jobs if j.since_s < since_s and j.unsaved_results and not j.low_priority]
        if not late:
            return jobs
        self.note_failure(sum(job.weight for job in late))
        for job in late:
            job.settle(Busy("what was to be written before is not written yet", RETRY_AFTER_S))
        return [job for job in jobs if job not in late]

    def _write(self, jobs: Sequence[QueuedJob]) -> list[Any]:
        """Write the jobs in one transaction; a second try is made with care, see `transact`."""
        attempt = 1
        while True:
            # A job of low priority is alone.
            has_time = jobs[0].low_priority
            try:
                with (
                    self._connection.transaction() as connection,
                    patience(connection) if has_time else nullcontext(),
                ):
                    if self._lock is not None and jobs[0].needs_lock:
                        self._lock.require_in(connection)
                    try:
                        outcomes = transact(connection, jobs, careful=attempt > 1)
                    except Exception as error:
                        if attempt > 1 or is_of_the_database(error):
                            raise
                        failure = type(error).__name__
                        log.debug("a transaction is made again, with care: %s", failure)
                        raise RolledBack from error
                    self._has_events = events.noted(connection) > 0
                return outcomes
            except RolledBack:
                pass
            except exc.DBAPIError as error:
                if getattr(error.orig, "sqlstate", None) not in _CROSSED or attempt == MAX_ATTEMPTS:
                    raise
            attempt += 1

    def tell_of_events(self) -> None:
        """Call those who wait for events: another process recorded some."""
        for listener in list(self.after_events):
            listener()

    def _call_listeners(self) -> None:
        listeners = [*self.after_jobs, *(self.after_events if self._has_events else ())]
        self._has_events = False
        for listener in listeners:
            try:
                listener()
            except Exception:
                # The transaction is committed: an error of a listener does not change that.
                log.exception("a listener failed after a commit")


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


def _settling(done: "Future[Any]") -> Callable[[Any], None]:
    """A function that sets a future; the change is made even if the client has gone."""
    done.set_running_or_notify_cancel()

    def settle(outcome: Any) -> None:
        if isinstance(outcome, Exception):
            done.set_exception(outcome)
        else:
            done.set_result(outcome)

    return settle


def _write_as_a_batch(connection: Connection) -> None:
    """Take the locks that a post takes, and write as much as a large batch does."""
    if connection.dialect.name == "postgresql":
        names = ", ".join(sorted(table.name for table in WRITTEN_BY_POSTS))
        connection.exec_driver_sql(f"LOCK TABLE {names} IN ROW EXCLUSIVE MODE")
        connection.exec_driver_sql(
            f"SELECT pg_logical_emit_message(true, 'acquire', repeat('0', {PROBE_BYTES}))"
        )
    else:
        # Of what is written and freed in one transaction SQLite writes nothing.
        connection.exec_driver_sql(f"CREATE TABLE IF NOT EXISTS {PROBE_TABLE} (content BLOB)")
        connection.exec_driver_sql(f"INSERT INTO {PROBE_TABLE} VALUES (zeroblob({PROBE_BYTES}))")
    # There and back: of a row that gets the value it has SQLite writes nothing.
    for step in (1, -1):
        connection.execute(update(event_counter).values(last=event_counter.c.last + step))


def remove_probe(connection: Connection) -> None:
    """Give back what a probe wrote on SQLite, also one of a process that was killed."""
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql(f"DROP TABLE IF EXISTS {PROBE_TABLE}")


def _error_for_client(error: BaseException) -> Exception:
    """The error as clients get it: trouble of the database may pass, so it is `Busy`.

    Its words name files and hosts, which are for the log alone.
    """
    if isinstance(error, exc.DBAPIError) and is_of_the_database(error):
        shown: Exception = Busy("the database cannot be written now", RETRY_AFTER_S)
    elif isinstance(error, Exception):
        return error
    else:
        shown = Stopping("the writer has ended")
    shown.__cause__ = error
    return shown
