"""Pool of connections that read a database."""

import logging
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager

from sqlalchemy import Connection, event
from sqlalchemy.exc import DBAPIError, TimeoutError

from service.errors import Busy
from service.storage.recording.writer import RETRY_AFTER_S, may_pass
from service.storage.sql import engines
from service.storage.sql.database_file import DatabaseFile
from service.storage.sql.engines import PersistentConnection

log = logging.getLogger(__name__)


class Readers:
    """Pool of read-only connections, each with one snapshot of a database."""

    def __init__(
        self,
        database: str,
        *,
        serving: bool = False,
        file: DatabaseFile | None = None,
    ) -> None:
        """Prepare the pool without connecting; raises `BadConfiguration` for an invalid URL.

        With `serving`, waiting for a database that does not answer is bounded.  SQLite's file must
        not be replaced afterwards.
        """
        self.url = engines.database_url(database)
        self.file = file or engines.database_file(self.url)
        if self.file is not None:
            self.file.remember()
        self._readers = engines.reading_engine(self.url, engines.TO_SHOW if serving else None)
        self._lookup_engine = self._readers
        if serving and self.file is None:
            self._lookup_engine = engines.reading_engine(self.url, engines.TO_LOOK_UP, 1)
        self._lookup_connection = PersistentConnection(
            self._lookup_engine,
            engines.TO_READ,
            self.file,
            engines.LONGEST_WAIT_S if serving else None,
        )

    def reading(self) -> AbstractContextManager[Connection]:
        """Context manager of a read-only connection with one snapshot of the database."""
        return self.reading_record()

    @contextmanager
    def reading_record(self) -> Iterator[Connection]:
        """Context manager of a read-only connection that does not wait for projections.

        Raises `Busy` where the database cannot be reached or every connection is in use.
        """
        if self.file is not None:
            self.file.require()
        with _unavailable_is_busy(), self._readers.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def lookup(self) -> Iterator[Connection]:
        """Context manager of a connection for look-ups, each of which may see another snapshot.

        Look-ups take turns.
        """
        with _unavailable_is_busy(), self._lookup_connection.lookup() as connection:
            yield connection

    def close(self) -> None:
        """Close the pool; reads in progress continue to their end."""
        self._lookup_connection.close()
        for engine in (self._lookup_engine, self._readers):
            # Otherwise a connection returned later would stay open in a discarded pool.
            event.listen(engine, "checkin", lambda _, entry: entry.close())
            engine.dispose()


@contextmanager
def _unavailable_is_busy() -> Iterator[None]:
    """Context manager that turns a passing fault of the database into `Busy`."""
    try:
        yield
    except TimeoutError as error:
        raise Busy("every connection to the database is in use") from error
    except DBAPIError as error:
        if not may_pass(error):
            raise
        log.error("the database could not be read: %s", error.orig)
        raise Busy("the database cannot be read now", RETRY_AFTER_S) from error
