"""Statements that are put into SQL once and run many times, and the inserts of results."""

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

# SQLAlchemy compiles a statement at every execution and wraps every row.  With a
# dozen statements for each group of results that takes longer than running them.
# For a file the compiled text goes to the driver directly, with values by position;
# for a server through SQLAlchemy, with values by name.

ROWS_AT_ONCE = (64, 8)
"""Few sizes, so that the driver keeps what it made of each statement."""


class Prepared:
    """A statement whose SQL is the same whatever its values."""

    def __init__(self, make: Callable[[Any], sa.Executable]) -> None:
        """`make` is given the module of a dialect, whose `insert` knows of conflicts."""
        self._make = make
        self._ready: dict[Dialect, tuple[str, tuple[str, ...]]] = {}
        self._of_many: dict[int, str] = {}
        self._constants: Row = {}
        """Values that are part of the statement itself."""

    def run(self, connection: sa.Connection, rows: Sequence[Row]) -> None:
        """Run the statement with the values of every row, by name."""
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
        """`run` of an INSERT that ends with its values, on SQLite of many rows at a time.

        The driver lets go of the interpreter's lock with every step, and while
        others compute it takes longer to get that back than to write a row.
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
        """The statement of so many rows; always the same object, whose hash is known."""
        many = self._of_many.get(count)
        if many is None:
            one_more = ", (" + ", ".join("?" * columns) + ")"
            many = self._of_many[count] = sql + one_more * (count - 1)
        return many

    def read(self, connection: sa.Connection, values: Row) -> list[Row]:
        """The rows that the statement gives."""
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
        """The text, and the names of its values in the order of their places."""
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
    """A statement that is the same in every dialect."""
    return Prepared(lambda _: statement)


def execute(
    connection: sa.Connection, sql: str, values: Row | None = None
) -> list[tuple[Any, ...]]:
    """Run SQL of the dialect's own, values by name; its rows."""
    if dialect_of(connection).is_shared:
        result = connection.exec_driver_sql(sql, values or {})
        return [tuple(row) for row in result] if result.returns_rows else []
    with TranslatedErrors(connection, sql) as driver:
        return driver.execute(sql, values or {}).fetchall()


def _names(cursor: sqlite3.Cursor) -> list[str]:
    return [column[0] for column in cursor.description]


def portions(values: Sequence[T]) -> Iterator[Sequence[T]]:
    """The values in portions of a thousand: no database takes any number of them at once."""
    for first in range(0, len(values), 1_000):
        yield values[first : first + 1_000]


def count(connection: sa.Connection, table: sa.Table, *chosen: sa.ColumnElement[bool]) -> int:
    """The number of a table's rows that are chosen."""
    query = sa.select(sa.func.count()).select_from(table).where(*chosen)
    return int(connection.execute(query).scalar_one())


def rows_of(connection: sa.Connection, query: sa.Select[Any]) -> list[Row]:
    """The rows that a query gives, by the names of their columns."""
    return [dict(row) for row in connection.execute(query).mappings()]


def owned_rows(
    connection: sa.Connection, table: sa.Table, owner: str, ids: Iterable[str]
) -> dict[str, list[Row]]:
    """The rows of a table by the id that their column `owner` names, which may have none."""
    found: dict[str, list[Row]] = {id: [] for id in ids}
    for row in rows_of(connection, sa.select(table).where(table.c[owner].in_(found))):
        found[row[owner]].append(row)
    return found


COPIED_FROM = 50
"""Rows; to set a COPY up takes as long as to insert a few."""

# Of two that fit, the narrower stands first; Text is a String.
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
    """Insert rows that name every column; on PostgreSQL many of them by COPY."""
    if len(rows) >= COPIED_FROM and dialect_of(connection).is_shared:
        _copy(connection, table, rows)
        return
    if not dialect_of(connection).is_shared:
        for name in _packed(table):
            rows = [row | {name: pack(row[name])} for row in rows]
    _insert(table).insert(connection, rows)


@cache
def _packed(table: sa.Table) -> Sequence[str]:
    """The columns whose values SQLite's driver is given packed."""
    return [column.name for column in table.c if isinstance(column.type, PackedText)]


def insert_missing(connection: sa.Connection, table: sa.Table, rows: Sequence[Row]) -> None:
    """Insert the rows whose keys are not there yet; leave the others as they are."""
    _insert_missing(table).run(connection, rows)


def insert_runs(
    connection: sa.Connection,
    created: Mapping[str, str],
    *,
    alarms: bool = False,
    tracked: bool = False,
) -> None:
    """Note runs by the moments when they were made; known ones stay as they are."""
    others = {"alarms": alarms, "tracked": tracked}
    rows = [{"name": name, "created": moment} | others for name, moment in created.items()]
    insert_missing(connection, runs, rows)


def add_rollups(connection: sa.Connection, table: sa.Table, rows: Sequence[Row]) -> None:
    """Merge each row of a rollup into that of its key: sums add up, outer extremes stay."""
    _add_rollups(table).run(connection, rows)


def _copy(connection: sa.Connection, table: sa.Table, rows: Sequence[Row]) -> None:
    """Send rows as PostgreSQL's COPY takes them, in the transaction and savepoint at hand.

    What the server says against a row is raised as by any other statement.
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
    """The statement, and the types that its binary rows are made of."""
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
    # By CASE: of a null SQLite's MIN is null, PostgreSQL's LEAST the other one.
    for names, is_outer in ((MINIMA, operator.lt), (MAXIMA, operator.gt)):
        for name in names:
            old = table.c[name]
            takes_over = sa.or_(old.is_(None), is_outer(new[name], old))
            merged[name] = sa.case((takes_over, new[name]), else_=old)
    found: sa.Executable = statement.on_conflict_do_update(
        index_elements=list(table.primary_key), set_=merged
    )
    return found
