"""Output formats of tables, in one registry: `TABLE_FORMATS`.

Everything that names formats derives from it: the parameters `format` of the API, their
media types in the OpenAPI document, the links of the console, `acquire history --format`
and `acquire export`.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from pkgutil import resolve_name
from typing import Any, TypeVar

from service.extras import require_extra
from service.table_files.table import Table, write_csv

MOST_BATCHES = 5_000_000
"""Greatest number of batches in a temporary file, up to 400 bytes each."""

Writer = Callable[[Any], Iterator[bytes]]
T = TypeVar("T")


@dataclass(frozen=True)
class OutputFormat:
    """An output format of tables or attitudes; `title` is its displayed name.

    `suffix` is the file's, by default the name of the format.  `extra` is the extra of this project
    that the format needs, with the `package` that shows if it is installed.  A format with
    `any_order` also accepts rows in descending order of time; one with `may_be_empty` accepts no
    rows.  A format that keeps rows in a temporary file accepts at most `most_batches`.
    """

    title: str
    media_type: str
    write: Writer
    suffix: str = ""
    extra: str = ""
    package: str = ""
    any_order: bool = True
    may_be_empty: bool = True
    most_batches: int | None = None

    def require(self, name: str) -> None:
        """Raise `NotAvailable` with the command that installs the missing package."""
        require_extra(self.extra, self.package, "format", name)


def write_table(name: str, table: Table) -> Iterator[bytes]:
    """Write a table in a format, in pieces; raises `NotAvailable` if a package is missing."""
    written = TABLE_FORMATS[name]
    written.require(name)
    _, pages = read_ahead(table.pages)
    return written.write(replace(table, pages=pages))


def read_ahead(pages: Iterable[T]) -> tuple[bool, Iterator[T]]:
    """Read the first page at once; returns True if there is none, and all pages.

    Database errors are raised here, rather than after part of a file was sent.
    """
    rest = iter(pages)
    first = list(islice(rest, 1))
    return not first, chain(first, rest)


def imported_later(writer: str) -> Writer:
    """Writer named `package.module:name`, imported when first called to save start-up time."""
    return lambda content: resolve_name(writer)(content)


JSON_FORMAT = "json"
"""Name of the API's JSON format, which is no table format."""

TABLE_FORMATS: dict[str, OutputFormat] = {
    "csv": OutputFormat("CSV", "text/csv", write_csv),
    "parquet": OutputFormat(
        "Parquet",
        "application/vnd.apache.parquet",
        imported_later("service.table_files.binary:write_parquet"),
        extra="tables",
        package="pyarrow",
    ),
    "fits": OutputFormat(
        "FITS",
        "application/fits",
        imported_later("service.table_files.binary:write_fits"),
        extra="tables",
        package="astropy",
        most_batches=MOST_BATCHES,
    ),
}
"""Output formats of tables by name."""
