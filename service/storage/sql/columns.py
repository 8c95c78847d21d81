"""Metadata of all tables and the types of shared columns, with the type of compressed texts."""

import threading
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import zstandard
from sqlalchemy import Dialect, MetaData, String, Text, text
from sqlalchemy.types import TypeDecorator

Row = dict[str, Any]
"""A database row: values by column name."""

metadata = MetaData(
    naming_convention={
        "ix": "ix_%(table_name)s_%(column_0_N_name)s",
        "uq": "uq_%(table_name)s_%(column_0_N_name)s",
        "fk": "fk_%(table_name)s_%(column_0_N_name)s_%(referred_table_name)s",
        "pk": "pk_%(table_name)s",
    }
)
HAS_FIRST_ROW = "has_first_row"
"""Key in a table's `info`: the table has a row in a new database."""

BOUND = "bound"
"""Key in the `info` of a feature's table: its `Bound`, or why no chain covers its rows."""


class Bound(msgspec.Struct, frozen=True):
    """Rules by which the rows of a table become facts of the record's chain."""

    free: frozenset[str] = frozenset()
    """Columns of a table that no fact covers, because the service changes them."""
    closed_by: str | None = None
    """Column that is set once to close a row, which adds a fact over all columns but `free`."""
    open_free: frozenset[str] = frozenset()
    """Columns of a table that may change until a row is closed, and are covered only then."""
    rises: bool = True
    """True if the keys of a table's new rows are greater than those of older rows."""


Id = String(26)
Name = String(128)
RunName = String(64)
Digest = String(80)
Moment = String(30)


def rows_where(sqlite: str, postgresql: str = "") -> dict[str, Any]:
    """Keyword arguments for an index of only the rows that meet a condition, for both databases.

    SQLite uses such an index only where the query repeats its words.
    """
    return {"sqlite_where": text(sqlite), "postgresql_where": text(postgresql or sqlite)}


CURRENT = rows_where("current = 1", "current")


# Long texts of the record, compressed on SQLite; PostgreSQL compresses such texts itself.
#
# A batch and its answer are JSON with the same names every time.  The dictionary holds these names:
# an answer of 2,600 bytes takes 450, and 7 microseconds.  A text packed with a dictionary can be
# read with the same dictionary only: a new dictionary must be added beside the old one.  `python -m
# benchmarks.train_dictionary` made the present one.

DICTIONARY = Path(__file__).with_name("answers.dictionary")
LEVEL = 3
MOST_BYTES = 1 << 30
"""Largest length of a decompressed text in bytes; a damaged text may claim more."""

_own = threading.local()


class PackedText(TypeDecorator[str]):
    """Column type of long texts: compressed on SQLite only; uncompressed texts can be read too."""

    impl = Text
    cache_ok = True

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | bytes | None:
        """Convert a text to its stored form, compressed on SQLite."""
        return value if value is None or dialect.name != "sqlite" else pack(value)

    def process_result_value(self, value: str | bytes | None, dialect: Dialect) -> str | None:
        """Convert a stored value back to its text."""
        return None if value is None else unpack(value)


def pack(text: str) -> bytes:
    """Compress a text with the record's dictionary."""
    if not hasattr(_own, "compressor"):
        _own.compressor = zstandard.ZstdCompressor(level=LEVEL, dict_data=_dictionary())
    packed: bytes = _own.compressor.compress(text.encode())
    return packed


def unpack(stored: str | bytes) -> str:
    """Decompress a stored text; an earlier version stored texts uncompressed.

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
