"""Differences between SQLite and PostgreSQL, in one place: no other module names either of them.

A SQLite file belongs to one process.  A PostgreSQL database may be shared by several services:
they number results together, wake each other, and take locks that a single writer needs not.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from types import ModuleType

from sqlalchemy import Connection, Engine
from sqlalchemy.dialects import postgresql, sqlite

PROBE_BYTES = 1 << 20
"""Size of the trial write, later undone, that shows whether the disk has room, in bytes."""
PROBE_TABLE = "probe_of_room"


class Dialect(ABC):
    """SQL fragments and small actions that differ between kinds of database."""

    is_shared: bool
    """True for a database on which several services may work at once."""
    module: ModuleType
    """SQLAlchemy module of the database's dialect, whose `insert` handles conflicts."""
    paramstyle: str
    wanted: str
    """SQL source `w` with one row for each element of the JSON array `wanted`."""
    wanted_texts: str
    """SQL query for the texts in the JSON array `wanted`."""
    next_seqs: str
    """SQL query for the next `count` places in the record's order, given in its last column."""

    @abstractmethod
    def item(self, place: int) -> str:
        """SQL text for one item of an array, by its place; the array is an element of `wanted`."""

    @abstractmethod
    def wake_listeners(self, connection: Connection, channel: str) -> None:
        """Notify the other services on the database, as soon as the transaction commits."""

    @abstractmethod
    def lock_table(self, connection: Connection, table: str) -> None:
        """Keep other processes from writing to a table until the end of the transaction."""

    @abstractmethod
    def oldest_transaction(self, connection: Connection) -> int | None:
        """Number of the oldest running transaction; None where only one process writes."""

    @abstractmethod
    def write_probe(self, connection: Connection, tables: Iterable[str]) -> None:
        """Write as much to the tables' database as a large batch does, to be rolled back."""

    @abstractmethod
    def remove_probe(self, connection: Connection) -> None:
        """Remove the rows of a trial write, including one left by a process that was killed."""


class _Sqlite(Dialect):
    is_shared = False
    module = sqlite
    paramstyle = "qmark"
    wanted = "json_each(:wanted) AS w"
    wanted_texts = "SELECT value FROM json_each(:wanted)"
    # Places of deleted results are not reused: leaves and the projector's position outlive them.
    next_seqs = """
        WITH RECURSIVE next(seq, n) AS (
            SELECT max(
                ifnull((SELECT max(seq) FROM record_leaves), 0),
                ifnull((SELECT max(seq) FROM results), 0), (SELECT seq FROM projector)
            ), 0
            UNION ALL SELECT seq + 1, n + 1 FROM next WHERE n < :count
        ) SELECT seq FROM next WHERE n > 0
    """

    def item(self, place: int) -> str:
        return f"json_extract(w.value, '$[{place}]')"

    def wake_listeners(self, connection: Connection, channel: str) -> None:
        """Do nothing: a SQLite database has no other services to notify."""

    def lock_table(self, connection: Connection, table: str) -> None:
        """Do nothing: a transaction that writes locks the whole SQLite file."""

    def oldest_transaction(self, connection: Connection) -> int | None:
        return None

    def write_probe(self, connection: Connection, tables: Iterable[str]) -> None:
        # SQLite writes nothing to disk for content that one transaction both writes and frees.
        connection.exec_driver_sql(f"CREATE TABLE IF NOT EXISTS {PROBE_TABLE} (content BLOB)")
        connection.exec_driver_sql(f"INSERT INTO {PROBE_TABLE} VALUES (zeroblob({PROBE_BYTES}))")

    def remove_probe(self, connection: Connection) -> None:
        connection.exec_driver_sql(f"DROP TABLE IF EXISTS {PROBE_TABLE}")


class _Postgresql(Dialect):
    is_shared = True
    module = postgresql
    paramstyle = "pyformat"
    wanted = "json_array_elements(CAST(%(wanted)s AS json)) AS w"
    wanted_texts = "SELECT json_array_elements_text(CAST(%(wanted)s AS json))"
    # Assign the transaction's number before it takes places: see `next_seqs` of the record.
    next_seqs = """
        SELECT pg_current_xact_id()::text, nextval('results_seq')
        FROM generate_series(1, %(count)s)
    """

    def item(self, place: int) -> str:
        return f"w->>{place}"

    def wake_listeners(self, connection: Connection, channel: str) -> None:
        connection.exec_driver_sql(f"SELECT pg_notify('{channel}', '')")

    def lock_table(self, connection: Connection, table: str) -> None:
        connection.exec_driver_sql(f"LOCK TABLE {table} IN SHARE ROW EXCLUSIVE MODE")

    def oldest_transaction(self, connection: Connection) -> int | None:
        return _snapshot(connection, "xmin")

    def write_probe(self, connection: Connection, tables: Iterable[str]) -> None:
        names = ", ".join(sorted(tables))
        connection.exec_driver_sql(f"LOCK TABLE {names} IN ROW EXCLUSIVE MODE")
        connection.exec_driver_sql(
            f"SELECT pg_logical_emit_message(true, 'acquire', repeat('0', {PROBE_BYTES}))"
        )

    def remove_probe(self, connection: Connection) -> None:
        """Do nothing: a trial write on PostgreSQL leaves no rows."""


def next_transaction(connection: Connection) -> int:
    """Number of the first transaction not begun yet, on a database that several services share."""
    return _snapshot(connection, "xmax")


def _snapshot(connection: Connection, which: str) -> int:
    query = f"SELECT pg_snapshot_{which}(pg_current_snapshot())::text"
    return int(connection.exec_driver_sql(query).scalar_one())


_DIALECTS: dict[str, Dialect] = {"sqlite": _Sqlite(), "postgresql": _Postgresql()}


def dialect_of(database: Connection | Engine) -> Dialect:
    """Dialect of the database behind a connection or an engine."""
    return _DIALECTS[database.dialect.name]
