"""One service writes to a PostgreSQL database; others stand by, and one of them takes over."""

import logging
import threading
from collections.abc import Callable

from sqlalchemy.exc import SQLAlchemyError

from service.errors import AcquisitionError, Standby
from service.storage.store import Store

TRY_EVERY_S = 1.0

log = logging.getLogger(__name__)


class SingleWriter:
    """Whether this process is the one that writes; `start` makes it so where no other is.

    A process without the lock of `Store` always writes: on SQLite, and a command.
    """

    def __init__(self, store: Store) -> None:
        self._writer, self._lock = store.writer, store.lock
        self._take_over: Callable[[], object] = lambda: None
        self._follow: Callable[[], object] = lambda: None
        self._listeners: list[Callable[[], object]] = []
        self._is_writing = self._lock is None
        self._telling = threading.Lock()
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def is_writing(self) -> bool:
        """Whether this process writes, as far as is known without asking the database."""
        return self._is_writing

    def require(self) -> None:
        """Raise `Standby` where another service writes."""
        if not self._is_writing:
            raise Standby()

    def start(self, take_over: Callable[[], object], follow: Callable[[], object]) -> None:
        """Begin to write if no other service does; else try again every second.

        `take_over` is called before anything else is written, each time that this process begins
        to write: another may have written in between.  While another one writes, `follow` is
        called at each try.
        """
        if self._lock is None:
            take_over()
            return
        self._take_over, self._follow = take_over, follow
        self._try()
        if not self._is_writing:
            log.info("another service writes to the database: this one stands by")
        self._thread = threading.Thread(target=self._keep_trying, name="single-writer", daemon=True)
        self._thread.start()

    def when_writing(self, begin: Callable[[], object]) -> None:
        """Call a function as soon as this process writes, and again each time that it begins to."""
        with self._telling:
            self._listeners.append(begin)
            if self._is_writing:
                begin()

    def stop(self) -> None:
        """Stop trying; a lock that is held ends with its connection."""
        self._stopped.set()
        if self._lock is not None:
            self._lock.lost.set()
        if self._thread is not None:
            self._thread.join()

    def _keep_trying(self) -> None:
        assert self._lock is not None
        while True:
            # A transaction may find before this thread does that the lock is lost.
            self._lock.lost.wait(TRY_EVERY_S)
            if self._stopped.is_set():
                return
            self._lock.lost.clear()
            try:
                self._try()
            except (AcquisitionError, SQLAlchemyError) as error:
                # Nothing is written while the database is out of reach.
                log.warning("whether another service writes is not known: %s", error)
            except Exception:
                log.exception("taking over failed; it is tried again")

    def _try(self) -> None:
        attempt = self._writer.take_lock()
        if attempt == "refused":
            if self._is_writing:
                log.warning("another service writes to the database now: this one stands by")
            self._is_writing = False
            self._follow()
        elif attempt == "taken" or not self._is_writing:
            self._is_writing = False
            try:
                self._take_over()
            except BaseException:
                # Another service may be able to.
                self._writer.give_lock()
                raise
            with self._telling:
                self._is_writing = True
                for begin in self._listeners:
                    try:
                        begin()
                    except Exception:
                        # It belongs to one part of the service: posts are taken in any case.
                        log.exception("work that begins with writing failed")
            log.info("this service writes to the database from now on")
