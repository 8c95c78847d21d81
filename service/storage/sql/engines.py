"""Connections to the database: one that writes, readers that cannot, and SQLite's driver below.

On SQLite a transaction is begun by name.  The driver's own habit, to begin
before the first write only, turns a read that precedes it into one of another
moment, and a deferred transaction that turns from reading to writing is
refused at once, whatever the busy timeout.
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
        self._is_shared = dialect_of(engine).is_shared
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
            if self._is_shared:
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
        """Give the connection back."""
        with self._lock:
            if self._open is not None:
                self._open.close()
                self._open = None


RV = TypeVar("RV")

BUSY_TIMEOUT_MS = 10_000
WRITER_CACHE_KIB = 32_768
"""The size of the cache of pages: the inner ones of every index are read with each batch."""
TO_WRITE, TO_READ = "BEGIN IMMEDIATE", "BEGIN"
"""How SQLite begins a transaction of the one connection that writes, and of a reader."""
MAX_READERS = 16
"""Readers at once in a process; others wait for a free one.

PostgreSQL allows a hundred connections by default; each of SQLite's keeps two megabytes
of pages, and its reader a page of answers.
"""


@dataclass(frozen=True)
class Timeouts:
    """How long a connection waits while a client waits for the answer.

    `lock_s` for a lock that another holds, `statement_s` for a statement; for the
    server's answer to it `MORE_S` longer.
    """

    lock_s: float
    statement_s: float
    idle_s: float = 0.0
    """The idle time after which a server ends an open transaction, and frees its locks."""
    lost_s: int = 0
    """The time without a sign of life from a client after which a server ends its session."""


# A post waits at most 5 s for its turn, then for one look-up, for the turn to write and for one
# transaction, of which one ends with a time-out: 15 s in all.
TO_LOOK_UP = Timeouts(lock_s=2.0, statement_s=3.0)
TO_COMMIT = Timeouts(lock_s=2.0, statement_s=4.0, idle_s=30.0, lost_s=6)
TO_SHOW = Timeouts(lock_s=2.0, statement_s=12.0)
"""Timeouts for pages and lists, some of which read much."""
PATIENT_S = 60.0
"""The timeout of a statement of a bulk load, which has time: posts do not wait for it."""
MORE_S = 1.0
PING_S = 2.0
"""The timeout of the question whether a pooled connection is still there."""
CONNECT_S, TCP_USER_TIMEOUT_S = 2, 8
FREE_S = 10.0
"""The longest wait for a reader's connection that is free."""
LONGEST_WAIT_S = 2.0
"""The longest wait of a look-up, or of what is to be written, before it begins."""

SECRETS = ("password", "sslpassword")
"""Secrets in the query part of a URL of PostgreSQL."""

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
    if url.password is not None and "@" in f"{url.host}{url.database}":
        # A part of the password stands where host and database should.
        raise BadConfiguration(
            "ACQUIRE_DATABASE: more than one @: in a password write it as %40 (and % as %25), or "
            "leave the password out and set PGPASSWORD"
        )
    if driver == "sqlite" and url.database in (None, "", ":memory:"):
        raise BadConfiguration("ACQUIRE_DATABASE: SQLite needs a file, as in sqlite:///acquire.db")
    return url.set(drivername=driver)


def shown_url(url: URL) -> str:
    """The URL for a message, its password hidden, also where the query part has it."""
    hidden = {name: "***" for name in SECRETS if name in url.query}
    return url.update_query_dict(hidden).render_as_string(hide_password=True)


def database_file(url: URL) -> DatabaseFile | None:
    """The file of a SQLite database; None for a server."""
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
    """The engine of the one connection that writes.

    SQLite's file is created by the first connection, where `create` allows it, and by
    no other; `file` remembers which one it is.  Without `timeouts` the connection waits for
    as long as it takes.
    """
    if url.drivername != "sqlite":
        return _postgresql(url, timeouts, pool_size=1, max_overflow=0)
    _check_place(Path(url.database or ""))
    engine = create_engine(url, poolclass=QueuePool, pool_size=1, max_overflow=0)
    _open_as_file(engine, file, create)
    # Savepoints are journalled in memory: otherwise SQLite makes a file for each.
    kept = ("temp_store = MEMORY", f"cache_size = -{WRITER_CACHE_KIB}")
    # SQLite's default checkpoint after a thousand pages stays: with four thousand the writer waits
    # 20 ms for each, and nothing is gained.
    pragmas = ("journal_mode = WAL", "synchronous = FULL", *kept)
    _set_up_sqlite(engine, *pragmas, begin=TO_WRITE, timeouts=timeouts)
    return engine


def reading_engine(url: URL, timeouts: Timeouts | None = None, most: int = MAX_READERS) -> Engine:
    """The engine of the readers, none of which can write.

    As many connections are kept as were ever in use at once, up to `most`: to
    open one costs more than a dozen reads.
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
    """An engine whose connections wait no longer than the timeouts; what the URL says holds."""
    import psycopg

    class BoundedConnection(psycopg.Connection[tuple[object, ...]]):
        """A connection that is closed once an answer takes longer than `answer_s`.

        A server's own time-outs hold as long as it runs.  A server that is stopped, or a
        proxy before it, acknowledges every packet and never answers.
        """

        answer_s = timeouts.statement_s + MORE_S

        def wait(self, gen: "PQGen[RV]", interval: float = 0.1, timeout: float | None = None) -> RV:
            """Let a statement run to its end; raises `OperationalError` where it takes long."""
            if timeout is None:
                # SQLAlchemy asks whether the connection is there outside of any transaction.
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
    """Let SQLite create a file with the first connection at most, where that is allowed."""
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
        # None: the driver begins nothing by itself; `_begun` below does.
        connection.isolation_level = None
        # The timeout comes first: it also holds for the pragmas that follow.
        for pragma in (f"busy_timeout = {busy_ms}", "foreign_keys = ON", *pragmas):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def _begun(connection: Connection) -> None:
        # If `PersistentConnection` has begun one, SQLAlchemy joins it.
        if not driver_of(connection).in_transaction:
            run_by_driver(connection, begin)


@contextmanager
def patience(connection: Connection) -> Iterator[None]:
    """Let the statements of a transaction take longer than those that a post waits for."""
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
