"""Output formats of attitudes: tables, and formats of flight dynamics."""

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from service.errors import BadBatch, Fault, NotFound
from service.table_files.formats import (
    JSON_FORMAT,
    MOST_BATCHES,
    TABLE_FORMATS,
    OutputFormat,
    imported_later,
    read_ahead,
)

if TYPE_CHECKING:
    # numpy takes long to load, and `acquire --help` names the formats.
    from service.features.products.attitudes import AttitudeSeries


def attitude_formats() -> dict[str, OutputFormat]:
    """Output formats of attitudes by name; JSON, the default of the API, is first."""
    return {JSON_FORMAT: JSON, **TABLE_FORMATS, **ATTITUDE_FORMATS}


def file_suffix(name: str) -> str:
    """File suffix of a format, without the dot."""
    return attitude_formats()[name].suffix or name


def write_attitudes(name: str, series: "AttitudeSeries") -> Iterator[bytes]:
    """Write attitudes in pieces; raises for a missing package, a wrong order, or no attitude."""
    written = attitude_formats()[name]
    written.require(name)
    if series.about.newest_first and not written.any_order:
        raise BadBatch(Fault("order", f"must be oldest for the format {name}", "'newest'"))
    is_empty, blocks = read_ahead(series.blocks)
    if is_empty and not written.may_be_empty:
        raise NotFound(f"{series.about.described()}: none, and {written.title} cannot be empty")
    series = replace(series, blocks=blocks)
    if name not in TABLE_FORMATS:
        return written.write(series)
    from service.features.products.attitudes import attitude_table

    return written.write(attitude_table(series))


def _message(title: str, media_type: str, writer: str, **more: Any) -> OutputFormat:
    """Output format that requires oldest-first order and at least one attitude."""
    arguments = {"most_batches": MOST_BATCHES, "any_order": False, "may_be_empty": False, **more}
    return OutputFormat(title, media_type, _writer(writer), **arguments)


def _writer(name: str) -> Any:
    return imported_later(f"{__package__}.{name}")


JSON = OutputFormat("JSON", "application/json", _writer("attitudes:write_json"))

ATTITUDE_FORMATS: dict[str, OutputFormat] = {
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
"""Formats for attitudes only, not for other tables, by name."""
