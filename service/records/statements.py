"""Inserts that are put into SQL once and run many times.

SQLAlchemy works out the SQL of a statement at every execution.  With a dozen
inserts for each result that takes longer than running them.
"""

import operator
from collections.abc import Sequence
from functools import cache
from typing import Any

from sqlalchemy import Connection, Insert, Table, case, or_
from sqlalchemy.dialects import postgresql, sqlite

from service.records.draft import Row
from service.records.tables import COUNTS, MAXIMA, MINIMA, SUMS


def insert_all(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Insert rows that name every column."""
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
