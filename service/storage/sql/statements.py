"""SQL statements that are compiled once and run many times, and the inserts of results."""

import operator
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import chain
from operator import itemgetter
from typing import Any, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import DBAPIError

from service.storage.sql.columns import PackedText, Row, pack
from service.storage.sql.dialects import Dialect, dialect_of
from service.storage.sql.engines import TranslatedErrors
from service.storage.sql.tables import COUNTS, MAXIMA, MINIMA, SUMS, runs

T = TypeVar("T")

# SQLAlchemy compiles a statement at every execution and wraps every row.  For a dozen statements
# for each group of results this takes longer than running them.  On SQLite the compiled text goes
# to the driver directly, with values by position; on a server through SQLAlchemy, with values by
# name.

ROWS_AT_ONCE = (64, 8)
"""Row counts of multi-row inserts; two only, so that the driver can cache each statement."""


class Prepared:
    """Statement compiled to the same SQL text whatever its values."""

    def __init__(self, make: Callable[[Any], sa.Executable]) -> None:
        """Prepare a statement; `make` builds it from the SQLAlchemy module of a dialect."""
        self._make = make
        self._ready: dict[Dialect, tuple[str, tuple[str, ...]]] = {}
        self._of_many: dict[int, str] = {}
        self._constants: Row = {}
        """Values by name that the statement itself fixes."""

    def run(self, connection: sa.Connection, rows: Sequence[Row]) -> None:
        """Run the statement once for each row of named values."""
        if not rows:
            return
        dialect = dialect_of(connection)
        sql, names = self._sql(dialect)
        if self._constants:
            rows = [self._constants | row for row in rows]
        if dialect.is_shared:
            connection.exec_driver_sql(sql, list(rows))
            return
        take = itemgetter(*names)
        with TranslatedErrors(connection, sql) as driver:
            driver.executemany(sql, map(take, rows) if len(names) > 1 else zip(map(take, rows)))

    def insert(self, connection: sa.Connection, rows: Sequence[Row]) -> None:
        """Run an INSERT for all rows; on SQLite with several rows in each statement.

        The driver releases the interpreter's lock at every step, and while other threads compute,
        taking the lock back takes longer than writing a row.
        """
        dialect = dialect_of(connection)
        if dialect.is_shared or len(rows) < ROWS_AT_ONCE[-1]:
            self.run(connection, rows)
            return
        sql, names = self._sql(dialect)
        values = list(map(itemgetter(*names), rows))
        done = 0
        with TranslatedErrors(connection, sql) as driver:
            for count in ROWS_AT_ONCE:
                while len(values) - done >= count:
                    part = values[done : done + count]
                    driver.execute(
                        self._many(sql, len(names), count), list(chain.from_iterable(part))
                    )
                    done += count
            driver.executemany(sql, values[done:])

    def _many(self, sql: str, columns: int, count: int) -> str:
        """SQL text that inserts `count` rows; always the same object, whose hash is cached."""
        many = self._of_many.get(count)
        if many is None:
            one_more = ", (" + ", ".join("?" * columns) + ")"
            many = self._of_many[count] = sql + one_more * (count - 1)
        return many

    def read(self, connection: sa.Connection, values: Row) -> list[Row]:
        """Run the statement as a query; returns its rows by column name."""
        dialect = dialect_of(connection)
        sql, names = self._sql(dialect)
        values = self._constants | values
        if dialect.is_shared:
            found = connection.exec_driver_sql(sql, values)
            return [dict(row) for row in found.mappings()]
        with TranslatedErrors(connection, sql) as driver:
            cursor = driver.execute(sql, [values[name] for name in names])
            rows = cursor.fetchall()
            return [dict(zip(_names(cursor), row, strict=True)) for row in rows]

    def _sql(self, dialect: Dialect) -> tuple[str, tuple[str, ...]]:
        """SQL text for a dialect, and the names of its parameters by position."""
        ready = self._ready.get(dialect)
        if ready is None:
            module: Any = dialect.module
            compiled: Any = self._make(module)
            compiled = compiled.compile(dialect=module.dialect(paramstyle=dialect.paramstyle))
            self._constants = {
                name: value for name, value in compiled.params.items() if value is not None
            }
            ready = self._ready[dialect] = str(compiled), tuple(compiled.positiontup or ())
        return ready


def prepared(statement: sa.Executable) -> Prepared:
    """Prepare a statement that is the same in every dialect."""
    return Prepared(lambda _: statement)


def execute(
    connection: sa.Connection, sql: str, values: Row | None = None
) -> list[tuple[Any, ...]]:
    """Run SQL text of the connection's dialect with named values; returns the rows."""
    if dialect_of(connection).is_shared:
        result = connection.exec_driver_sql(sql, values or {})
        return [tuple(row) for row in result] if result.returns_rows else []
    with TranslatedErrors(connection, sql) as driver:
        return driver.execute(sql, values or {}).fetchall()


def _names(cursor: sqlite3.Cursor) -> list[str]:
    return [column[0] for column in cursor.description]


def portions(values: Sequence[T]) -> Iterator[Sequence[T]]:
    """Split values into portions of a thousand, since databases limit the number in a statement."""
    for first in range(0, len(values), 1_000):
        yield values[first : first + 1_000]


