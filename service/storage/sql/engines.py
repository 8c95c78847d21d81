"""Connections to the database: one that writes, and readers that cannot.

On SQLite a transaction is begun by name.  The driver's own habit, to begin
before the first write only, turns a read that precedes it into one of another
moment, and a deferred transaction that turns from reading to writing is
refused at once, whatever the busy timeout.
"""

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError, SQLAlchemyError
from sqlalchemy.pool import QueuePool

from service.errors import BadConfiguration, Busy
from service.storage.sql.database_file import DatabaseFile, FileIdentity

BUSY_TIMEOUT_MS = 10_000
WRITER_CACHE_KIB = 32_768
"""Of pages: the inner ones of every index are read with each batch."""
TO_WRITE, TO_READ = "BEGIN IMMEDIATE", "BEGIN"
"""How SQLite begins a transaction of the one connection that writes, and of a reader."""
MAX_READERS = 16
"""At once in a process; whoever finds none free waits for one.

PostgreSQL allows a hundred connections as it comes; of SQLite each keeps two megabytes
of pages, and whoever computes beside it a page of answers.
"""


@dataclass(frozen=True)
class Bounds:
    """How long a connection waits where somebody waits for the service to answer.

    `lock_s` for a lock that another holds, `statement_s` for a statement; for the
    server's answer to it `MORE_S` longer.
    """

    lock_s: float
    statement_s: float
    idle_s: float = 0.0
    """After so long a server ends a transaction whose client asks nothing, and frees its locks."""


# A post waits at most 5 s for its turn, then for one look-up, for the turn to write and for one
# transaction, of which one ends with a time-out: 15 s in all.
TO_LOOK_UP = Bounds(lock_s=2.0, statement_s=3.0)
TO_COMMIT = Bounds(lock_s=2.0, statement_s=4.0, idle_s=30.0)
TO_SHOW = Bounds(lock_s=2.0, statement_s=12.0)
"""For pages and lists, some of which read much."""
PATIENT_S = 60.0
"""For a statement of a bulk load, which has time: posts do not wait for it."""
MORE_S = 1.0
CONNECT_S, TCP_USER_TIMEOUT_S = 2, 8
FREE_S = 10.0
"""The longest wait for a reader's connection that is free."""
TURN_S = 2.0
"""The longest wait for the turn of one who looks up or writes."""

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
    bounds: Bounds | None = None,
) -> Engine:
    """The engine of the one connection that writes.

    SQLite's file is created by the first connection, where `create` allows it, and by
    no other; `file` remembers which one it is.  Without `bounds` the connection waits for
    as long as it takes.
    """
    if url.drivername != "sqlite":
        return _postgresql(url, bounds, pool_size=1, max_overflow=0)
    _check_place(Path(url.database or ""))
    engine = create_engine(url, poolclass=QueuePool, pool_size=1, max_overflow=0)
    _open_as_file(engine, file, create)
    # What a savepoint may have to take back is kept in memory: a file would be made for each.
    kept = ("temp_store = MEMORY", f"cache_size = -{WRITER_CACHE_KIB}")
    # The log goes into the file after a thousand pages, as SQLite has it: whoever writes waits for
    # that, of four thousand 20 ms, and nothing is gained.
    pragmas = ("journal_mode = WAL", "synchronous = FULL", *kept)
    _set_up_sqlite(engine, *pragmas, begin=TO_WRITE, bounds=bounds)
    return engine


def reading_engine(url: URL, bounds: Bounds | None = None, most: int = MAX_READERS) -> Engine:
    """The engine of the readers, none of which can write.

    As many connections are kept as were ever in use at once, up to `most`: to
    open one costs more than a dozen reads.
    """
    pool: dict[str, Any] = {"pool_size": most, "max_overflow": 0}
    if bounds is not None:
        pool["pool_timeout"] = FREE_S
    if url.drivername != "sqlite":
        engine = _postgresql(url, bounds, **pool)
        return engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
    engine = create_engine(url, poolclass=QueuePool, **pool)
    _open_as_file(engine)
    _set_up_sqlite(engine, "query_only = ON", begin=TO_READ, bounds=bounds)
    return engine


def _postgresql(url: URL, bounds: Bounds | None, **pool: Any) -> Engine:
    try:
        if bounds is None:
            return create_engine(url, pool_pre_ping=True, **pool)
        return _bounded(url, bounds, pool)
    except (ModuleNotFoundError, NoSuchModuleError):
        raise BadConfiguration(
            "ACQUIRE_DATABASE: PostgreSQL needs psycopg: install attitude-acquisition[postgresql]"
        ) from None


def _bounded(url: URL, bounds: Bounds, pool: dict[str, Any]) -> Engine:
    """An engine whose connections wait no longer than the bounds; what the URL says holds."""
    from service.storage.sql.postgresql import BoundedConnection

    seconds = {
        "lock_timeout": bounds.lock_s,
        "statement_timeout": bounds.statement_s,
        "idle_in_transaction_session_timeout": bounds.idle_s,
    }
    options = [f"-c {name}={round(1000 * value)}" for name, value in seconds.items()]
    own = url.query.get("options", ())
    options += [own] if isinstance(own, str) else own
    given: dict[str, Any] = {
        "connect_timeout": CONNECT_S,
        "tcp_user_timeout": 1000 * TCP_USER_TIMEOUT_S,
    }
    arguments = {name: value for name, value in given.items() if name not in url.query}
    arguments["options"] = " ".join(options)
    engine = create_engine(url, pool_pre_ping=True, connect_args=arguments, **pool)

    @event.listens_for(engine, "do_connect")
    def _connect(_dialect: Any, _record: Any, cargs: Any, cparams: Any) -> Any:
        connection = BoundedConnection.connect(*cargs, **cparams)
        connection.answer_s = bounds.statement_s + MORE_S
        return connection

    return engine


