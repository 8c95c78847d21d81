"""The one connection that writes, and the thread behind it.

It takes whatever is queued, writes it in one transaction, commits, and only
then answers those who wait: under load a commit is shared by many, alone it is
waited for by nobody else.  There is no timer.  Chunks of a bulk load, which
have time, are written by themselves, in turn with all else.  A thread that has
a whole group of its own to record does so itself, in its turn: passed from one
processor's cache to another's, the group would cost half as much again.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

from sqlalchemy import Connection, Engine, update
from sqlalchemy.exc import DBAPIError

from service.errors import Busy, Stopping
from service.records.database_file import DatabaseFile
from service.records.draft import Draft, Row
from service.records.engines import TO_WRITE, Kept, TakenBack, patience
from service.records.tables import WRITTEN_BY_POSTS, event_counter
from service.records.transaction import (
    Job,
    Results,
    is_of_the_database,
    transact,
    transact_at_once,
)

log = logging.getLogger(__name__)

T = TypeVar("T")

MAX_QUEUED = 10_000
"""Drafts that may wait: a matter of seconds."""
MAX_ATTEMPTS = 5
RETRY_AFTER_S = 5

# PostgreSQL's words for two writers that crossed; the one it stopped begins again.
_CROSSED = ("40001", "40P01")


@dataclass
class Awaited(Job):
    """A job, and what whoever waits for it is told by."""

    done: "Future[Any]" = field(default_factory=Future)
    since_s: float = field(default_factory=time.monotonic)


class Writer:
    """Writes what is queued, from one thread over one connection."""

    def __init__(
        self,
        engine: Engine,
        max_queued: int = MAX_QUEUED,
        *,
        file: DatabaseFile | None = None,
        turn_s: float | None = None,
    ) -> None:
        """`file` is that of SQLite; `turn_s` bounds how long `record_here` waits for its turn."""
        self._connection = Kept(engine, TO_WRITE, file)
        self._max_queued = max_queued
        self._turn_s = -1.0 if turn_s is None else turn_s
        self._failures = 0
        self._is_failing = False
        self._queue: deque[Awaited] = deque()
        self._patient: deque[Awaited] = deque()
        self._has_waited = False
        self._queued = 0
        self._closing = False
        self._changed = threading.Condition()
        self._turn = threading.Lock()
        self.after_commit: list[Callable[[], object]] = []
        """Called, without being waited for long, when something may have been written."""
        self._thread = threading.Thread(target=self._run, name="writer", daemon=True)
        self._thread.start()

    def record(self, drafts: Sequence[Draft], patient: bool = False) -> "Future[Results]":
        """Queue drafts for one transaction; raises `Busy` when too much is waiting.

        Those of whoever is `patient` get a transaction of their own, and what
        else is queued goes first.

        The future gives one outcome each, in order: an answer, stored; or the
        error that kept this draft, and no other, from being recorded.  Where
        the database itself fails, the future raises `Busy`.
        """
        queue = self._patient if patient else self._queue
        return self._put(Awaited(drafts, patient=patient), queue)

    def record_here(self, drafts: Sequence[Draft], tell: bool = True) -> Results:
        """`record`, in the thread that asks, as soon as nothing else is being written.

        Without `tell` those who listen for commits hear of it from who asks.
        """
        jobs = [Job(drafts)]
        failure = None
        if not self._turn.acquire(timeout=self._turn_s):
            self.note_failure(len(drafts))
            raise Busy("what was to be written before is not written yet", RETRY_AFTER_S)
        try:
            self.require()
            try:
                results: Results = self._write(jobs)[0]
            except Exception as error:
                # Whatever it is, it is logged, and raised in the words for those who wait.
                _log(jobs, error)
                failure = _told(error)
        finally:
            self._turn.release()
        self._note_outcome(jobs, failure)
        if tell:
            self._tell()
        if failure is not None:
            raise failure
        return results

    def change(self, change: Callable[[Connection], T]) -> "Future[T]":
        """Queue another change, which is kept whole or not at all, and may be made twice over."""
        return self._put(Awaited(change=change), self._queue)

    def require(self) -> None:
        """Raise `Stopping` unless what is queued will be written."""
        with self._changed:
            if self._closing or not self._thread.is_alive():
                raise Stopping("nothing is written any more: the service must be started again")

    def note_failure(self, count: int) -> None:
        """Count work that could not be written, or not even be looked up before that."""
        with self._changed:
            self._failures += count
            self._is_failing = True

    def require_written(self) -> None:
        """Raise `Busy` where the last write failed, and one that is tried now fails too.

        Without that nothing but the next client's batch could show that the database
        can be written again.
        """
        if self._is_failing:
            self.change(_try_to_write).result()

    def state(self) -> Row:
        """Whether the last write `succeeded`, how many `failed`, and what waits, since when."""
        with self._changed:
            heads = [queue[0].since_s for queue in (self._queue, self._patient) if queue]
            return {
                "succeeded": not self._is_failing,
                "failed": self._failures,
                "queued": self._queued,
                "oldest_s": time.monotonic() - min(heads) if heads else 0.0,
            }

    def _note_outcome(self, jobs: Sequence[Job], failure: Exception | None) -> None:
        if failure is None:
            # Read first: the lock is for the rare case that something changes.
            if self._is_failing:
                with self._changed:
                    self._is_failing = False
        elif isinstance(failure, Busy) and not isinstance(failure, Stopping):
            self.note_failure(sum(job.weight for job in jobs))

    def close(self) -> None:
        """Refuse new work, write what is queued, and end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        self._connection.close()

    def _put(self, job: Awaited, queue: deque[Awaited]) -> "Future[Any]":
        # A request that is given up does not take its record back.
        job.done.set_running_or_notify_cancel()
        with self._changed:
            if self._closing:
                raise Stopping("the service is stopping")
            # A job that alone is larger than the queue is still taken by an empty one.
            if self._queued and self._queued + job.weight > self._max_queued:
                raise Busy(f"{self._queued} records are waiting to be written")
            queue.append(job)
            self._queued += job.weight
            self._changed.notify()
        return job.done

    def _take(self) -> list[Awaited]:
        """What is written next, in one transaction; nothing when all is over."""
        with self._changed:
            while not (self._queue or self._patient) and not self._closing:
                self._changed.wait()
            # What has time waits for what has none, but for one transaction only.
            if self._patient and (self._has_waited or not self._queue):
                jobs = [self._patient.popleft()]
                self._has_waited = False
            else:
                jobs = list(self._queue)
                self._queue.clear()
                self._has_waited = bool(self._patient)
            self._queued -= sum(job.weight for job in jobs)
        return jobs

    def _run(self) -> None:
        try:
            while jobs := self._take():
                with self._turn:
                    self._settle(jobs)
                self._tell()
        finally:
            # Empty after closing in order; else nobody shall wait for what nobody will write.
            with self._changed:
                self._closing = True
                left = [*self._queue, *self._patient]
                self._queue.clear()
                self._patient.clear()
            for job in left:
                job.done.set_exception(Stopping("the writer has ended"))

    def _settle(self, jobs: Sequence[Awaited]) -> None:
        try:
            outcomes = self._write(jobs)
        except BaseException as error:
            _log(jobs, error)
            self._note_outcome(jobs, _told(error))
            for job in jobs:
                job.done.set_exception(_told(error))
            if not isinstance(error, Exception):
                raise
            return
        self._note_outcome(jobs, None)
        for job, outcome in zip(jobs, outcomes, strict=True):
            if isinstance(outcome, Exception):
                job.done.set_exception(outcome)
            else:
                job.done.set_result(outcome)

    def _tell(self) -> None:
        for told in self.after_commit:
            try:
                told()
            except Exception:
                # What is written is written, whoever listens.
                log.exception("nobody could be told of a commit")

    @contextmanager
    def _transaction(self, jobs: Sequence[Job]) -> Iterator[Connection]:
        has_time = all(job.patient for job in jobs)
        with (
            self._connection.transaction() as connection,
            patience(connection) if has_time else nullcontext(),
        ):
            yield connection

    def _write(self, jobs: Sequence[Job], attempt: int = 1) -> list[Any]:
        try:
            if all(job.change is None for job in jobs):
                with suppress(TakenBack), self._transaction(jobs) as connection:
                    return transact_at_once(connection, jobs)
            with self._transaction(jobs) as connection:
                return transact(connection, jobs)
        except BaseException as error:
            crossed = getattr(getattr(error, "orig", None), "sqlstate", None) in _CROSSED
            if not crossed or attempt == MAX_ATTEMPTS:
                raise
        return self._write(jobs, attempt + 1)


