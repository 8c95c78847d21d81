"""Rows of batches as Arrow tables in a fixed order, with everything that the database keeps.

Rows that are read, written to a part and inserted again are identical, byte for byte: archiving,
verifying, restoring and the pages that show the archive share these functions.

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

from service.features.archive.folder import Settings, read_partition, whole_content
from service.storage.sql import tables
from service.storage.sql.columns import PackedText
from service.storage.sql.statements import insert_all, portions
from service.storage.sql.tables import batches, missions, results, runs

Rows = dict[str, pa.Table]
"""Arrow tables by the name of the SQL table: batches in order of time, the rest in their order."""
Columns = dict[str, pa.ChunkedArray]

CHILDREN = {
    "stars": (tables.star_results, "result_id", ("tracker", "position")),
    "solution": (tables.solutions, "result_id", ()),
    "trackers": (tables.tracker_values, "batch_id", ("tracker",)),
    "frame": (tables.frames, "batch_id", ()),
    "keys": (tables.idempotency_keys, "result_id", ("token_id", "key")),
}
"""List columns of a part: the SQL table, its column with the result's id, and its order.

The first result of a batch has the batch's id, and so the rows of a batch are those of a result.
"""
OF_BATCHES = ("batch", "time", "received", "fingerprint", "input")
"""Columns of batches that results do not have."""

# Where two types fit, the narrower stands first; Text is a String.
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
    """Arrow schema that matches an SQL table."""
    return pa.schema(
        [
            (each.name, next(arrow for kind, arrow in _TYPES if isinstance(each.type, kind)))
            for each in table.columns
        ]
    )


def read_rows(connection: sa.Connection, batch_ids: Sequence[str]) -> Rows:
    """Read all rows of batches by their ids; unknown ids are skipped."""
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
    """Lock batches, so that until the commit no other process changes or extends them.

    Rows of other processes refer to a result or to a batch.  Results are locked first, as where one
    is adopted.
    """
    for table, owner in (
        (tables.results, tables.results.c.batch_id),
        (tables.batches, tables.batches.c.id),
    ):
        for ids in portions(batch_ids):
            query = sa.select(table.c.id).where(owner.in_(ids)).order_by(table.c.id)
            connection.execute(query.with_for_update())


def insert_rows(connection: sa.Connection, rows: Rows) -> None:
    """Insert all rows of batches, referenced rows first."""
    made = rows["results"]
    # A what-if refers to the result that it started from, which has a lower id.
    made = made.sort_by("id")
    for table, read in ((tables.batches, rows["batches"]), (tables.results, made)):
        insert_all(connection, table, read.to_pylist())
    for table, _, _ in CHILDREN.values():
        insert_all(connection, table, rows[table.name].to_pylist())


def to_partition(rows: Rows) -> pa.Table:
    """Combine rows into one table: each result with its batch, and lists of its children."""
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
    """Replace values that follow from other columns by null, which saves a tenth of the space."""
    for name, copy in _copies(columns).items():
        own = columns[name]
        columns[name] = pc.if_else(pc.equal(own, copy), pa.scalar(None, own.type), own)
    return columns


def _copies(columns: Columns | pa.Table) -> Columns:
    """Values that usually equal or follow from other columns, by name of the predicted column."""
    digests = [hashlib.sha256(each.encode()).hexdigest() for each in columns["input"].to_pylist()]
    return {
        "batch_id": columns["id"],
        "received": columns["created"],
        "fingerprint": pa.chunked_array([pa.array(digests, pa.string())]),
    }


def read_part(folder: Path, path: str, sha256: str) -> Rows:
    """Read the rows of an archive part; raises `BadConfiguration` if missing or damaged."""
    return from_partition(read_partition(whole_content(folder, path, sha256)))


def from_partition(partition: pa.Table) -> Rows:
    """Extract the rows of batches from an archive part; columns of a later version are null."""
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
    """Rows in a list column of an archive part, each with the id of its result."""
    lists, owner = partition[name], CHILDREN[name][1]
    parts = pa.Table.from_struct_array(_whole(pc.list_flatten(lists)))
    return parts.append_column(owner, partition["id"].take(pc.list_parent_indices(lists)))


def _selected(read: pa.Table, table: sa.Table) -> pa.Table:
    """Columns of an SQL table from an archive part, in order; null where not written."""
    for field in schema_of(table):
        if field.name not in read.column_names:
            read = read.append_column(field, pa.nulls(len(read), field.type))
    return read.select([each.name for each in table.columns])


def differing(one: Rows, other: Rows) -> str | None:
    """Name of a table whose rows differ in any bit between two sets; None if all are equal.

    Zero and minus zero are different numbers here, and all NaN values are equal.
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
    """Sort rows by the position of their owner's id in a list of ids."""
    place = pc.index_in(table[owner], value_set=ids)
    return _ordered(table.append_column("", place), ("", *within)).drop_columns([""])


