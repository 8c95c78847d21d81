"""Connections to the database: one that writes, and readers that cannot.

On SQLite a transaction is begun by name.  The driver's own habit, to begin
before the first write only, turns a read that precedes it into one of another
moment, and a deferred transaction that turns from reading to writing is
refused at once, whatever the busy timeout.
"""

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url
from sqlalchemy.exc import ArgumentError, NoSuchModuleError
from sqlalchemy.pool import QueuePool

from service.errors import BadConfiguration
from service.storage.sql.connections import driver_of, run_by_driver
from service.storage.sql.database_file import DatabaseFile

if TYPE_CHECKING:
    from psycopg.abc import PQGen

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
