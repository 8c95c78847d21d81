"""Tables as Parquet, with units, frames and descriptions in the metadata of the fields.

Beside a time as text stands `timestamp`, the same as a number that programs compute with.  It
has no leap seconds: of one, and of the second after it, it is the same.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from service.products.tables import Column, Table

ROWS_IN_GROUP = 1 << 14
"""Kept in memory until they are written."""


def write_parquet(table: Table) -> Iterator[bytes]:
    """Write a table; what it is of stands in the metadata of the file."""
    import pyarrow as pa
    from pyarrow import parquet

    text = pa.string()
    types = {"number": pa.float64(), "integer": pa.int64(), "flag": pa.bool_()}
    fields = [
        pa.field(c.name, types.get(c.kind, text), metadata=_described(c)) for c in table.columns
    ]
    times = [place for place, c in enumerate(table.columns) if c.kind == "utc"]
    about = {"description": "The same without leap seconds: POSIX time."}
    fields += [pa.field("timestamp", pa.timestamp("ns", "UTC"), metadata=about) for _ in times]
    schema = pa.schema(fields, metadata=dict(table.about))
    sink = _Sink()
    # Numbers are seldom the same: dictionaries of them take memory and time, and save nothing.
    texts = [c.name for c in table.columns if c.kind in ("text", "utc")]
    with parquet.ParquetWriter(sink, schema, use_dictionary=texts or False) as writer:
        group: list[Any] = []
        for page in table.pages:
            pairs = zip([*page, *(_stamps(page[k]) for k in times)], schema, strict=True)
            arrays = [pa.array(values, field.type) for values, field in pairs]
            group.append(pa.record_batch(arrays, schema=schema))
            if sum(map(len, group)) >= ROWS_IN_GROUP:
                writer.write_table(pa.Table.from_batches(group))
                group = []
                yield sink.taken()
        writer.write_table(pa.Table.from_batches(group, schema))
    yield sink.taken()


def _stamps(texts: Sequence[str]) -> npt.NDArray[np.datetime64]:
    """UTC texts as POSIX times; a leap second is the second after it."""
    shown = np.array([text.rstrip("Z").replace(":60", ":59") for text in texts], "datetime64[ns]")
    shown[[text[16:19] == ":60" for text in texts]] += np.timedelta64(1, "s")
    return shown


def _described(column: Column) -> dict[str, str]:
    told = {"unit": column.unit, "frame": column.frame, "description": column.description}
    return {name: text for name, text in told.items() if text}


class _Sink:
    """A file that is given on as it is written."""

    closed = False

    def __init__(self) -> None:
        self._pieces: list[bytes] = []
        self._size = 0

    def write(self, data: Any) -> int:
        """Keep a piece."""
        self._pieces.append(bytes(data))
        self._size += len(self._pieces[-1])
        return len(self._pieces[-1])

    def taken(self) -> bytes:
        """The bytes that pyarrow wrote since the last call."""
        text = b"".join(self._pieces)
        self._pieces.clear()
        return text

    def tell(self) -> int:
        """How much was written in all."""
        return self._size

    def flush(self) -> None:
        """Nothing waits."""

    def close(self) -> None:
        """Nothing is open."""
