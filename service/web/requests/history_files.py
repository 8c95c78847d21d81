"""Histories as files to keep, in any of the output formats."""

from starlette.responses import Response

from service.products.formats import OUTPUT_FORMATS, file_suffix, write_table
from service.products.tables import Table

THINNED = {
    "Thinned": {
        "description": "`true` if the period has more batches than the answer has points or rows.",
        "schema": {"type": "string", "enum": ["true", "false"]},
    }
}


def history_file(table: Table, format: str, name: str, *, is_thinned: bool) -> Response:
    """A short table as a file of that name."""
    media_type = OUTPUT_FORMATS[format].media_type
    content = b"".join(write_table(format, table))
    headers = history_headers(name, format, is_thinned=is_thinned)
    return Response(content, 200, headers, media_type=media_type)


def thinned_header(is_thinned: bool) -> dict[str, str]:
    """The header that says whether a history has less than was recorded."""
    return {"Thinned": "true" if is_thinned else "false"}


def history_headers(name: str, format: str, *, is_thinned: bool) -> dict[str, str]:
    """The headers of a history as a file of that name."""
    return attached_as(name, format) | thinned_header(is_thinned)


def attached_as(name: str, format: str) -> dict[str, str]:
    """The header that names the file that an answer is saved as."""
    file = f"{name}.{file_suffix(format)}".replace(":", "_")
    return {"Content-Disposition": f'attachment; filename="{file}"'}
