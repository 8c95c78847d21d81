"""All that the database keeps of some batches, as Arrow tables in one fixed order.

What is read here, put into a partition and inserted again is the same row by row, byte for
byte: archiving, verifying, restoring and the pages that read the archive share these functions.

Some archived results are also opened as a database in memory, which the queries of the record read
unchanged.
"""

import hashlib
import threading
import weakref
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import sqlalchemy as sa
from sqlalchemy import Connection, StaticPool, Table, create_engine
from sqlalchemy.schema import CreateIndex, CreateTable
from sqlalchemy.types import TypeEngine

from service.storage.archive.folder import Settings, read_partition, whole_content
from service.storage.sql import tables
from service.storage.sql.columns import PackedText
from service.storage.sql.statements import insert_all, portions
from service.storage.sql.tables import batches, missions, results, runs

Rows = dict[str, pa.Table]
"""Tables by the name of the SQL table: batches in order of time, the rest in their order."""
Columns = dict[str, pa.ChunkedArray]

CHILDREN = {
    "stars": (tables.star_results, "result_id", ("tracker", "position")),
    "solution": (tables.solutions, "result_id", ()),
    "trackers": (tables.tracker_values, "batch_id", ("tracker",)),
    "frame": (tables.frames, "batch_id", ()),
    "keys": (tables.idempotency_keys, "result_id", ("token_id", "key")),
}
"""A partition's list columns: the table, what names its result, and its order within one.

The first result of a batch has the batch's id, and so the rows of a batch are those of a result.
"""
OF_BATCHES = ("batch", "time", "received", "fingerprint", "input")
"""The columns that results do not have."""

# Of two that fit, the narrower stands first; Text is a String.
_TYPES: Sequence[tuple[type[TypeEngine[Any]], pa.DataType]] = (
    (sa.BigInteger, pa.int64()),
    (sa.SmallInteger, pa.int16()),
    (sa.Integer, pa.int32()),
    (sa.Boolean, pa.bool_()),
    (sa.Double, pa.float64()),
    (sa.LargeBinary, pa.binary()),
    (sa.String, pa.string()),
    (PackedText, pa.string()),
)


def schema_of(table: sa.Table) -> pa.Schema:
    """The Arrow schema of an SQL table."""
    return pa.schema(
        [
            (each.name, next(arrow for kind, arrow in _TYPES if isinstance(each.type, kind)))
            for each in table.columns
        ]
    )


def read_rows(connection: sa.Connection, batch_ids: Sequence[str]) -> Rows:
    """All rows of the batches with the ids; unknown ids are skipped."""
    found = _ordered(_read(connection, tables.batches, "id", batch_ids), ("time_ns", "id"))
    made = _read(connection, tables.results, "batch_id", batch_ids)
    made = _in_order_of(made, "batch_id", found["id"], ("id",))
    rows = {"batches": found, "results": made}
    ids = made["id"].to_pylist()
    for table, owner, within in CHILDREN.values():
        keys = ids if owner == "result_id" else batch_ids
        rows[table.name] = _in_order_of(
            _read(connection, table, owner, keys), owner, made["id"], within
        )
    return rows


def lock_rows(connection: sa.Connection, batch_ids: Sequence[str]) -> None:
    """Let no other process add anything to these batches, or change it, before the commit.

    What others write refers to a result or to a batch.  Results come first, as where one is
    adopted.
    """
    for table, owner in (
        (tables.results, tables.results.c.batch_id),
        (tables.batches, tables.batches.c.id),
    ):
        for ids in portions(batch_ids):
            query = sa.select(table.c.id).where(owner.in_(ids)).order_by(table.c.id)
            connection.execute(query.with_for_update())


def insert_rows(connection: sa.Connection, rows: Rows) -> None:
    """Insert all rows, what others refer to first."""
    made = rows["results"]
    # A what-if refers to the result that it began with, which has a lower id.
    made = made.sort_by("id")
    for table, read in ((tables.batches, rows["batches"]), (tables.results, made)):
        insert_all(connection, table, read.to_pylist())
    for table, _, _ in CHILDREN.values():
        insert_all(connection, table, rows[table.name].to_pylist())


