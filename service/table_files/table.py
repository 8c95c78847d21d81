"""Tables: columns with units and frames, and values page by page; CSV writer."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from service.csv_cells import NEEDS_QUOTES, neutralised, quoted

if TYPE_CHECKING:
    # numpy takes long to load, and `acquire --help` names the formats.
    from service.vectors import Vector


Kind = Literal["number", "integer", "flag", "text", "utc"]
Page = Sequence[Sequence[Any]]
"""Values of a page, one sequence per column; None: unknown."""


@dataclass(frozen=True)
class Column:
    """A table column: name, kind of values, unit, and reference frame of components.

    `width` is the greatest number of bytes of a text, for formats with fixed field widths.  The
    kind `utc` is a text, too: only a text can hold a leap second.
    """

    name: str
    kind: Kind = "number"
    unit: str = ""
    frame: str = ""
    description: str = ""
    width: int = 64


@dataclass(frozen=True)
class Table:
    """A table: columns, values page by page, and metadata on its origin (`about`)."""

    columns: Sequence[Column]
    pages: Iterable[Page]
    about: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Names of the table's columns, in order."""
        return [each.name for each in self.columns]


def write_csv(table: Table) -> Iterator[bytes]:
    """Write a table as CSV (RFC 4180), with a first line of column names.

    Texts that a spreadsheet would read as a formula are prefixed with an apostrophe.
    """
    yield f"{','.join(_csv_texts(table.names))}\r\n".encode()
    for page in table.pages:
        columns = [
            number_texts(values, unknown="")
            if column.kind in ("number", "integer")
            else _csv_texts(
                [value if value is None else neutralised(str(value)) for value in values]
            )
            for column, values in zip(table.columns, page, strict=True)
        ]
        lines = map(",".join, zip(*columns, strict=True))
        if text := "".join(f"{line}\r\n" for line in lines):
            yield text.encode()


def _csv_texts(values: Sequence[object]) -> list[str]:
    """Convert values to CSV fields; unknown ones are empty."""
    texts = ["" if value is None else str(value) for value in values]
    # Most columns need no quotes: one search over all of a column is faster than one a field.
    return texts if NEEDS_QUOTES.search("".join(texts)) is None else [*map(quoted, texts)]


_ENCODER = msgspec.json.Encoder()


def number_texts(values: Sequence[float | None], unknown: str = "null") -> list[str]:
    """Shortest text of each number that reads back unchanged; `unknown` for None and NaN.

    Encoding all at once takes a fifth of the time of `repr`.
    """
    if not values:
        return []
    text = _ENCODER.encode(values).decode()[1:-1]
    return text.replace("null", unknown).split(",")


def rows_of_texts(values: "Vector") -> list[tuple[str, ...]]:
    """Numbers of an array (n, k), k > 0, as texts, one tuple per row."""
    texts = iter(number_texts(values.ravel().tolist()))
    return list(zip(*[texts] * values.shape[1], strict=True))
