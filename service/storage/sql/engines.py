"""Database connections: one that writes, readers that cannot, and SQLite's driver below them.

On SQLite every transaction begins with an explicit statement.  By default the driver begins before
the first write only: an earlier read would then see another moment.  A deferred transaction that
turns from reading to writing is refused at once, whatever the busy timeout.
"""

import os
import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError, SQLAlchemyError
from sqlalchemy.pool import QueuePool

from service.errors import BadConfiguration, Busy
from service.storage.sql.database_file import DatabaseFile, FileIdentity
from service.storage.sql.dialects import dialect_of

if TYPE_CHECKING:
    from psycopg.abc import PQGen


def driver_of(connection: Connection) -> sqlite3.Connection:
    """The SQLite driver's own connection behind a connection of SQLAlchemy."""
    driver = connection.connection.driver_connection
    assert isinstance(driver, sqlite3.Connection)
    return driver


class TranslatedErrors:
    """Context manager that raises errors of SQLite's driver as SQLAlchemy does.

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
    """Run an SQL statement on SQLite outside of SQLAlchemy's transactions."""
    with TranslatedErrors(connection, sql) as driver:
        driver.execute(sql)


class RolledBack(Exception):
    """Exception that rolls a transaction back on purpose; the connection stays usable."""


class PersistentConnection:
    """Connection that stays open between SQLite transactions, which take turns.

    Checking a connection out of a pool takes as long as looking a batch up, and so do SQLAlchemy's
    own steps at the start and end of a transaction: SQLite's driver runs these statements directly.
    A connection to a server comes from the pool each time, which checks that the connection is
    still alive.
    """

    def __init__(
        self,
        engine: Engine,
        begin: str,
        file: DatabaseFile | None = None,
        turn_s: float | None = None,
    ) -> None:
        """Prepare a connection without opening it; `begin` is SQLite's statement for a transaction.

        `file` must stay the same.  A caller that waits longer than `turn_s` for its turn gets
        `Busy`.
        """
        self._engine = engine
        self._begin = begin
        self._file = file
        self._log: FileIdentity | None = None
        self._turn_s = -1.0 if turn_s is None else turn_s
        self._is_shared = dialect_of(engine).is_shared
        self._lock = threading.Lock()
        self._open: Connection | None = None

    @contextmanager
    def transaction(self) -> Iterator[Connection]:
        """Context manager of a transaction that commits at the end; an error closes the connection.

        `RolledBack` is no such error: the connection stays open.
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
                # Close the connection: with an answer half read it would keep its lock.
                with suppress(SQLAlchemyError):
                    self._end(connection, keep=False)
                raise
        # A write to a file that was removed meanwhile must not be acknowledged.
        if self._file is not None:
            self._file.require_log(log)

    @contextmanager
    def lookup(self) -> Iterator[Connection]:
        """Context manager of a connection for look-ups; on SQLite each sees its own snapshot."""
        with self._exclusive() as connection:
            if self._is_shared:
                connection.begin()
            yield connection
            # SQLAlchemy has begun a transaction if it ran a statement itself.
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
        """True if a server reports, after an error, that its session is outside of any transaction.

        Such a session is kept: it may hold a lock, which would be lost with it.
        """
        if not self._is_shared or connection.invalidated or connection.in_transaction():
            return False
        driver: Any = connection.connection.driver_connection
        return bool(driver.info.transaction_status.name == "IDLE")

    def _keep(self, connection: Connection) -> None:
        if not self._is_shared:
            self._open = connection
        else:
            connection.close()

    def _start(self, connection: Connection) -> None:
        if not self._is_shared:
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
        """Close the connection, or return it to its pool."""
        with self._lock:
            if self._open is not None:
                self._open.close()
                self._open = None


RV = TypeVar("RV")

BUSY_TIMEOUT_MS = 10_000
WRITER_CACHE_KIB = 32_768
"""Size in KiB of the writing connection's page cache, for the inner pages of every index."""
TO_WRITE, TO_READ = "BEGIN IMMEDIATE", "BEGIN"
"""SQLite statements that begin a transaction of the writing connection, and of a reader."""
MAX_READERS = 16
"""Largest number of reading connections of a process; further readers wait for a free one.

PostgreSQL allows a hundred connections by default; each of SQLite's keeps two megabytes of pages,
and its reader a page of answers.
"""


@dataclass(frozen=True)
class Timeouts:
    """Database timeouts in seconds that hold while a client waits for an answer.

    `lock_s` bounds the wait for a lock, `statement_s` a statement; the server's reply to a
    statement may take `MORE_S` longer.
    """

    lock_s: float
    statement_s: float
    idle_s: float = 0.0
    """Idle time in seconds after which a server ends an open transaction and frees its locks."""
    lost_s: int = 0
    """Seconds without a sign of life from a client after which a server ends its session."""


