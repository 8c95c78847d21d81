"""Choice of the one service that projects among those on a PostgreSQL database.

Every service accepts and records.  The one that holds the projector's lock also does the work for
all of them: it raises alarms by the clock, delivers webhooks, computes the attitudes of each day
and closes work left by a service that ended.  If it ends, another takes over.
"""

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from service.errors import AcquisitionError
from service.storage.queries.replay_rows import mark_interrupted, unfinished_replays
from service.storage.sql.projector_lock import left_behind
from service.storage.store import Store
from service.times import utc_now

RECOVER_EVERY_S = 2.0
"""Interval in seconds of the check for replays and calibrations without a service.

Work without a service at two checks in a row is marked as interrupted: a service whose session was
cut has taken a new one by the second check.
"""

log = logging.getLogger(__name__)


Unfinished = Callable[[Connection], set[str]]
Interrupt = Callable[[Connection, str, set[str]], object]


@dataclass(frozen=True)
class LeftWork:
    """Kind of work that a service may leave unfinished when it ends."""

    unfinished: Unfinished
    interrupt: Interrupt


def _interrupt_replays(connection: Connection, now: str, ids: set[str]) -> None:
    mark_interrupted(connection, now, only=ids)


class SingleProjector:
    """Competition for the role of projector, which one service on a database has at a time.

    A process without the lock of `Store` always projects: on SQLite, and a command.
    """

    def __init__(self, store: Store) -> None:
        self._store, self._lock = store, store.lock
        self._follow: Callable[[], object] = lambda: None
        self._resume: Callable[[], object] = lambda: None
        self._listeners: list[Callable[[], object]] = []
        self._left_work = [LeftWork(unfinished_replays, _interrupt_replays)]
        self._telling = threading.Lock()
        self._looked_s = 0.0
        self._suspected: set[str] = set()
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def is_projecting(self) -> bool:
        """True if this process projects, to its own knowledge, without asking the database."""
        return self._store.is_projecting

    def start(self, follow: Callable[[], object]) -> None:
        """Start projecting if no other service does; otherwise try again twice a second.

        `follow` is called at each attempt, to take over changes by other services.
        """
        if self._lock is None:
            return
        self._follow = follow
        self._try()
        if not self.is_projecting:
            log.info("another service projects what is recorded; this one takes over if it ends")
        self._thread = threading.Thread(
            target=self._keep_trying, name="single-projector", daemon=True
        )
        self._thread.start()

    def resume_with(self, resume: Callable[[], object]) -> None:
        """Register the function that resumes work of ended services on this machine."""
        self._resume = resume

    def ends_left_work(self, unfinished: Unfinished, interrupt: Interrupt) -> None:
        """Register a kind of work that must be closed after its service has ended.

        `unfinished` gives the ids of all work begun; `interrupt` notes the end of some.
        """
        self._left_work.append(LeftWork(unfinished, interrupt))

    def when_projecting(self, begin: Callable[[], object]) -> None:
        """Call a function when this process starts projecting, each time, and now if it does."""
        with self._telling:
            self._listeners.append(begin)
            if self.is_projecting:
                begin()

    def stop(self) -> None:
        """Stop competing for the lock; a lock that is held ends with its connection."""
        self._stopped.set()
        if self._lock is not None:
            self._lock.lost.set()
        if self._thread is not None:
            self._thread.join()

    def _keep_trying(self) -> None:
        assert self._lock is not None
        while True:
            # A transaction may find out before this thread that the lock is lost.
            self._lock.lost.wait(0.5)
            if self._stopped.is_set():
                return
            self._lock.lost.clear()
            try:
                self._try()
            except (AcquisitionError, SQLAlchemyError) as error:
                log.warning("whether another service projects is not known: %s", error)
            except Exception:
                # This thread must continue: without it the service would never take over.
                log.exception("a look at what other services do failed; it is repeated")

    def _try(self) -> None:
        was_projecting = self.is_projecting
        attempt = self._store.writer.take_lock()
        if attempt == "refused" and was_projecting:
            log.warning("another service projects what is recorded now")
        elif attempt == "taken":
            self._begin()
        self._follow()
        now_s = time.monotonic()
        if attempt != "refused" and now_s - self._looked_s >= RECOVER_EVERY_S:
            self._looked_s = now_s
            self._resume()
            self._end_left_work()

    def _begin(self) -> None:
        with self._telling:
            for begin in self._listeners:
                try:
                    begin()
                except Exception:
                    # The error concerns one part of the service: results are projected in any case.
                    log.exception("work that begins with projecting failed")
        log.info("this service projects what is recorded from now on")

    def _end_left_work(self) -> None:
        """Mark replays and calibrations as interrupted if their service has ended."""
        with self._store.reading_record() as connection:
            ids = {id for each in self._left_work for id in each.unfinished(connection)}
        others = ids - self._store.at_work
        left: set[str] = set()
        if others:
            with self._store.writer.projection() as connection:
                left = left_behind(connection, others)
        ended, self._suspected = left & self._suspected, left
        if ended:
            now = utc_now().text
            with self._store.writer.projection() as connection:
                for each in self._left_work:
                    each.interrupt(connection, now, ended)
