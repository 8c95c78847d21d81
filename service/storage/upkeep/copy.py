"""Copy of a whole record to another database, from SQLite to PostgreSQL or back.

Every table is copied row by row, including those of projections.  A table is read in the order of
its primary key, and each transaction of the copy takes the next rows: the number of rows in the
copy is its progress, and an interrupted copy continues from there.

Until it is complete, the schema of the copy has a revision that no service opens.  The revision
names the source by its numbers of rows.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from hashlib import blake2b
from typing import Any

import msgspec
import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from service.errors import BadConfiguration
from service.storage.sql import engines, migrations
from service.storage.sql.columns import HAS_FIRST_ROW
from service.storage.sql.database_file import writing_alone
from service.storage.sql.dialects import dialect_of
from service.storage.sql.projector_lock import ProjectorLock
from service.storage.sql.statements import count, insert_all
from service.storage.upkeep.verify import verify

ROWS_AT_ONCE, LARGE_ROWS_AT_ONCE = 2_000, 20
"""Rows copied at a time, and fewer for tables with packed samples and pictures (1 MB a row)."""

Step = Callable[[str, int, int], object]
"""Callback for the progress of a copy: the action, rows or batches done, and the total."""
Counts = dict[str, int]


def copy_record(
    source: str, target: str, step: Step = lambda what, done, total: None
) -> tuple[int, list[str]]:
    """Copy a database to another one; returns the number of rows, and the faults of the copy.

    The target must be missing, empty, or an unfinished copy of the same source; SQLite's file and
    all tables are created.  No other process may write to either database meanwhile.  Raises
    `BadConfiguration` with the remedy, also if the copy does not equal its source.
    """
    with _source(source) as reading, _target(target) as writing:
        try:
            total = _copy(reading, writing, step)
        except SQLAlchemyError as error:
            reason = str(getattr(error, "orig", None) or error).strip()
            raise BadConfiguration(
                f"the copy stopped: {reason}; run the same command again to go on"
            ) from error
    return total, verify(target, partial(step, "verifying"))


@contextmanager
def _source(database: str) -> Iterator[sa.Connection]:
    """Context manager of a connection to the source of a copy as of one moment, which locks it."""
    with _named("FROM"):
        migrations.require_records(database)
        url = engines.database_url(database)
    file = engines.database_file(url)
    # No process can write to a read-only file, and its lock cannot be taken.
    locked = writing_alone(None if file is None or file.is_read_only else file)
    with _named("FROM"), locked, migrations.disposed(engines.reading_engine(url)) as engine:
        migrations.require_up_to_date(engine)
        with migrations.reported(url), engine.connect() as connection:
            _take_lock(connection)
            with connection.begin():
                yield connection


@contextmanager
def _target(database: str) -> Iterator[sa.Connection]:
    """Context manager of a connection to the target of a copy for writing, with its tables made."""
    with _named("TO"):
        url = engines.database_url(database)
        migrations.require_known_file(url)
    with (
        _named("TO"),
        writing_alone(engines.database_file(url)),
        migrations.disposed(engines.writing_engine(url)) as engine,
    ):
        with migrations.reported(url), engine.begin() as connection:
            migrations.require_known(connection, unfinished=True)
            is_new = migrations.revision_in(connection) is None
        if is_new:
            migrations.bring_up_to_date(engine)
        with migrations.reported(url), engine.connect() as connection:
            _take_lock(connection)
            yield connection


@contextmanager
def _named(argument: str) -> Iterator[None]:
    """Context manager that names a command's argument instead of the setting in errors."""
    try:
        yield
    except BadConfiguration as error:
        message = str(error).replace("ACQUIRE_DATABASE", argument)
        raise BadConfiguration(message) from error


def _take_lock(connection: sa.Connection) -> None:
    """Take the projector's lock of a shared database until the session ends, or raise."""
    if not dialect_of(connection).is_shared:
        return
    if ProjectorLock().take(connection) != "taken":
        raise BadConfiguration(
            f"ACQUIRE_DATABASE: {engines.shown_url(connection.engine.url)}: a service or another "
            "copy is using it: stop it first"
        )
    connection.rollback()


def _copy(reading: sa.Connection, writing: sa.Connection, step: Step) -> int:
    """Copy the missing rows, then compare all rows; returns the number of rows."""
    tables = migrations.all_tables()
    counts = _counted(reading, tables)
    total = sum(counts.values())
    if _begin(writing, tables, counts):
        with writing.begin():
            present = _counted(writing, tables)
        done = sum(present.values())
        step("copying", done, total)
        for table in tables:
            for copied in _copy_rows(reading, writing, table, present[table.name]):
                done += copied
                step("copying", done, total)
            _refer_to_own(reading, writing, table)
    done = 0
    for table in tables:
        with writing.begin():
            if _digest(reading, table) != _digest(writing, table):
                raise BadConfiguration(
                    f"TO: the rows of {table.name} are not those of the source: it is another "
                    "record, or the source was changed since the copy began: start again with an "
                    "empty database"
                )
        done += counts[table.name]
        step("comparing", done, total)
    with writing.begin():
        _set_sequences(writing, tables)
        _set_revision(writing, migrations.HEAD)
    return total


