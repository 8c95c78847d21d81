"""Digests of what the record keeps: of each result, and of each row of settings that it names.

`verify` computes them again: a digit that changed later, in an answer, an input, a column or a
star, does not pass.  A digest leaves null columns out, so that a column which a later version adds
changes no digest that was made before it.
"""

from collections.abc import Callable, Sequence
from functools import cache
from hashlib import blake2b
from operator import itemgetter

import msgspec
from sqlalchemy import Double, Table

from service.storage.sql import tables
from service.storage.sql.columns import Row

BYTES = 8
SETTINGS = (tables.missions, tables.catalogs, tables.mission_uses)
"""The tables whose rows have a digest each, `row_digest`."""
_NO_CONTENT = ("results.current", "results.seq", "results.digest", "mission_uses.id")
"""Columns without content: the mark of the current result, places in an order, digests."""

_encode = msgspec.json.Encoder().encode
_in_order = itemgetter("tracker", "position")


def digest_of(
    result: Row,
    stars: Sequence[Row],
    solution: Row | None,
    batch: Row | None = None,
    frame: Row | None = None,
) -> int:
    """The digest of the rows of a result, 63 bits of BLAKE2b.

    `batch` and `frame` are given for the first result of a batch, and not for a what-if.
    """
    content: list[object] = [
        _content(tables.results)(result),
        sorted(map(_content(tables.star_results), stars), key=_in_order),
    ]
    for table, row in (
        (tables.solutions, solution),
        (tables.batches, batch),
        (tables.frames, frame),
    ):
        content.append(None if row is None else _content(table)(row))
    return _digest(content)


def digest_of_row(table: Table, row: Row) -> int:
    """The digest of a row of `SETTINGS` or `tracker_values`."""
    return _digest(_content(table)(row))


def made_later(digest: int) -> int:
    """The digest as it is kept where it was made after the result: at an upgrade."""
    return ~digest


def agrees(stored: int | None, digest: int) -> bool:
    """True if a digest that is kept, if any, is this one, whenever it was made."""
    return stored in (None, digest, made_later(digest))


def _digest(content: object) -> int:
    return int.from_bytes(blake2b(_encode(content), digest_size=BYTES).digest(), "big") >> 1


@cache
def _content(table: Table) -> Callable[[Row], dict[str, object]]:
    """A function that gives the content of a row as it comes back from any database."""
    columns = [
        (each.name, isinstance(each.type, Double))
        for each in table.columns
        if each.name != "row_digest" and f"{table.name}.{each.name}" not in _NO_CONTENT
    ]

    def content(row: Row) -> dict[str, object]:
        # SQLite has no minus zero, and a whole number comes back as a float.
        return {
            name: float(value) + 0.0 if is_double else value
            for name, is_double in columns
            if (value := row[name]) is not None
        }

    return content
