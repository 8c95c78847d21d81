"""Some archived results as a database in memory, which the queries of the record read unchanged."""

import threading
import weakref
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from sqlalchemy import Connection, StaticPool, Table, create_engine
from sqlalchemy.schema import CreateIndex, CreateTable

from service.storage.archive.folder import Settings
from service.storage.archive.rows import CHILDREN, OF_BATCHES, Rows, children_of
from service.storage.sql.tables import batches, missions, results, runs

LARGE = ("input", "answer")
"""The text columns of a partition that are read only where they are wanted."""
WHOLE = frozenset((*LARGE, *(name for name in CHILDREN if name != "keys")))
"""All that pages and products read of a batch."""

_CHILD_TABLES = [table for table, _, _ in CHILDREN.values()]
_TABLES = (runs, missions, batches, results, *_CHILD_TABLES)


def columns_of(needs: Collection[str]) -> list[str]:
    """The columns of a partition to read for `needs`, which are names of `WHOLE`."""
    names = [*(each.name for each in results.columns), *OF_BATCHES]
    return [*(name for name in names if name not in LARGE), *sorted(needs)]


class Opened:
    """A database in memory with some results and what belongs to them, for one thread at a time.

    Columns that were not read from the file are empty there: null, an empty text, no stars.
    """

    def __init__(self) -> None:
        self._engine = create_engine(
            "sqlite://", poolclass=StaticPool, connect_args={"check_same_thread": False}
        )
        self._lock = threading.Lock()
        with self._engine.begin() as connection:
            for table in _TABLES:
                connection.execute(CreateTable(table))
        # Where nothing refers to it any more, its memory is given back.
        weakref.finalize(self, self._engine.dispose)

    @property
    def nbytes(self) -> int:
        """Bytes of its pages."""
        with self.reading() as connection:
            pages, size = (
                connection.exec_driver_sql(f"PRAGMA {name}").scalar_one()
                for name in ("page_count", "page_size")
            )
        return int(pages) * int(size)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """The connection to it."""
        with self._lock, self._engine.connect() as connection:
            yield connection

    def add_indexes(self) -> None:
        """Give it the record's indexes: without them a join of thousands of results takes minutes.

        A page of a list is read faster without.
        """
        with self._engine.begin() as connection:
            for table in _TABLES:
                for index in sorted(table.indexes, key=lambda each: str(each.name)):
                    connection.execute(CreateIndex(index))

    def add_partition(self, partition: pa.Table) -> None:
        """Add results of a part, with the columns of it that were read."""
        columns = {name: partition[name] for name in partition.column_names}
        columns["batch_id"] = pc.coalesce(columns["batch_id"], columns["id"])
        # Of a batch whose first result is in another row group, a later one has all.
        of_batches = {each.name: columns.get(each.name) for each in batches.columns}
        of_batches["id"] = columns["batch_id"]
        of_batches["received"] = pc.coalesce(columns["received"], columns["created"])
        of_batches["fingerprint"] = None
        rows = [(batches, of_batches)]
        rows.append((results, {each.name: columns.get(each.name) for each in results.columns}))
        for name, (table, _, _) in CHILDREN.items():
            if name in columns:
                found = children_of(partition, name)
                rows.append((table, {each: found[each] for each in found.column_names}))
        with self._engine.begin() as connection:
            for name in sorted({*columns["run"].to_pylist()}):
                row = {"name": name, "created": ""}
                connection.execute(runs.insert().prefix_with("OR IGNORE"), row)
            for table, values in rows:
                _insert(connection, table, values)

    def add_rows(self, rows: Rows) -> None:
        """Add rows of the record."""
        with self._engine.begin() as connection:
            for table in (batches, results, *_CHILD_TABLES):
                read = rows[table.name]
                columns = {name: read[name] for name in read.column_names}
                _insert(connection, table, columns)

    def add_settings(self, found: Iterable[Settings]) -> None:
        """Add settings of missions."""
        with self._engine.begin() as connection:
            for each in found:
                connection.execute(missions.insert().prefix_with("OR IGNORE"), each.row)


def _insert(
    connection: Connection, table: Table, columns: dict[str, pa.ChunkedArray | None]
) -> None:
    count = next(len(each) for each in columns.values() if each is not None)
    values: list[Sequence[Any]] = []
    for each in table.columns:
        column = columns.get(each.name)
        missing = None if each.nullable else ""
        values.append([missing] * count if column is None else column.to_pylist())
    marks = ", ".join("?" * len(values))
    statement = f"INSERT OR IGNORE INTO {table.name} VALUES ({marks})"
    rows = list(zip(*values, strict=True))
    if rows:
        connection.exec_driver_sql(statement, rows)