# A post waits at most 5 s for its turn, then for one look-up, the turn to write and one
# transaction; one of these ends with a timeout: 15 s in all.
TO_LOOK_UP = Timeouts(lock_s=2.0, statement_s=3.0)
TO_COMMIT = Timeouts(lock_s=2.0, statement_s=4.0, idle_s=30.0, lost_s=6)
TO_SHOW = Timeouts(lock_s=2.0, statement_s=12.0)
"""Timeouts for pages and lists, which may read many rows."""
PATIENT_S = 60.0
"""Timeout in seconds for a statement of a bulk load, which no post waits for."""
MORE_S = 1.0
PING_S = 2.0
"""Timeout in seconds of the check that a pooled connection is still alive."""
CONNECT_S, TCP_USER_TIMEOUT_S = 2, 8
FREE_S = 10.0
"""Longest wait for a free reading connection, in seconds."""
LONGEST_WAIT_S = 2.0
"""Longest wait in seconds before a look-up or a write begins."""

SECRETS = ("password", "sslpassword")
"""Names of secrets in the query part of a PostgreSQL URL."""

_DRIVERS = {
    "sqlite": "sqlite",
    "postgres": "postgresql+psycopg",
    "postgresql": "postgresql+psycopg",
    "postgresql+psycopg": "postgresql+psycopg",
}


def database_url(text: str) -> URL:
    """Parse the URL of a supported database; raises `BadConfiguration` for any other text."""
    try:
        url = make_url(text)
        driver = _DRIVERS[url.drivername]
    except (ArgumentError, KeyError, ValueError):
        # The text may hold a password: leave it out of the message.
        raise BadConfiguration(
            "ACQUIRE_DATABASE: must be sqlite:///FILE or postgresql://USER@HOST:PORT/DATABASE"
        ) from None
    if url.password is not None and "@" in f"{url.host}{url.database}":
        # Part of the password stands where host and database should be.
        raise BadConfiguration(
            "ACQUIRE_DATABASE: more than one @: in a password write it as %40 (and % as %25), or "
            "leave the password out and set PGPASSWORD"
        )
    if driver == "sqlite" and url.database in (None, "", ":memory:"):
        raise BadConfiguration("ACQUIRE_DATABASE: SQLite needs a file, as in sqlite:///acquire.db")
    return url.set(drivername=driver)


def shown_url(url: URL) -> str:
    """Format a database URL for a message, passwords hidden, including those in its query part."""
    hidden = {name: "***" for name in SECRETS if name in url.query}
    return url.update_query_dict(hidden).render_as_string(hide_password=True)


def database_file(url: URL) -> DatabaseFile | None:
    """File of a SQLite database, from its URL; None for a database server."""
    if url.drivername != "sqlite":
        return None
    return DatabaseFile(Path(url.database or "").absolute())


def writing_engine(
    url: URL,
    *,
    file: DatabaseFile | None = None,
    create: bool = True,
    timeouts: Timeouts | None = None,
) -> Engine:
    """Create the engine of the one connection that writes.

    SQLite's file is created by the first connection, where `create` allows it, and by no other;
    `file` remembers its identity.  Without `timeouts` the connection waits for as long as it takes.
    """
    if url.drivername != "sqlite":
        return _postgresql(url, timeouts, pool_size=1, max_overflow=0)
    _check_place(Path(url.database or ""))
    engine = create_engine(url, poolclass=QueuePool, pool_size=1, max_overflow=0)
    _open_as_file(engine, file, create)
    # Savepoints are journalled in memory: otherwise SQLite makes a file for each.
    kept = ("temp_store = MEMORY", f"cache_size = -{WRITER_CACHE_KIB}")
    # Keep SQLite's default checkpoint after a thousand pages: with four thousand the writer waits
    # 20 ms for each checkpoint and gains nothing.
    pragmas = ("journal_mode = WAL", "synchronous = FULL", *kept)
    _set_up_sqlite(engine, *pragmas, begin=TO_WRITE, timeouts=timeouts)
    return engine


def reading_engine(url: URL, timeouts: Timeouts | None = None, most: int = MAX_READERS) -> Engine:
    """Create the engine of the reading connections, none of which can write.

    The pool keeps as many connections as were ever in use at once, up to `most`: opening one costs
    more than a dozen reads.
    """
    pool: dict[str, Any] = {"pool_size": most, "max_overflow": 0}
    if timeouts is not None:
        pool["pool_timeout"] = FREE_S
    if url.drivername != "sqlite":
        engine = _postgresql(url, timeouts, **pool)
        return engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
    engine = create_engine(url, poolclass=QueuePool, **pool)
    _open_as_file(engine)
    _set_up_sqlite(engine, "query_only = ON", begin=TO_READ, timeouts=timeouts)
    return engine


def _postgresql(url: URL, timeouts: Timeouts | None, **pool: Any) -> Engine:
    try:
        if timeouts is None:
            return create_engine(url, pool_pre_ping=True, **pool)
        return _bounded(url, timeouts, pool)
    except (ModuleNotFoundError, NoSuchModuleError):
        raise BadConfiguration(
            "ACQUIRE_DATABASE: PostgreSQL needs psycopg: install attitude-acquisition[postgresql]"
        ) from None


