"""What SQLite and PostgreSQL do differently, in one place: the rest names neither of them.

A SQLite file belongs to one process.  A PostgreSQL database may be shared by several services:
they number results together, wake each other, and take locks that a single writer needs not.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from types import ModuleType

from sqlalchemy import Connection, Engine
from sqlalchemy.dialects import postgresql, sqlite

PROBE_BYTES = 1 << 20
"""Written, and taken back, to see if there is room."""
PROBE_TABLE = "probe_of_room"


class Dialect(ABC):
    """Fragments of SQL and small actions of one kind of database."""

    is_shared: bool
    """True where several services may work on one database at once."""
    module: ModuleType
    """SQLAlchemy's, whose `insert` knows of conflicts."""
    paramstyle: str
    wanted: str
    """The elements of the JSON array `wanted`, as the table `w`."""
    wanted_texts: str
    """The texts of the JSON array `wanted`, as a query."""
    next_seqs: str
    """The next `count` places in the record's order; the last column has them."""

    @abstractmethod
    def item(self, place: int) -> str:
        """One text of the array that is an element of `wanted`."""

    @abstractmethod
    def wake_listeners(self, connection: Connection, channel: str) -> None:
        """Wake the other services at the commit."""

    @abstractmethod
    def lock_table(self, connection: Connection, table: str) -> None:
        """Keep other processes from writing to a table until the end of the transaction."""

    @abstractmethod
    def oldest_transaction(self, connection: Connection) -> int | None:
        """The number of the oldest transaction not ended; None where one process writes."""

    @abstractmethod
    def write_probe(self, connection: Connection, tables: Iterable[str]) -> None:
        """Write to the tables' database as much as a large batch does, to be rolled back."""

    @abstractmethod
    def remove_probe(self, connection: Connection) -> None:
        """Give back what a probe wrote, also one of a process that was killed."""


class _Sqlite(Dialect):
    is_shared = False
    module = sqlite
    paramstyle = "qmark"
    wanted = "json_each(:wanted) AS w"
    wanted_texts = "SELECT value FROM json_each(:wanted)"
    # Of results that were deleted before they were projected nothing is left to tell.
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
        """Nothing: there are no others."""

    def lock_table(self, connection: Connection, table: str) -> None:
        """Nothing: a transaction that writes has the whole file."""

    def oldest_transaction(self, connection: Connection) -> int | None:
        return None

    def write_probe(self, connection: Connection, tables: Iterable[str]) -> None:
        # Of what is written and freed in one transaction SQLite writes nothing.
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
    # The transaction has its number before it takes places: see `next_seqs` of the record.
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
        """Nothing: the log alone was written to."""


def next_transaction(connection: Connection) -> int:
    """The number of the next transaction to come, where a database is shared."""
    return _snapshot(connection, "xmax")


def _snapshot(connection: Connection, which: str) -> int:
    query = f"SELECT pg_snapshot_{which}(pg_current_snapshot())::text"
    return int(connection.exec_driver_sql(query).scalar_one())


_DIALECTS: dict[str, Dialect] = {"sqlite": _Sqlite(), "postgresql": _Postgresql()}


def dialect_of(database: Connection | Engine) -> Dialect:
    """The dialect that a connection or an engine speaks."""
    return _DIALECTS[database.dialect.name]