def _try_to_write(connection: Connection) -> None:
    """Take the locks that a post takes, and write a row as it is."""
    if connection.dialect.name == "postgresql":
        names = ", ".join(sorted(table.name for table in WRITTEN_BY_POSTS))
        connection.exec_driver_sql(f"LOCK TABLE {names} IN ROW EXCLUSIVE MODE")
    # There and back: of a row that gets the value it has SQLite writes nothing.
    for step in (1, -1):
        connection.execute(update(event_counter).values(last=event_counter.c.last + step))


def _log(jobs: Sequence[Job], error: BaseException) -> None:
    """Of the database's own errors the log has the cause, without the values it was sent."""
    cause = error.orig if isinstance(error, DBAPIError) else repr(error)
    log.error("%d pieces of work could not be written: %s", len(jobs), cause)


def _told(error: BaseException) -> Exception:
    """The error as those who wait get it: trouble of the database may pass, so it is `Busy`.

    Its words name files and hosts, which are for the log alone.
    """
    if isinstance(error, DBAPIError) and is_of_the_database(error):
        told: Exception = Busy("the database cannot be written now", RETRY_AFTER_S)
    elif isinstance(error, Exception):
        return error
    else:
        told = Stopping("the writer has ended")
    told.__cause__ = error
    return told