def _open_as_file(engine: Engine, file: DatabaseFile | None = None, create: bool = False) -> None:
    """Let SQLite create a file with the first connection at most, where that is allowed."""
    may_create = create

    @event.listens_for(engine, "do_connect")
    def _connect(_dialect: Any, _record: Any, cargs: Any, cparams: Any) -> Any:
        nonlocal may_create
        place, *others = cargs
        uri = f"{Path(place).absolute().as_uri()}?mode={'rwc' if may_create else 'rw'}"
        connection = sqlite3.connect(uri, *others, **(cparams | {"uri": True}))
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


def _set_up_sqlite(engine: Engine, *pragmas: str, begin: str, bounds: Bounds | None = None) -> None:
    busy_ms = BUSY_TIMEOUT_MS if bounds is None else round(1000 * bounds.lock_s)

    @event.listens_for(engine, "connect")
    def _connected(connection: sqlite3.Connection, _record: Any) -> None:
        # None: the driver begins nothing by itself; `_begun` below does.
        connection.isolation_level = None
        # The timeout comes first: it also holds for the pragmas that follow.
        for pragma in (f"busy_timeout = {busy_ms}", "foreign_keys = ON", *pragmas):
            connection.execute(f"PRAGMA {pragma}")

    @event.listens_for(engine, "begin")
    def _begun(connection: Connection) -> None:
        # Where `Kept` has begun, SQLAlchemy takes part in what is going on.
        if not driver_of(connection).in_transaction:
            _by_driver(connection, begin)


def driver_of(connection: Connection) -> sqlite3.Connection:
    """The driver's connection to SQLite."""
    driver = connection.connection.driver_connection
    assert isinstance(driver, sqlite3.Connection)
    return driver


class Reported:
    """What SQLite's driver says against a statement is raised as SQLAlchemy would.

    A class, since there is one about every statement, and `contextmanager` takes longer.
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


def _by_driver(connection: Connection, sql: str) -> None:
    with Reported(connection, sql) as driver:
        driver.execute(sql)


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


class TakenBack(Exception):
    """Ends a transaction that is to leave nothing behind, and with which nothing is wrong."""


class Kept:
    """A connection to SQLite that stays open between its transactions, one at a time.

    To take one out of a pool and put it back takes as long as to look a batch
    up, and so do SQLAlchemy's own steps about a transaction: SQLite's driver is
    told by itself when one begins and ends.  A connection to a server comes from
    the pool each time, which sees whether it is still there.
    """

    def __init__(
        self,
        engine: Engine,
        begin: str,
        file: DatabaseFile | None = None,
        turn_s: float | None = None,
    ) -> None:
        """`begin` is SQLite's statement for it, `file` must stay the same.

        Who waits for `turn_s` while others use it gets `Busy`.
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

        After `TakenBack` it is not: nothing is wrong with it.
        """
        with self._given() as connection:
            self._start(connection)
            log = self._log
            try:
                yield connection
                self._end(connection, keep=True)
            except TakenBack:
                self._end(connection, keep=False)
                raise
            except BaseException:
                # Closed while an answer is half read, a connection would keep its lock.
                with suppress(SQLAlchemyError):
                    self._end(connection, keep=False)
                raise
        # What went into a file that is not there any more shall not be acknowledged.
        if self._file is not None:
            self._file.require_log(log)

    @contextmanager
    def looking(self) -> Iterator[Connection]:
        """A connection to read by; on SQLite each statement of `prepared` sees its own moment."""
        with self._given() as connection:
            if not self._is_sqlite:
                connection.begin()
            yield connection
            # SQLAlchemy begins one for what it is asked itself.
            if connection.in_transaction():
                connection.rollback()

    @contextmanager
    def _given(self) -> Iterator[Connection]:
        if not self._lock.acquire(timeout=self._turn_s):
            raise Busy("too many requests wait for the database", 1)
        try:
            with self._used() as connection:
                yield connection
        finally:
            self._lock.release()

    @contextmanager
    def _used(self) -> Iterator[Connection]:
        if self._file is not None:
            self._file.require()
        connection = self._open or self._engine.connect()
        self._open = None
        try:
            yield connection
        except TakenBack:
            self._keep(connection)
            raise
        except BaseException:
            # The next transaction shall not inherit what this one broke.
            connection.invalidate()
            connection.close()
            raise
        self._keep(connection)

    def _keep(self, connection: Connection) -> None:
        if self._is_sqlite:
            self._open = connection
        else:
            connection.close()

    def _start(self, connection: Connection) -> None:
        if self._is_sqlite:
            _by_driver(connection, self._begin)
            if self._file is not None:
                self._log = self._file.log_identity()
        else:
            connection.begin()

    def _end(self, connection: Connection, *, keep: bool) -> None:
        # On SQLite SQLAlchemy takes part once it was asked for something.
        if not connection.in_transaction():
            _by_driver(connection, "COMMIT" if keep else "ROLLBACK")
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
