"""The database, open: who writes to it, and how to read from it."""

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection
from sqlalchemy.exc import DBAPIError, TimeoutError

from service.errors import Busy
from service.records.database import bring_up_to_date, require_up_to_date
from service.records.engines import TO_READ, Kept, database_url, reading_engine, writing_engine
from service.records.transaction import may_pass
from service.records.writer import RETRY_AFTER_S, Writer

log = logging.getLogger(__name__)

# Two connections that write and checkpoint at the same moment can lose a transaction.
_WAL_RESET_BUG = (3, 7, 0), (3, 51, 2)


class Readers:
    """Connections that see one moment of a database each, and cannot write."""

    def __init__(self, database: str) -> None:
        """Nothing is connected yet; raises `BadConfiguration` for what is no database's URL."""
        self.url = database_url(database)
        self._readers = reading_engine(self.url)
        self._glances = Kept(self._readers, TO_READ)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that sees one moment of the database and cannot write.

        Raises `Busy` where the database is out of reach or every reader taken.
        """
        with _reported(), self._readers.connect() as connection, connection.begin():
            yield connection

    @contextmanager
    def glancing(self) -> Iterator[Connection]:
        """`reading` by prepared statements, each of which may see another moment.

        Others who glance wait for it.
        """
        with _reported(), self._glances.looking() as connection:
            yield connection

    def close(self) -> None:
        """Let go of the database."""
        self._glances.close()
        self._readers.dispose()


@contextmanager
def _reported() -> Iterator[None]:
    """Say `Busy` of trouble with the database that may pass."""
    try:
        yield
    except TimeoutError as error:
        raise Busy("every connection to the database is in use") from error
    except DBAPIError as error:
        if not may_pass(error):
            raise
        log.error("the database could not be read: %s", error.orig)
        raise Busy("the database cannot be read now", RETRY_AFTER_S) from error


class Store(Readers):
    """The one connection that writes, behind its thread, and the readers."""

    def __init__(self, database: str) -> None:
        """Open a database: SQLite is created and migrated, PostgreSQL must be up to date.

        Raises `BadConfiguration` with what to do.
        """
        self._writing = writing_engine(database_url(database))
        try:
            if self._writing.dialect.name == "sqlite":
                bring_up_to_date(self._writing)
            else:
                require_up_to_date(self._writing)
        except BaseException:
            self._writing.dispose()
            raise
        super().__init__(database)
        self.writer = Writer(self._writing)

    def close(self) -> None:
        """Write what is queued, then let go of the database."""
        self.writer.close()
        # The writer goes last: the last connection to leave checkpoints the log.
        super().close()
        self._writing.dispose()


def warn_of_old_sqlite(database: str) -> None:
    """Log that a database's SQLite is one whose file two processes must not write to."""
    first, last = _WAL_RESET_BUG
    if database_url(database).drivername != "sqlite":
        return
    if first <= sqlite3.sqlite_version_info <= last:
        log.warning(
            "this SQLite (%s) has a known fault when two processes write to one file at the same "
            "moment, mended in 3.51.3: let one process at a time use the database",
            sqlite3.sqlite_version,
        )
