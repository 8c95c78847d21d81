"""The metadata of all tables, the types of shared columns, compressed texts among them."""

import threading
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import zstandard
from sqlalchemy import Dialect, MetaData, String, Text, text
from sqlalchemy.types import TypeDecorator

Row = dict[str, Any]
"""The values of a row by column name."""

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)
HAS_FIRST_ROW = "has_first_row"
"""The key in the `info` of a table that has a row in a new database."""

BOUND = "bound"
"""The key in the `info` of a table of a feature: its `Bound`, or why no rows of it are facts."""


class Bound(msgspec.Struct, frozen=True):
    """How the rows of a table are facts of the record's chain."""

    free: frozenset[str] = frozenset()
    """Columns that no fact has, because the service changes them."""
    closed_by: str | None = None
    """The column that is set once; a further fact then has all columns that are not `free`."""
    open_free: frozenset[str] = frozenset()
    """Columns that may change until then."""
    rises: bool = True
    """True if new keys are greater than old ones."""


Id = String(26)
Name = String(128)
RunName = String(64)
Digest = String(80)
Moment = String(30)


def rows_where(sqlite: str, postgresql: str = "") -> dict[str, Any]:
    """The arguments of an index of some rows only, by the condition that both dialects have.

    SQLite uses such an index only where the query repeats its words.
    """
    return {"sqlite_where": text(sqlite), "postgresql_where": text(postgresql or sqlite)}


CURRENT = rows_where("current = 1", "current")


# Long texts of the record, compressed on SQLite; PostgreSQL compresses such texts itself.
#
# A batch and its answer are JSON with names that are always the same.  The dictionary knows
# them: an answer of 2,600 bytes takes 450, and 7 microseconds.  Whatever was packed with a
# dictionary can be read with that one alone: one that takes its place must stand beside it.
# `python -m benchmarks.train_dictionary` made it.

DICTIONARY = Path(__file__).with_name("answers.dictionary")
LEVEL = 3
MOST_BYTES = 1 << 30
"""More than any text has; a damaged one may claim it."""

_own = threading.local()


class PackedText(TypeDecorator[str]):
    """A text that is packed where the database does not compress it; texts as they are are read."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | bytes | None:
        """The text as it is stored."""
        return value if value is None or dialect.name != "sqlite" else pack(value)

    def process_result_value(self, value: str | bytes | None, dialect: Dialect) -> str | None:
        """The text that was stored."""
        return None if value is None else unpack(value)


def pack(text: str) -> bytes:
    """The text, compressed."""
    if not hasattr(_own, "compressor"):
        _own.compressor = zstandard.ZstdCompressor(level=LEVEL, dict_data=_dictionary())
    packed: bytes = _own.compressor.compress(text.encode())
    return packed


def unpack(stored: str | bytes) -> str:
    """The text of what is stored, which an earlier version left as it was.

    Damaged bytes give another text: its reader finds that it is no JSON, and `verify` that its
    digest is wrong.
    """
    if isinstance(stored, str):
        return stored
    if not hasattr(_own, "decompressor"):
        _own.decompressor = zstandard.ZstdDecompressor(dict_data=_dictionary())
    try:
        if zstandard.frame_content_size(stored) > MOST_BYTES:
            return ""
        content: bytes = _own.decompressor.decompress(stored)
    except zstandard.ZstdError:
        return ""
    return content.decode(errors="replace")


@cache
def _dictionary() -> zstandard.ZstdCompressionDict:
    dictionary = zstandard.ZstdCompressionDict(DICTIONARY.read_bytes())
    dictionary.precompute_compress(level=LEVEL)
    return dictionary
