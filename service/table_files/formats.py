"""The output formats of tables; see `TABLE_FORMATS`.

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
"""The most batches of a period that are kept in a temporary file: up to 400 bytes each."""

Writer = Callable[[Any], Iterator[bytes]]
T = TypeVar("T")


@dataclass(frozen=True)
class OutputFormat:
    """A way to write a table or attitudes; `title` is its name for people.

    `suffix` is that of a file, by default the name of the format.  `extra` is the extra of this
    project that the format needs, with the `package` that tells whether it is installed.
    A format of `any_order` takes rows in descending order of time too; one that `may_be_empty`
    can hold none.  A format that keeps rows in a temporary file takes periods of `most_batches`
    at most.
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
        """Raise `NotAvailable` with the command that installs what the format lacks."""
        require_extra(self.extra, self.package, "format", name)


def write_table(name: str, table: Table) -> Iterator[bytes]:
    """A table in a format, in pieces; raises `NotAvailable` where a package is missing."""
    written = TABLE_FORMATS[name]
    written.require(name)
    _, pages = read_ahead(table.pages)
    return written.write(replace(table, pages=pages))


def read_ahead(pages: Iterable[T]) -> tuple[bool, Iterator[T]]:
    """A flag that is true if there is none, and the pages, of which the first is read at once.

    Errors of the database are raised here, and not when part of a file is sent already.
    """
    rest = iter(pages)
    first = list(islice(rest, 1))
    return not first, chain(first, rest)


def imported_later(writer: str) -> Writer:
    """A writer such as `package.module:name`, imported when called: printing help loads none."""
    return lambda content: resolve_name(writer)(content)


JSON_FORMAT = "json"
"""The name of the API's own form, which is no table."""

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
"""The output formats of tables by name."""