def _ordered(table: pa.Table, names: Sequence[str]) -> pa.Table:
    return table.sort_by([(name, "ascending") for name in names])


def _whole(column: pa.ChunkedArray | pa.Array) -> pa.Array:
    """Merge the chunks of an Arrow column into one array."""
    return column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column


LARGE = ("input", "answer")
"""Long text columns of an archive part, read only on request."""
WHOLE = frozenset((*LARGE, *(name for name in CHILDREN if name != "keys")))
"""Columns and lists of an archive part that pages and products may request."""

_CHILD_TABLES = [table for table, _, _ in CHILDREN.values()]
_TABLES = (runs, missions, batches, results, *_CHILD_TABLES)


def columns_of(needs: Collection[str]) -> list[str]:
    """Columns of an archive part to read for `needs`, which are names in `WHOLE`."""
    names = [*(each.name for each in results.columns), *OF_BATCHES]
    return [*(name for name in names if name not in LARGE), *sorted(needs)]


class Opened:
    """Database in memory with archived results and their rows, for one thread at a time.

    Columns that were not read from the file are empty: null, an empty text, no stars.
    """

    def __init__(self) -> None:
        self._engine = create_engine(
            "sqlite://", poolclass=StaticPool, connect_args={"check_same_thread": False}
        )
        self._lock = threading.Lock()
        with self._engine.begin() as connection:
            for table in _TABLES:
                connection.execute(CreateTable(table))
        # Its memory is freed when the last reference is gone.
        weakref.finalize(self, self._engine.dispose)

    @property
    def nbytes(self) -> int:
        """Bytes of memory that this in-memory database of archived results takes."""
        with self.reading() as connection:
            pages, size = (
                connection.exec_driver_sql(f"PRAGMA {name}").scalar_one()
                for name in ("page_count", "page_size")
            )
        return int(pages) * int(size)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """Context manager of the connection to the database in memory."""
        with self._lock, self._engine.connect() as connection:
            yield connection

    def add_indexes(self) -> None:
        """Create the record's indexes in the database in memory.

        Without them a join of thousands of results takes minutes; a page of a list is faster
        without.
        """
        with self._engine.begin() as connection:
            for table in _TABLES:
                for index in sorted(table.indexes, key=lambda each: str(each.name)):
                    connection.execute(CreateIndex(index))

    def add_partition(self, partition: pa.Table) -> None:
        """Add results of an archive part, with those of its columns that were read."""
        columns = {name: partition[name] for name in partition.column_names}
        columns["batch_id"] = pc.coalesce(columns["batch_id"], columns["id"])
        # The first result of a batch may be in another row group: fall back to a later one.
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
        """Add rows of recorded batches and results to the database in memory."""
        with self._engine.begin() as connection:
            for table in (batches, results, *_CHILD_TABLES):
                read = rows[table.name]
                columns = {name: read[name] for name in read.column_names}
                _insert(connection, table, columns)

    def add_settings(self, found: Iterable[Settings]) -> None:
        """Add the settings of missions to the database in memory."""
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
