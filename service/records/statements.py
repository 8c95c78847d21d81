"""Inserts that are put into SQL once and run many times.

SQLAlchemy works out the SQL of a statement at every execution.  With a dozen
inserts for each result that takes longer than running them.
"""

import operator
from collections.abc import Sequence
from functools import cache
from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    Connection,
    Double,
    Insert,
    Integer,
    LargeBinary,
    SmallInteger,
    String,
    Table,
    case,
    or_,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import DBAPIError

from service.records.draft import Row
from service.records.tables import COUNTS, MAXIMA, MINIMA, SUMS

COPIED_FROM = 50
"""Rows; to set a COPY up takes as long as to insert a few."""

# Of two that fit, the narrower stands first; Text is a String.
_COPIED: Sequence[tuple[type[Any], str]] = (
    (BigInteger, "int8"),
    (SmallInteger, "int2"),
    (Integer, "int4"),
    (Boolean, "bool"),
    (Double, "float8"),
    (LargeBinary, "bytea"),
    (String, "text"),
)


def insert_all(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Insert rows that name every column; on PostgreSQL many of them by COPY."""
    if len(rows) >= COPIED_FROM and connection.dialect.name == "postgresql":
        _copy(connection, table, rows)
        return
    _run(connection, _insert(table, connection.dialect.name), rows)


def insert_missing(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Insert the rows whose keys are not there yet; leave the others as they are."""
    _run(connection, _insert_missing(table, connection.dialect.name), rows)


def add_rollups(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Merge each row of a rollup into that of its key: sums add up, outer extremes stay."""
    _run(connection, _add_rollups(table, connection.dialect.name), rows)


def _run(connection: Connection, sql: str, rows: Sequence[Row]) -> None:
    if rows:
        connection.exec_driver_sql(sql, list(rows))


def _copy(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
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
def _copy_of(table: Table) -> tuple[str, list[str]]:
    """The statement, and the types that its binary rows are made of."""
    names = ", ".join(f'"{column.name}"' for column in table.columns)
    types = [
        next(name for kind, name in _COPIED if isinstance(column.type, kind))
        for column in table.columns
    ]
    return f'COPY "{table.name}" ({names}) FROM STDIN (FORMAT BINARY)', types


@cache
def _insert(table: Table, dialect: str) -> str:
    return _compiled(_kind(dialect).insert(table), dialect)


@cache
def _insert_missing(table: Table, dialect: str) -> str:
    return _compiled(_kind(dialect).insert(table).on_conflict_do_nothing(), dialect)


@cache
def _add_rollups(table: Table, dialect: str) -> str:
    statement = _kind(dialect).insert(table)
    new = statement.excluded
    merged = {name: table.c[name] + new[name] for name in (*COUNTS, *SUMS)}
    # By CASE: of a null SQLite's MIN is null, PostgreSQL's LEAST the other one.
    for names, is_outer in ((MINIMA, operator.lt), (MAXIMA, operator.gt)):
        for name in names:
            old = table.c[name]
            takes_over = or_(old.is_(None), is_outer(new[name], old))
            merged[name] = case((takes_over, new[name]), else_=old)
    return _compiled(
        statement.on_conflict_do_update(index_elements=list(table.primary_key), set_=merged),
        dialect,
    )


def _kind(dialect: str) -> Any:
    return sqlite if dialect == "sqlite" else postgresql


def _compiled(statement: Insert, dialect: str) -> str:
    # Named parameters, so that both drivers take rows as they are.
    style = "named" if dialect == "sqlite" else "pyformat"
    return str(statement.compile(dialect=_kind(dialect).dialect(paramstyle=style)))
