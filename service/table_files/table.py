"""Tables: columns with units and frames, and their values page by page."""

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
"""The values of each column, in the order of the columns; None: not known."""


@dataclass(frozen=True)
class Column:
    """A column: its name, what it holds, its unit, and the frame that its components are in.

    `width` is the greatest number of bytes of a text, for formats with fields of fixed width.
    The kind `utc` is a text, too: only a text can hold a leap second.
    """

    name: str
    kind: Kind = "number"
    unit: str = ""
    frame: str = ""
    description: str = ""
    width: int = 64


@dataclass(frozen=True)
class Table:
    """Columns, their values page by page, and `about`: where the table comes from."""

    columns: Sequence[Column]
    pages: Iterable[Page]
    about: Mapping[str, str] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """The names of the columns."""
        return [each.name for each in self.columns]


def write_csv(table: Table) -> Iterator[bytes]:
    """Write CSV as RFC 4180 has it, a line for the names of the columns first.

    A text that a spreadsheet would take for a formula has an apostrophe before it.
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
    """Values as fields: what is not known as nothing."""
    texts = ["" if value is None else str(value) for value in values]
    # Most columns need no quotes: one search over all of a column is faster than one a field.
    return texts if NEEDS_QUOTES.search("".join(texts)) is None else [*map(quoted, texts)]


_ENCODER = msgspec.json.Encoder()


def number_texts(values: Sequence[float | None], unknown: str = "null") -> list[str]:
    """Each number as the shortest such text; `unknown` for None and NaN.

    In one piece this takes a fifth of the time of `repr`.
    """
    if not values:
        return []
    text = _ENCODER.encode(values).decode()[1:-1]
    return text.replace("null", unknown).split(",")


def rows_of_texts(values: "Vector") -> list[tuple[str, ...]]:
    """The numbers of an array (n, k) as texts, a row each, k > 0."""
    texts = iter(number_texts(values.ravel().tolist()))
    return list(zip(*[texts] * values.shape[1], strict=True))
