"""The registry of output formats: of tables, and of attitudes.

Everything that names formats derives from it: the parameters `format` of the API, their
media types in the OpenAPI document, the links of the console, `acquire history --format`
and `acquire export`.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain, islice
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, TypeVar

from service.errors import BadBatch, Fault, NotFound
from service.extras import require_extra
from service.products.tables import Table, write_csv

if TYPE_CHECKING:
    from service.products.attitudes import AttitudeSeries

MOST_BATCHES = 5_000_000
"""The most batches of a period whose attitudes are in a temporary file: up to 400 bytes each."""

TableWriter = Callable[[Table], Iterator[bytes]]
AttitudeWriter = Callable[["AttitudeSeries"], Iterator[bytes]]
T = TypeVar("T")


@dataclass(frozen=True)
class OutputFormat:
    """A way to write a table, attitudes, or both; `title` is its name for people.

    A format with `write_table` writes attitudes as a table.  `suffix` is that of a file,
    by default the name of the format.  `extra` is the extra of this project that the format
    needs, with the `package` that tells whether it is installed.  A format of `any_order`
    takes attitudes in descending order of time too; one that `may_be_empty` can hold none.
    A format that keeps attitudes in a temporary file takes periods of `most_batches` at most.
    """

    title: str
    media_type: str
    write_table: TableWriter | None = None
    write_attitudes: AttitudeWriter | None = None
    suffix: str = ""
    extra: str = ""
    package: str = ""
    any_order: bool = True
    may_be_empty: bool = True
    most_batches: int | None = None

    def require(self, name: str) -> None:
        """Raise `NotAvailable` with the command that installs what the format lacks."""
        require_extra(self.extra, self.package, "format", name)


def table_formats() -> dict[str, OutputFormat]:
    """The formats of tables, by name."""
    return {name: each for name, each in OUTPUT_FORMATS.items() if each.write_table is not None}


def attitude_formats() -> dict[str, OutputFormat]:
    """The formats of attitudes, by name: JSON first, which the API answers by default."""
    return {JSON_FORMAT: JSON, **OUTPUT_FORMATS}


def file_suffix(name: str) -> str:
    """The suffix of a file of a format, without the dot."""
    return attitude_formats()[name].suffix or name


def write_attitudes(name: str, series: "AttitudeSeries") -> Iterator[bytes]:
    """Attitudes in a format, in pieces; raises `NotAvailable` where a package is missing."""
    written = attitude_formats()[name]
    written.require(name)
    if series.about.newest_first and not written.any_order:
        raise BadBatch(Fault("order", f"must be oldest for the format {name}", "'newest'"))
    is_empty, blocks = _read_ahead(series.blocks)
    if is_empty and not written.may_be_empty:
        raise NotFound(f"{series.about.described()}: none, and {written.title} cannot be empty")
    series = replace(series, blocks=blocks)
    if written.write_attitudes is not None:
        return written.write_attitudes(series)
    from service.products.attitudes import attitude_table

    assert written.write_table is not None
    return written.write_table(attitude_table(series))


def write_table(name: str, table: Table) -> Iterator[bytes]:
    """A table in a format, in pieces; raises `NotAvailable` where a package is missing."""
    written = OUTPUT_FORMATS[name]
    written.require(name)
    assert written.write_table is not None
    _, pages = _read_ahead(table.pages)
    return written.write_table(replace(table, pages=pages))


def _read_ahead(pages: Iterable[T]) -> tuple[bool, Iterator[T]]:
    """A flag that is true if there is none, and the pages, of which the first is read at once.

    Errors of the database are raised here, and not when part of a file is sent already.
    """
    rest = iter(pages)
    first = list(islice(rest, 1))
    return not first, chain(first, rest)


def _later(name: str) -> Callable[[Any], Iterator[bytes]]:
    """The writer of a name, imported when it is called: a command that prints help loads none."""
    return lambda content: resolve_name(f"service.products.{name}")(content)


JSON_FORMAT = "json"
JSON = OutputFormat("JSON", "application/json", write_attitudes=_later("attitudes:write_json"))
"""The API's own form; a history as JSON is no table."""


def _message(title: str, media_type: str, writer: str, **more: Any) -> OutputFormat:
    """A format of attitudes alone, oldest first, at least one."""
    arguments = {"most_batches": MOST_BATCHES, **more}
    return OutputFormat(
        title,
        media_type,
        write_attitudes=_later(writer),
        any_order=False,
        may_be_empty=False,
        **arguments,
    )


OUTPUT_FORMATS: dict[str, OutputFormat] = {
    "csv": OutputFormat("CSV", "text/csv", write_table=write_csv),
    "parquet": OutputFormat(
        "Parquet",
        "application/vnd.apache.parquet",
        write_table=_later("table_files:write_parquet"),
        extra="tables",
        package="pyarrow",
    ),
    "fits": OutputFormat(
        "FITS",
        "application/fits",
        write_table=_later("table_files:write_fits"),
        extra="tables",
        package="astropy",
        most_batches=MOST_BATCHES,
    ),
    "aem": _message("CCSDS AEM", "text/plain", "ccsds:write_aem_kvn"),
    "aem-xml": _message(
        "CCSDS AEM (XML)", "application/xml", "ccsds:write_aem_xml", suffix="aem.xml"
    ),
    "apm": _message(
        "CCSDS APM (the last attitude)", "text/plain", "ccsds:write_apm", most_batches=None
    ),
    "acm": _message("CCSDS ACM", "text/plain", "ccsds:write_acm"),
    "ck": _message(
        "SPICE CK",
        "application/zip",
        "ck:write_ck",
        suffix="ck.zip",
        extra="spice",
        package="spiceypy",
    ),
}
"""The output formats by name."""
