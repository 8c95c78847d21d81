"""Statements that are put into SQL once and run many times.

SQLAlchemy compiles a statement at every execution and wraps every row.  With a
dozen statements for each group of results that takes longer than running them.
On SQLite the compiled text goes to the driver directly, with values by position;
on PostgreSQL through SQLAlchemy, with values by name.
"""

import sqlite3
from collections.abc import Callable, Sequence
from itertools import chain
from operator import itemgetter
from typing import Any

from sqlalchemy import Connection, Executable
from sqlalchemy.dialects import postgresql, sqlite

from service.storage.sql.columns import Row
from service.storage.sql.connections import TranslatedErrors

ROWS_AT_ONCE = (64, 8)
"""Few sizes, so that the driver keeps what it made of each statement."""

_STYLES = {"sqlite": (sqlite, "qmark"), "postgresql": (postgresql, "pyformat")}


class Prepared:
    """A statement whose SQL is the same whatever its values."""

    def __init__(self, make: Callable[[Any], Executable]) -> None:
        """`make` is given the module of a dialect, whose `insert` knows of conflicts."""
        self._make = make
        self._ready: dict[str, tuple[str, tuple[str, ...]]] = {}
        self._of_many: dict[int, str] = {}

    def run(self, connection: Connection, rows: Sequence[Row]) -> None:
        """Run the statement with the values of every row, by name."""
        if not rows:
            return
        sql, names = self._sql(connection.dialect.name)
        if connection.dialect.name != "sqlite":
            connection.exec_driver_sql(sql, list(rows))
            return
        take = itemgetter(*names)
        with TranslatedErrors(connection, sql) as driver:
            driver.executemany(sql, map(take, rows) if len(names) > 1 else zip(map(take, rows)))

    def insert(self, connection: Connection, rows: Sequence[Row]) -> None:
        """`run` of an INSERT that ends with its values, on SQLite of many rows at a time.

        The driver lets go of the interpreter's lock with every step, and while
        others compute it takes longer to get that back than to write a row.
        """
        if connection.dialect.name != "sqlite" or len(rows) < ROWS_AT_ONCE[-1]:
            self.run(connection, rows)
            return
        sql, names = self._sql("sqlite")
        values = list(map(itemgetter(*names), rows))
        done = 0
        with TranslatedErrors(connection, sql) as driver:
            for count in ROWS_AT_ONCE:
                while len(values) - done >= count:
                    part = values[done : done + count]
                    driver.execute(self._many(count), list(chain.from_iterable(part)))
                    done += count
            driver.executemany(sql, values[done:])

    def _many(self, count: int) -> str:
        """The statement of so many rows; always the same object, whose hash is known."""
        many = self._of_many.get(count)
        if many is None:
            sql, names = self._sql("sqlite")
            one_more = ", (" + ", ".join("?" * len(names)) + ")"
            many = self._of_many[count] = sql + one_more * (count - 1)
        return many

    def read(self, connection: Connection, values: Row) -> list[Row]:
        """The rows that the statement gives."""
        sql, names = self._sql(connection.dialect.name)
        if connection.dialect.name != "sqlite":
            found = connection.exec_driver_sql(sql, values)
            return [dict(row) for row in found.mappings()]
        with TranslatedErrors(connection, sql) as driver:
            cursor = driver.execute(sql, [values[name] for name in names])
            rows = cursor.fetchall()
            return [dict(zip(_names(cursor), row, strict=True)) for row in rows]

    def _sql(self, dialect: str) -> tuple[str, tuple[str, ...]]:
        """The text, and the names of its values in the order of their places."""
        ready = self._ready.get(dialect)
        if ready is None:
            kind, style = _STYLES[dialect]
            compiled: Any = self._make(kind)
            compiled = compiled.compile(dialect=kind.dialect(paramstyle=style))
            ready = self._ready[dialect] = str(compiled), tuple(compiled.positiontup or ())
        return ready


def prepared(statement: Executable) -> Prepared:
    """A statement that is the same in every dialect."""
    return Prepared(lambda _: statement)


def execute(connection: Connection, sql: str, values: Row | None = None) -> list[tuple[Any, ...]]:
    """Run SQL of the dialect's own, values by name; its rows."""
    if connection.dialect.name != "sqlite":
        result = connection.exec_driver_sql(sql, values or {})
        return [tuple(row) for row in result] if result.returns_rows else []
    with TranslatedErrors(connection, sql) as driver:
        return driver.execute(sql, values or {}).fetchall()


def _names(cursor: sqlite3.Cursor) -> list[str]:
    return [column[0] for column in cursor.description]
