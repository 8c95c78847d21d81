"""Connections that are used again and again, and SQLite's driver beneath SQLAlchemy."""

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any

from sqlalchemy import Connection, Engine
from sqlalchemy.exc import DBAPIError, SQLAlchemyError

from service.errors import Busy
from service.storage.sql.database_file import DatabaseFile, FileIdentity


def driver_of(connection: Connection) -> sqlite3.Connection:
    """The driver's connection to SQLite."""
    driver = connection.connection.driver_connection
    assert isinstance(driver, sqlite3.Connection)
    return driver


class TranslatedErrors:
    """Raises errors of SQLite's driver as SQLAlchemy does.

    A class, since every statement enters one, and `contextmanager` takes longer.
    """

    __slots__ = ("_connection", "_sql")

    def __init__(self, connection: Connection, sql: str) -> None:
        self._connection, self._sql = connection, sql

    def __enter__(self) -> sqlite3.Connection:
        return driver_of(self._connection)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: object
    ) -> None:
        if isinstance(error, sqlite3.Error):
            raise DBAPIError.instance(
                self._sql, None, error, sqlite3.Error, dialect=self._connection.dialect
            ) from error


def run_by_driver(connection: Connection, sql: str) -> None:
    """Run a statement of SQLite without a transaction of SQLAlchemy's."""
    with TranslatedErrors(connection, sql) as driver:
        driver.execute(sql)


class RolledBack(Exception):
    """Rolls a transaction back on purpose; the connection stays usable."""


class PersistentConnection:
    """A connection to SQLite that stays open between transactions, which take turns.

    Checking a connection out of a pool takes as long as looking a batch up, and so
    do SQLAlchemy's own steps at the start and end of a transaction: those go to
    SQLite's driver directly.  A connection to a server comes from the pool each
    time, which checks that it is still alive.
    """

    def __init__(
        self,
        engine: Engine,
        begin: str,
        file: DatabaseFile | None = None,
        turn_s: float | None = None,
    ) -> None:
        """`begin` is SQLite's statement that begins a transaction; `file` must stay the same.

        A caller that waits longer than `turn_s` for its turn gets `Busy`.
        """
        self._engine = engine
        self._begin = begin
        self._file = file
        self._log: FileIdentity | None = None
        self._turn_s = -1.0 if turn_s is None else turn_s
        self._is_sqlite = engine.dialect.name == "sqlite"
        self._lock = threading.Lock()
        self._open: Connection | None = None

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """A transaction, committed at the end; after an error the connection is given up.

        After `RolledBack` it is not: nothing is wrong with it.
        """
        with self._exclusive() as connection:
            self._start(connection)
            log = self._log
            try:
                yield connection
                self._end(connection, keep=True)
            except RolledBack:
                self._end(connection, keep=False)
                raise
            except BaseException:
                # Closed while an answer is half read, a connection would keep its lock.
                with suppress(SQLAlchemyError):
                    self._end(connection, keep=False)
                raise
        # Do not acknowledge what was written to a file that has been removed since.
        if self._file is not None:
            self._file.require_log(log)

    @contextmanager
    def lookup(self) -> Iterator[Connection]:
        """A connection for look-ups; on SQLite each prepared statement sees its own snapshot."""
        with self._exclusive() as connection:
            if not self._is_sqlite:
                connection.begin()
            yield connection
            # SQLAlchemy has begun one if it ran a statement itself.
            if connection.in_transaction():
                connection.rollback()

    @contextmanager
    def _exclusive(self) -> Iterator[Connection]:
        if not self._lock.acquire(timeout=self._turn_s):
            raise Busy("too many requests wait for the database", 1)
        try:
            if self._file is not None:
                self._file.require()
            connection = self._open or self._engine.connect()
            self._open = None
            try:
                yield connection
            except RolledBack:
                self._keep(connection)
                raise
            except BaseException:
                # A connection in an unknown state must not serve the next transaction.
                if not self._is_idle(connection):
                    connection.invalidate()
                connection.close()
                raise
            self._keep(connection)
        finally:
            self._lock.release()

    def _is_idle(self, connection: Connection) -> bool:
        """True if a server says that its session is outside of any transaction, after an error.

        The session may hold a lock, which would be lost with it.
        """
        if self._is_sqlite or connection.invalidated or connection.in_transaction():
            return False
        driver: Any = connection.connection.driver_connection
        return bool(driver.info.transaction_status.name == "IDLE")

    def _keep(self, connection: Connection) -> None:
        if self._is_sqlite:
            self._open = connection
        else:
            connection.close()

    def _start(self, connection: Connection) -> None:
        if self._is_sqlite:
            run_by_driver(connection, self._begin)
            if self._file is not None:
                self._log = self._file.log_identity()
        else:
            connection.begin()

    def _end(self, connection: Connection, *, keep: bool) -> None:
        # On SQLite, SQLAlchemy takes part only if it ran a statement itself.
        if not connection.in_transaction():
            run_by_driver(connection, "COMMIT" if keep else "ROLLBACK")
        elif keep:
            connection.commit()
        else:
            connection.rollback()

    def close(self) -> None:
        """Give the connection back."""
        with self._lock:
            if self._open is not None:
                self._open.close()
                self._open = None
