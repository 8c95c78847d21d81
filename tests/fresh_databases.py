"""Databases that are up to date, in milliseconds: a copied file, or an emptied PostgreSQL schema.

The migrations run once for each kind and process.  Tests of the migrations themselves ask for
`empty_database`, which has nothing in it.
"""

import os
import tempfile
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest
from sqlalchemy import Connection, create_engine, make_url, text
from sqlalchemy.exc import DBAPIError

from service.storage.sql.engines import database_url
from service.storage.sql.migrations import upgrade

LOCK_TIMEOUT_MS = 2_000
# As the service takes it: whoever still holds it has not been closed.
PROJECTOR_LOCK = "1633906037, '{schema}.event_counter'::regclass::oid::int"


def sqlite_at(path: Path) -> str:
    """The URL of a new SQLite file that is up to date."""
    path.write_bytes(_template())
    return f"sqlite:///{path}"


@cache
def _template() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "template.db")
        upgrade(f"sqlite:///{file}")
        return file.read_bytes()


def server() -> str:
    """The URL of the PostgreSQL server; skips where none is named.  CI names one."""
    named = os.environ.get("TEST_POSTGRESQL_URL")
    if not named:
        pytest.skip("TEST_POSTGRESQL_URL names no PostgreSQL database to test on")
    return named


@contextmanager
def postgresql_schema() -> Iterator[str]:
    """The URL of a schema with nothing in it, which is dropped at the end."""
    schema = _new_schema()
    try:
        yield _url_of(schema)
    finally:
        _drop(schema)


class PostgresqlSchemas:
    """Schemas that are up to date; one whose tables are unchanged is emptied and used again."""

    def __init__(self) -> None:
        self._free: list[_Schema] = []

    @contextmanager
    def fresh(self) -> Iterator[str]:
        """The URL of a schema that is up to date and holds what the migrations put there."""
        schema = self._free.pop() if self._free else _Schema()
        try:
            yield _url_of(schema.name)
        finally:
            if schema.empty():
                self._free.append(schema)
            else:
                _drop(schema.name)

    def close(self) -> None:
        """Drop the schemas."""
        while self._free:
            _drop(self._free.pop().name)


class _Schema:
    def __init__(self) -> None:
        self.name = _new_schema()
        upgrade(_url_of(self.name))
        with _connected() as connection:
            self._shape = self._shape_of(connection)
            self._tables = self._tables_of(connection)
            self._first_rows = {
                table: rows
                for table in self._tables
                if (rows := connection.execute(text(f"SELECT * FROM {table}")).mappings().all())
            }

    def empty(self) -> bool:
        """Make it as it was; False where a test changed its tables, or something still uses it."""
        lock = PROJECTOR_LOCK.format(schema=self.name)
        try:
            with _connected() as connection, connection.begin():
                if self._shape_of(connection) != self._shape:
                    return False
                connection.execute(text(f"SET LOCAL lock_timeout = {LOCK_TIMEOUT_MS}"))
                lock_taken = text(f"SELECT pg_try_advisory_xact_lock({lock})")
                if not connection.execute(lock_taken).scalar():
                    return False
                for table in self._tables:
                    connection.execute(text(f"DELETE FROM {table}"))
                for table in reversed(self._first_rows):
                    rows = self._first_rows[table]
                    columns = ", ".join(rows[0])
                    values = ", ".join(f":{name}" for name in rows[0])
                    insert = text(f"INSERT INTO {table} ({columns}) VALUES ({values})")
                    connection.execute(insert, [dict(row) for row in rows])
        except DBAPIError:
            return False
        return True

    def _shape_of(self, connection: Connection) -> list[tuple[str, str, int, int]]:
        """Tables and indexes, with their numbers of columns, checks and triggers."""
        asked = text(
            "SELECT relname, relkind::text, relnatts, relchecks FROM pg_class WHERE relnamespace"
            " = CAST(:name AS regnamespace) ORDER BY relname"
        )
        return [tuple(row) for row in connection.execute(asked, {"name": self.name})]

    def _tables_of(self, connection: Connection) -> list[str]:
        """Tables, each before those that it refers to."""
        referring = text(
            "SELECT conrelid::regclass::text, confrelid::regclass::text FROM pg_constraint"
            " WHERE contype = 'f' AND connamespace = CAST(:name AS regnamespace)"
        )
        order: TopologicalSorter[str] = TopologicalSorter()
        for name, kind, *_ in self._shape:
            if kind == "r":
                order.add(f"{self.name}.{name}")
        for table, other in connection.execute(referring, {"name": self.name}):
            if table != other:
                order.add(other, table)
        return list(order.static_order())


def _new_schema() -> str:
    schema = f"test_{uuid.uuid4().hex}"
    with _connected() as connection, connection.begin():
        connection.execute(text(f"CREATE SCHEMA {schema}"))
    return schema


def _drop(schema: str) -> None:
    with _connected() as connection, connection.begin():
        connection.execute(text(f"DROP SCHEMA {schema} CASCADE"))


def _url_of(schema: str) -> str:
    # The server itself is never killed here: its commits need not wait for the disk.
    options = f"-csearch_path={schema} -csynchronous_commit=off"
    url = make_url(server()).update_query_dict({"options": options})
    return url.render_as_string(hide_password=False)


@contextmanager
def _connected() -> Iterator[Connection]:
    engine = create_engine(database_url(server()))
    try:
        with engine.connect() as connection:
            yield connection
    finally:
        engine.dispose()