def _bounded(url: URL, timeouts: Timeouts, pool: dict[str, Any]) -> Engine:
    """Create a PostgreSQL engine with bounded waits; bounds given in the URL take precedence."""
    import psycopg

    class BoundedConnection(psycopg.Connection[tuple[object, ...]]):
        """PostgreSQL connection that is closed if an answer takes longer than `answer_s`.

        A server's own timeouts hold only while it runs.  A stopped server, or a proxy before it,
        acknowledges every packet and never answers.
        """

        answer_s = timeouts.statement_s + MORE_S

        def wait(self, gen: "PQGen[RV]", interval: float = 0.1, timeout: float | None = None) -> RV:
            """Wait for a statement to end; raises `OperationalError` after the timeout."""
            if timeout is None:
                # Outside of any transaction SQLAlchemy only checks that the connection is alive.
                timeout = min(PING_S, self.answer_s) if self.autocommit else self.answer_s
            try:
                return super().wait(gen, interval, timeout)
            except psycopg.errors._WaitTimeout as error:
                # The state of the server is unknown: the connection is not used again.
                self.pgconn.finish()
                raise psycopg.OperationalError(f"no answer within {timeout:g} s") from error

    seconds = {
        "lock_timeout": timeouts.lock_s,
        "statement_timeout": timeouts.statement_s,
        "idle_in_transaction_session_timeout": timeouts.idle_s,
    }
    options = [f"-c {name}={round(1000 * value)}" for name, value in seconds.items()]
    if timeouts.lost_s:
        third = timeouts.lost_s // 3
        options += [f"-c tcp_keepalives_idle={third}", f"-c tcp_keepalives_interval={third}"]
        options += ["-c tcp_keepalives_count=2", f"-c tcp_user_timeout={1000 * timeouts.lost_s}"]
    own = url.query.get("options", ())
    options += [own] if isinstance(own, str) else own
    defaults: dict[str, Any] = {
        "connect_timeout": CONNECT_S,
        "tcp_user_timeout": 1000 * TCP_USER_TIMEOUT_S,
    }
    arguments = {name: value for name, value in defaults.items() if name not in url.query}
    arguments["options"] = " ".join(options)
    engine = create_engine(url, pool_pre_ping=True, connect_args=arguments, **pool)

    @event.listens_for(engine, "do_connect")
    def _connect(_dialect: Any, _record: Any, cargs: Any, cparams: Any) -> Any:
        return BoundedConnection.connect(*cargs, **cparams)

    return engine


def _open_as_file(engine: Engine, file: DatabaseFile | None = None, create: bool = False) -> None:
    """Make an engine open SQLite files by URI, creating a missing file at most once if `create`."""
    may_create = create

    @event.listens_for(engine, "do_connect")
    def _connect(_dialect: Any, _record: Any, cargs: Any, cparams: Any) -> Any:
        nonlocal may_create
        place, *others = cargs
        opened = DatabaseFile(Path(place).absolute())
        if may_create:
            os.close(opened.create())
        connection = sqlite3.connect(opened.uri, *others, **(cparams | {"uri": True}))
        may_create = False
        if file is not None:
            file.remember()
        return connection


def _check_place(file: Path) -> None:
    folder = file.absolute().parent
    if not folder.is_dir():
        raise BadConfiguration(f"ACQUIRE_DATABASE: {file}: there is no folder {folder}")
    if file.is_dir():
        raise BadConfiguration(f"ACQUIRE_DATABASE: {file}: is a folder, not a file")


def _set_up_sqlite(
    engine: Engine, *pragmas: str, begin: str, timeouts: Timeouts | None = None
) -> None:
    busy_ms = BUSY_TIMEOUT_MS if timeouts is None else round(1000 * timeouts.lock_s)

    @event.listens_for(engine, "connect")
    def _connected(connection: sqlite3.Connection, _record: Any) -> None:
        # With None the driver begins no transaction by itself; `_begun` below does.
        connection.isolation_level = None
        # Set the timeout first: it also holds for the pragmas that follow.
        for pragma in (f"busy_timeout = {busy_ms}", "foreign_keys = ON", *pragmas):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def _begun(connection: Connection) -> None:
        # If `PersistentConnection` has begun a transaction, SQLAlchemy joins it.
        if not driver_of(connection).in_transaction:
            run_by_driver(connection, begin)


@contextmanager
def patience(connection: Connection) -> Iterator[None]:
    """Context manager that extends the timeouts of a transaction beyond those of a post."""
    driver: Any = connection.connection.driver_connection
    answer_s = getattr(driver, "answer_s", None)
    if answer_s is None:
        yield
        return
    connection.exec_driver_sql(f"SET LOCAL statement_timeout = {round(1000 * PATIENT_S)}")
    driver.answer_s = PATIENT_S + MORE_S
    try:
        yield
    finally:
        driver.answer_s = answer_s
