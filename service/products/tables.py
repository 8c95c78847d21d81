"""Tables: columns with units and frames, and their values page by page."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

Kind = Literal["number", "integer", "flag", "text"]
Page = Sequence[Sequence[Any]]
"""The values of each column, in the order of the columns; None: not known."""


@dataclass(frozen=True)
class Column:
    """A column: its name, what it holds, its unit, and the frame that its components are in.

    `width` is the greatest number of bytes of a text, for formats with fields of fixed width.
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
    """Write CSV as RFC 4180 has it, a line for the names of the columns first."""
    import csv
    import io

    def lines(rows: Iterable[Sequence[object]]) -> bytes:
        text = io.StringIO(newline="")
        # A value that is None is written as nothing.
        csv.writer(text, lineterminator="\r\n").writerows(rows)
        return text.getvalue().encode()

    yield lines([table.names])
    for page in table.pages:
        if text := lines(zip(*page, strict=True)):
            yield text
