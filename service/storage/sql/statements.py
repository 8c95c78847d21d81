"""The inserts of results and of their part in the trends."""

import operator
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any

from sqlalchemy import (
    BigInteger,
    Boolean,
    Connection,
    Double,
    Executable,
    Integer,
    LargeBinary,
    SmallInteger,
    String,
    Table,
    case,
    or_,
)
from sqlalchemy.exc import DBAPIError

from service.storage.sql.columns import Row
from service.storage.sql.packed_text import PackedText, pack
from service.storage.sql.prepared import Prepared
from service.storage.sql.rollup_tables import COUNTS, MAXIMA, MINIMA, SUMS
from service.storage.sql.tables import runs

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
    (PackedText, "text"),
)


def insert_all(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Insert rows that name every column; on PostgreSQL many of them by COPY."""
    if len(rows) >= COPIED_FROM and connection.dialect.name == "postgresql":
        _copy(connection, table, rows)
        return
    if connection.dialect.name == "sqlite":
        for name in _packed(table):
            rows = [row | {name: pack(row[name])} for row in rows]
    _insert(table).insert(connection, rows)


@cache
def _packed(table: Table) -> Sequence[str]:
    """The columns whose values SQLite's driver is given packed."""
    return [column.name for column in table.c if isinstance(column.type, PackedText)]


def insert_missing(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Insert the rows whose keys are not there yet; leave the others as they are."""
    _insert_missing(table).run(connection, rows)


def insert_runs(
    connection: Connection,
    created: Mapping[str, str],
    *,
    alarms: bool = False,
    tracked: bool = False,
) -> None:
    """Note runs by the moments when they were made; known ones stay as they are."""
    others = {"alarms": alarms, "tracked": tracked}
    rows = [{"name": name, "created": moment} | others for name, moment in created.items()]
    insert_missing(connection, runs, rows)


def add_rollups(connection: Connection, table: Table, rows: Sequence[Row]) -> None:
    """Merge each row of a rollup into that of its key: sums add up, outer extremes stay."""
    _add_rollups(table).run(connection, rows)


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
def _insert(table: Table) -> Prepared:
    return Prepared(lambda kind: kind.insert(table))


@cache
def _insert_missing(table: Table) -> Prepared:
    return Prepared(lambda kind: kind.insert(table).on_conflict_do_nothing())


@cache
def _add_rollups(table: Table) -> Prepared:
    return Prepared(lambda kind: _merging(kind.insert(table), table))


def _merging(statement: Any, table: Table) -> Executable:
    new = statement.excluded
    merged = {name: table.c[name] + new[name] for name in (*COUNTS, *SUMS)}
    # By CASE: of a null SQLite's MIN is null, PostgreSQL's LEAST the other one.
    for names, is_outer in ((MINIMA, operator.lt), (MAXIMA, operator.gt)):
        for name in names:
            old = table.c[name]
            takes_over = or_(old.is_(None), is_outer(new[name], old))
            merged[name] = case((takes_over, new[name]), else_=old)
    found: Executable = statement.on_conflict_do_update(
        index_elements=list(table.primary_key), set_=merged
    )
    return found