def count(connection: sa.Connection, table: sa.Table, *chosen: sa.ColumnElement[bool]) -> int:
    """Count the rows of a table that meet the given conditions."""
    query = sa.select(sa.func.count()).select_from(table).where(*chosen)
    return int(connection.execute(query).scalar_one())


def rows_of(connection: sa.Connection, query: sa.Select[Any]) -> list[Row]:
    """Run a query; returns its rows as values by column name."""
    return [dict(row) for row in connection.execute(query).mappings()]


def owned_rows(
    connection: sa.Connection, table: sa.Table, owner: str, ids: Iterable[str]
) -> dict[str, list[Row]]:
    """Group a table's rows by the id in column `owner`; an id without rows has an empty list."""
    found: dict[str, list[Row]] = {id: [] for id in ids}
    for row in rows_of(connection, sa.select(table).where(table.c[owner].in_(found))):
        found[row[owner]].append(row)
    return found


COPIED_FROM = 50
"""Least number of rows inserted by COPY; its setup takes as long as inserting a few rows."""

# Where two types fit, the narrower stands first; Text is a String.
_COPIED: Sequence[tuple[type[Any], str]] = (
    (sa.BigInteger, "int8"),
    (sa.SmallInteger, "int2"),
    (sa.Integer, "int4"),
    (sa.Boolean, "bool"),
    (sa.Double, "float8"),
    (sa.LargeBinary, "bytea"),
    (sa.String, "text"),
    (PackedText, "text"),
)


def insert_all(connection: sa.Connection, table: sa.Table, rows: Sequence[Row]) -> None:
    """Insert rows that name every column; on PostgreSQL many rows by COPY."""
    if len(rows) >= COPIED_FROM and dialect_of(connection).is_shared:
        _copy(connection, table, rows)
        return
    if not dialect_of(connection).is_shared:
        for name in _packed(table):
            rows = [row | {name: pack(row[name])} for row in rows]
    _insert(table).insert(connection, rows)


@cache
def _packed(table: sa.Table) -> Sequence[str]:
    """Names of the columns whose values are compressed before SQLite's driver gets them."""
    return [column.name for column in table.c if isinstance(column.type, PackedText)]


def insert_missing(connection: sa.Connection, table: sa.Table, rows: Sequence[Row]) -> None:
    """Insert the rows whose keys are missing in the table; rows with a known key stay unchanged."""
    _insert_missing(table).run(connection, rows)


def insert_runs(
    connection: sa.Connection,
    created: Mapping[str, str],
    *,
    alarms: bool = False,
    tracked: bool = False,
) -> None:
    """Insert runs with the times of their creation; known runs stay unchanged."""
    others = {"alarms": alarms, "tracked": tracked}
    rows = [{"name": name, "created": moment} | others for name, moment in created.items()]
    insert_missing(connection, runs, rows)


def add_rollups(connection: sa.Connection, table: sa.Table, rows: Sequence[Row]) -> None:
    """Merge rows into a rollup by key: sums are added, extremes widened."""
    _add_rollups(table).run(connection, rows)


def _copy(connection: sa.Connection, table: sa.Table, rows: Sequence[Row]) -> None:
    """Insert rows by PostgreSQL's COPY in the present transaction and savepoint.

    The server's objection to a row is raised as by any other statement.
    """
    sql, types = _copy_of(table)
    names = [column.name for column in table.columns]
    psycopg = connection.connection.driver_connection
    assert psycopg is not None
    try:
        with psycopg.cursor() as cursor, cursor.copy(sql) as copy:
            copy.set_types(types)
            for row in rows:
                copy.write_row([row[name] for name in names])
    except Exception as error:
        dbapi = connection.dialect.loaded_dbapi
        if not isinstance(error, dbapi.Error):
            raise
        raise DBAPIError.instance(
            sql, None, error, dbapi.Error, dialect=connection.dialect
        ) from error


@cache
def _copy_of(table: sa.Table) -> tuple[str, list[str]]:
    """COPY statement for a table, and the PostgreSQL types of its columns in binary form."""
    names = ", ".join(f'"{column.name}"' for column in table.columns)
    types = [
        next(name for kind, name in _COPIED if isinstance(column.type, kind))
        for column in table.columns
    ]
    return f'COPY "{table.name}" ({names}) FROM STDIN (FORMAT BINARY)', types


@cache
def _insert(table: sa.Table) -> Prepared:
    return Prepared(lambda kind: kind.insert(table))


@cache
def _insert_missing(table: sa.Table) -> Prepared:
    return Prepared(lambda kind: kind.insert(table).on_conflict_do_nothing())


@cache
def _add_rollups(table: sa.Table) -> Prepared:
    return Prepared(lambda kind: _merging(kind.insert(table), table))


def _merging(statement: Any, table: sa.Table) -> sa.Executable:
    new = statement.excluded
    merged = {name: table.c[name] + new[name] for name in (*COUNTS, *SUMS)}
    # CASE, since MIN of a null is null on SQLite, while PostgreSQL's LEAST ignores the null.
    for names, is_outer in ((MINIMA, operator.lt), (MAXIMA, operator.gt)):
        for name in names:
            old = table.c[name]
            takes_over = sa.or_(old.is_(None), is_outer(new[name], old))
            merged[name] = sa.case((takes_over, new[name]), else_=old)
    found: sa.Executable = statement.on_conflict_do_update(
        index_elements=list(table.primary_key), set_=merged
    )
    return found
