"""Wakes a service when another one has recorded events on PostgreSQL.

The table of events is the truth; a notification says only that it is worth reading.  A service
whose connection is cut meanwhile reads the table each second all the same.
"""

import logging
import threading
from collections.abc import Callable

from sqlalchemy import URL, create_engine
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.pool import NullPool

CHANNEL = "acquire_events"
WAIT_S = 0.5
"""Between two looks whether the thread is to end."""
RECONNECT_S = 1.0

log = logging.getLogger(__name__)


class HeardEvents:
    """A thread with a connection of its own, which listens until it is closed."""

    def __init__(self, url: URL, heard: Callable[[], object]) -> None:
        """`heard` is called from the thread after commits with events, also those of this one."""
        self._url, self._heard = url, heard
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="heard-events", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread."""
        self._closed.set()
        self._thread.join()

    def _run(self) -> None:
        import psycopg

        engine = create_engine(self._url, poolclass=NullPool, isolation_level="AUTOCOMMIT")
        while not self._closed.is_set():
            try:
                with engine.connect() as connection:
                    driver = connection.connection.driver_connection
                    assert isinstance(driver, psycopg.Connection)
                    driver.execute(f"LISTEN {CHANNEL}")
                    while not self._closed.is_set():
                        if list(driver.notifies(timeout=WAIT_S, stop_after=1)):
                            self._heard()
            except (SQLAlchemyError, psycopg.Error) as error:
                log.info("events of other services are read each second: %s", error)
                self._closed.wait(RECONNECT_S)
            except Exception:
                # An error of a listener must not end the thread that wakes all event streams.
                log.exception("a listener of events failed")
                self._closed.wait(RECONNECT_S)
