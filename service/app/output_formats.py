"""The registry of output formats, in which tables are written to a file.

Everything that names formats derives from it: the parameter `format` of the API, its media
types in the OpenAPI document, the links of the console, and `acquire history --format`.
"""

import csv
import io
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

TableRow = Sequence[object]
Write = Callable[[Sequence[str], Iterable[Iterable[TableRow]]], Iterator[str]]


@dataclass(frozen=True)
class OutputFormat:
    """A way to write a table; `title` is its name for people.

    `write` takes the names of the columns and the rows, page by page, and gives the text
    in pieces.  A value that is not known is None.
    """

    title: str
    media_type: str
    write: Write


def write_csv(columns: Sequence[str], pages: Iterable[Iterable[TableRow]]) -> Iterator[str]:
    """Write CSV as RFC 4180 has it, a line for the names of the columns first."""
    yield _csv_lines([columns])
    for rows in pages:
        yield _csv_lines(["" if value is None else value for value in row] for row in rows)


def _csv_lines(rows: Iterable[TableRow]) -> str:
    text = io.StringIO(newline="")
    csv.writer(text, lineterminator="\r\n").writerows(rows)
    return text.getvalue()


OUTPUT_FORMATS: dict[str, OutputFormat] = {"csv": OutputFormat("CSV", "text/csv", write_csv)}
"""By name, which is also the suffix of a file."""
