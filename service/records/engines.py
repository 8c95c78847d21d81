"""Connections to the database: one that writes, and readers that cannot.

On SQLite a transaction is begun by name.  The driver's own habit, to begin
before the first write only, turns a read that precedes it into one of another
moment, and a deferred transaction that turns from reading to writing is
refused at once, whatever the busy timeout.
"""

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError
from sqlalchemy.pool import QueuePool

from service.errors import BadConfiguration

BUSY_TIMEOUT_MS = 10_000
WRITER_CACHE_KIB = 32_768
"""Of pages: the inner ones of every index are read with each batch."""
MAX_POSTGRESQL_READERS = 16
"""A server allows a hundred connections as it comes; whoever finds none free waits for one."""

_DRIVERS = {
    "sqlite": "sqlite",
    "postgres": "postgresql+psycopg",
    "postgresql": "postgresql+psycopg",
    "postgresql+psycopg": "postgresql+psycopg",
}


def database_url(text: str) -> URL:
    """The URL of a database that the service can use; raises `BadConfiguration` for any other."""
    try:
        url = make_url(text)
        driver = _DRIVERS[url.drivername]
    except (ArgumentError, KeyError, ValueError):
        # The text may hold a password: it is not shown.
        raise BadConfiguration(
            "ACQUIRE_DATABASE: must be sqlite:///FILE or postgresql://USER@HOST:PORT/DATABASE"
        ) from None
    if driver == "sqlite" and url.database in (None, "", ":memory:"):
        raise BadConfiguration("ACQUIRE_DATABASE: SQLite needs a file, as in sqlite:///acquire.db")
    return url.set(drivername=driver)


def shown_url(url: URL) -> str:
    """The URL for a message, its password hidden."""
    return url.render_as_string(hide_password=True)


def writing_engine(url: URL) -> Engine:
    """The engine of the one connection that writes."""
    if url.drivername != "sqlite":
        return _postgresql(url, pool_size=1, max_overflow=0)
    _check_place(Path(url.database or ""))
    engine = create_engine(url, poolclass=QueuePool, pool_size=1, max_overflow=0)
    # What a savepoint may have to take back is kept in memory: a file would be made for each.
    kept = ("temp_store = MEMORY", f"cache_size = -{WRITER_CACHE_KIB}")
    # The log goes into the file after a thousand pages, as SQLite has it: whoever writes waits for
    # that, of four thousand 20 ms, and nothing is gained.
    _set_up_sqlite(
        engine, "journal_mode = WAL", "synchronous = FULL", *kept, begin="BEGIN IMMEDIATE"
    )
    return engine


def reading_engine(url: URL) -> Engine:
    """The engine of the readers, none of which can write.

    As many connections are kept as were ever in use at once: to open one costs
    more than a dozen reads.
    """
    if url.drivername != "sqlite":
        engine = _postgresql(url, pool_size=MAX_POSTGRESQL_READERS, max_overflow=0)
        return engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
    engine = create_engine(url, poolclass=QueuePool, pool_size=0)
    _set_up_sqlite(engine, "query_only = ON", begin="BEGIN")
    return engine


def _postgresql(url: URL, **pool: int) -> Engine:
    try:
        return create_engine(url, pool_pre_ping=True, **pool)
    except (ModuleNotFoundError, NoSuchModuleError):
        raise BadConfiguration(
            "ACQUIRE_DATABASE: PostgreSQL needs psycopg: install attitude-acquisition[postgresql]"
        ) from None


def _check_place(file: Path) -> None:
    folder = file.absolute().parent
    if not folder.is_dir():
        raise BadConfiguration(f"ACQUIRE_DATABASE: {file}: there is no folder {folder}")
    if file.is_dir():
        raise BadConfiguration(f"ACQUIRE_DATABASE: {file}: is a folder, not a file")


def _set_up_sqlite(engine: Engine, *pragmas: str, begin: str) -> None:
    @event.listens_for(engine, "connect")
    def _connected(connection: sqlite3.Connection, _record: Any) -> None:
        # None: the driver begins nothing by itself; `_begun` below does.
        connection.isolation_level = None
        # The timeout comes first: it also holds for the pragmas that follow.
        for pragma in (f"busy_timeout = {BUSY_TIMEOUT_MS}", "foreign_keys = ON", *pragmas):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def _begun(connection: Connection) -> None:
        # To the driver itself: by way of SQLAlchemy it takes ten times as long.
        with reported(connection, begin) as driver:
            driver.execute(begin)


@contextmanager
def reported(connection: Connection, sql: str) -> Iterator[sqlite3.Connection]:
    """The driver's connection; what it says against a statement is raised as SQLAlchemy would."""
    driver = connection.connection.driver_connection
    assert isinstance(driver, sqlite3.Connection)
    try:
        yield driver
    except sqlite3.Error as error:
        raise DBAPIError.instance(
            sql, None, error, sqlite3.Error, dialect=connection.dialect
        ) from error


class Kept:
    """A connection to SQLite that stays open between its transactions, one at a time.

    To take one out of a pool and put it back takes as long as to look a batch
    up.  A connection to a server comes from the pool each time, which sees
    whether it is still there.
    """

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._lock = threading.Lock()
        self._open: Connection | None = None

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """A transaction, committed at the end; after an error the connection is given up."""
        with self._lock:
            connection = self._open or self._engine.connect()
            self._open = None
            try:
                with connection.begin():
                    yield connection
            except BaseException:
                # The next transaction shall not inherit what this one broke.
                connection.invalidate()
                connection.close()
                raise
            if self._engine.dialect.name == "sqlite":
                self._open = connection
            else:
                connection.close()

    def close(self) -> None:
        """Give the connection back."""
        with self._lock:
            if self._open is not None:
                self._open.close()
                self._open = None