def _counted(connection: sa.Connection, tables: Sequence[sa.Table]) -> Counts:
    return {table.name: count(connection, table) for table in tables}


def _begin(connection: sa.Connection, tables: Sequence[sa.Table], counts: Counts) -> bool:
    """Mark an empty target of a copy as unfinished, unless marked; False if it has all rows."""
    marked = (
        migrations.UNFINISHED + blake2b(msgspec.json.encode(counts), digest_size=12).hexdigest()
    )
    with connection.begin():
        revision = migrations.revision_in(connection)
        if revision == marked:
            return True
        if revision == migrations.HEAD:
            present = _counted(connection, tables)
            first = [table for table in tables if HAS_FIRST_ROW in table.info]
            if not any(present[table.name] for table in tables if table not in first):
                for table in first:
                    connection.execute(sa.delete(table))
                _set_revision(connection, marked)
                return True
            if present == counts:
                return False
    if revision == migrations.HEAD:
        reason = "it holds a record already"
    elif revision is not None and revision.startswith(migrations.UNFINISHED):
        reason = "it is an unfinished copy of another database, or of an earlier state of this one"
    else:
        reason = f"its schema is at {revision}, this version needs {migrations.HEAD}"
    raise BadConfiguration(
        f"TO: {engines.shown_url(connection.engine.url)}: {reason}: name an empty database"
    )


def _set_revision(connection: sa.Connection, revision: str) -> None:
    connection.execute(sa.text("UPDATE alembic_version SET version_num = :it"), {"it": revision})


def _chunks(
    connection: sa.Connection, query: sa.Select[Any], table: sa.Table
) -> Iterator[Sequence[sa.Row[Any]]]:
    """Read the rows of a query in chunks that fit in memory."""
    has_large = any(isinstance(column.type, sa.LargeBinary) for column in table.columns)
    at_once = LARGE_ROWS_AT_ONCE if has_large else ROWS_AT_ONCE
    with connection.execute(query, execution_options={"yield_per": at_once}) as read:
        yield from read.partitions()


def _copy_rows(
    reading: sa.Connection, writing: sa.Connection, table: sa.Table, present: int
) -> Iterator[int]:
    """Copy the rows after the first `present` ones; yields the row count of each transaction."""
    query = sa.select(table).order_by(*table.primary_key).offset(present)
    later = dict.fromkeys(column.name for column in _own_references(table))
    for chunk in _chunks(reading, query, table):
        with writing.begin():
            insert_all(writing, table, [dict(row._mapping) | later for row in chunk])
        yield len(chunk)


def _own_references(table: sa.Table) -> list[sa.Column[Any]]:
    """Columns that refer to rows of their own table, which may be copied later."""
    return [key.parent for key in table.foreign_keys if key.column.table is table]


def _refer_to_own(reading: sa.Connection, writing: sa.Connection, table: sa.Table) -> None:
    for column in _own_references(table):
        (key,) = table.primary_key
        query = sa.select(key.label("own"), column.label("other")).where(column.is_not(None))
        change = (
            sa.update(table)
            .where(key == sa.bindparam("own"))
            .values({column: sa.bindparam("other")})
        )
        for chunk in _chunks(reading, query, table):
            with writing.begin():
                writing.execute(change, [dict(row._mapping) for row in chunk])


def _digest(connection: sa.Connection, table: sa.Table) -> int:
    """The sum of the digests of a table's rows, which does not depend on their order."""
    is_double = [isinstance(column.type, sa.Double) for column in table.columns]
    total = 0
    for chunk in _chunks(connection, sa.select(table), table):
        for row in chunk:
            # SQLite has no minus zero.
            content = [
                value + 0.0 if double and value is not None else value
                for value, double in zip(row, is_double, strict=True)
            ]
            digest = blake2b(msgspec.json.encode(content), digest_size=16).digest()
            total += int.from_bytes(digest, "big")
    return total


def _set_sequences(connection: sa.Connection, tables: Sequence[sa.Table]) -> None:
    """Set PostgreSQL's sequences to continue after the copied numbers; SQLite needs none."""
    if not dialect_of(connection).is_shared:
        return
    after = "coalesce(max({0}), 0) + 1, false) FROM {1}"
    connection.execute(
        sa.text(
            "SELECT setval('results_seq', 1 + greatest((SELECT max(seq) FROM results), "
            "(SELECT max(seq) FROM record_leaves), "
            "(SELECT seq FROM projector)), false)"
        )
    )
    for table in tables:
        column = table.autoincrement_column
        if column is not None:
            of = f"pg_get_serial_sequence('{table.name}', '{column.name}')"
            connection.execute(
                sa.text(f"SELECT setval({of}, {after.format(column.name, table.name)}")
            )
        connection.execute(sa.text(f'ANALYZE "{table.name}"'))
