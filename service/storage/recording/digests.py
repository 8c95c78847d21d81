"""Digests of results, over all that the record keeps of each: made when it is written.

`verify` computes them again: a digit that changed later, in an answer, an input, a column or a
star, does not pass.
"""

from collections.abc import Callable, Sequence
from functools import cache
from hashlib import blake2b

import msgspec
from sqlalchemy import Double, Table

from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, frames, results, solutions, star_results

BYTES = 8
_CHANGE_LATER = ("current", "seq", "digest")
"""Columns of `results` that are no content: what is current, and the place in the record."""

_encode = msgspec.json.Encoder().encode


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
    content = [_values(results)(result), sorted(map(_values(star_results), stars))]
    for table, row in ((solutions, solution), (batches, batch), (frames, frame)):
        content.append([] if row is None else _values(table)(row))
    digest = blake2b(_encode(content), digest_size=BYTES).digest()
    return int.from_bytes(digest, "big") >> 1


@cache
def _values(table: Table) -> Callable[[Row], list[object]]:
    """A function that gives the values of a row as they come back from any database."""
    names = [each.name for each in table.columns if each.name not in _CHANGE_LATER]
    places = [k for k, name in enumerate(names) if isinstance(table.c[name].type, Double)]

    def values(row: Row) -> list[object]:
        found = [row[name] for name in names]
        for k in places:
            if (value := found[k]) is not None:
                # SQLite has no minus zero, and a whole number comes back as a float.
                found[k] = float(value) + 0.0
        return found

    return values