def to_partition(rows: Rows) -> pa.Table:
    """The rows as one table: one row per result with its batch, and lists of what belongs to it."""
    made = rows["results"]
    place = pc.index_in(made["batch_id"], value_set=rows["batches"]["id"])
    columns = {name: made[name] for name in made.column_names}
    columns |= {name: rows["batches"][name].take(place) for name in OF_BATCHES}
    for name, (table, owner, _) in CHILDREN.items():
        read = rows[table.name]
        at = pc.index_in(read[owner], value_set=made["id"]).to_numpy()
        offsets = np.searchsorted(at, np.arange(len(made) + 1)).astype(np.int32)
        parts = read.drop_columns([owner]).combine_chunks()
        of_each = pa.StructArray.from_arrays(
            [_whole(parts[each]) for each in parts.column_names], fields=list(parts.schema)
        )
        columns[name] = pa.ListArray.from_arrays(pa.array(offsets), of_each)
    return pa.table(_without_copies(columns))


def _without_copies(columns: Columns) -> Columns:
    """The columns with nulls where a value follows from another one: a tenth of the space."""
    for name, copy in _copies(columns).items():
        own = columns[name]
        columns[name] = pc.if_else(pc.equal(own, copy), pa.scalar(None, own.type), own)
    return columns


def _copies(columns: Columns | pa.Table) -> Columns:
    """The values that mostly follow from those of other columns, by the name of their column."""
    digests = [hashlib.sha256(each.encode()).hexdigest() for each in columns["input"].to_pylist()]
    return {
        "batch_id": columns["id"],
        "received": columns["created"],
        "fingerprint": pa.chunked_array([pa.array(digests, pa.string())]),
    }


def read_part(folder: Path, path: str, sha256: str) -> Rows:
    """The rows of a part; raises `BadConfiguration` where its file is missing or damaged."""
    return from_partition(read_partition(whole_content(folder, path, sha256)))


def from_partition(partition: pa.Table) -> Rows:
    """The rows that were put into a partition; columns of a later version than its are null."""
    for name, copy in _copies(partition).items():
        place = partition.column_names.index(name)
        partition = partition.set_column(place, name, pc.coalesce(partition[name], copy))
    is_first = pc.equal(partition["id"], partition["batch_id"])
    names = [each.name for each in tables.batches.columns]
    rows = {
        "batches": partition.filter(is_first).select(names),
        "results": _selected(partition, tables.results),
    }
    for name, (table, _, _) in CHILDREN.items():
        rows[table.name] = _selected(children_of(partition, name), table)
    return rows


def children_of(partition: pa.Table, name: str) -> pa.Table:
    """The rows in a list column of a partition, each with the id of its result."""
    lists, owner = partition[name], CHILDREN[name][1]
    parts = pa.Table.from_struct_array(_whole(pc.list_flatten(lists)))
    return parts.append_column(owner, partition["id"].take(pc.list_parent_indices(lists)))


def _selected(read: pa.Table, table: sa.Table) -> pa.Table:
    """The columns of an SQL table, in its order; null where they were not written."""
    for field in schema_of(table):
        if field.name not in read.column_names:
            read = read.append_column(field, pa.nulls(len(read), field.type))
    return read.select([each.name for each in table.columns])


def differing(one: Rows, other: Rows) -> str | None:
    """The name of a table whose rows differ in any bit; None: there is none.

    Zero and minus zero are different numbers here, and any number that is none equals another.
    """
    for name in one.keys() | other.keys():
        if not _as_bits(one[name]).equals(_as_bits(other[name])):
            return name
    return None


def _as_bits(table: pa.Table) -> pa.Table:
    columns = {}
    for field in table.schema:
        column = _whole(table[field.name])
        if pa.types.is_floating(field.type):
            column = pc.if_else(pc.is_nan(column), np.nan, column).view(pa.int64())
        columns[field.name] = column
    return pa.table(columns)


def _read(connection: sa.Connection, table: sa.Table, owner: str, ids: Sequence[str]) -> pa.Table:
    rows: list[tuple[object, ...]] = []
    for some_ids in portions(ids):
        query = sa.select(table).where(table.c[owner].in_(some_ids))
        rows += map(tuple, connection.execute(query))
    schema = schema_of(table)
    columns = zip(*rows, strict=True) if rows else ([] for _ in schema)
    arrays = [pa.array(each, field.type) for each, field in zip(columns, schema, strict=True)]
    return pa.table(arrays, schema=schema)


def _in_order_of(
    table: pa.Table, owner: str, ids: pa.ChunkedArray, within: Sequence[str]
) -> pa.Table:
    """The rows in the order in which their owner's id stands among the ids."""
    place = pc.index_in(table[owner], value_set=ids)
    return _ordered(table.append_column("", place), ("", *within)).drop_columns([""])


def _ordered(table: pa.Table, names: Sequence[str]) -> pa.Table:
    return table.sort_by([(name, "ascending") for name in names])


def _whole(column: pa.ChunkedArray | pa.Array) -> pa.Array:
    """A column in one piece."""
    return column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column


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
