"""Histories as files to keep, in any of the output formats."""

from starlette.responses import Response, StreamingResponse

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
    return Response(content, 200, _headers(name, format, is_thinned), media_type=media_type)


def streamed_file(table: Table, format: str, name: str) -> Response:
    """A table of every batch as a file of that name, sent as it is read."""
    media_type = OUTPUT_FORMATS[format].media_type
    content = write_table(format, table)
    return StreamingResponse(content, 200, _headers(name, format, False), media_type)


def thinned_header(is_thinned: bool) -> dict[str, str]:
    """The header that says whether a history has less than was recorded."""
    return {"Thinned": "true" if is_thinned else "false"}


def _headers(name: str, format: str, is_thinned: bool) -> dict[str, str]:
    return attached_as(name, format) | thinned_header(is_thinned)


def attached_as(name: str, format: str) -> dict[str, str]:
    """The header that names the file that an answer is saved as."""
    file = f"{name}.{file_suffix(format)}".replace(":", "_")
    return {"Content-Disposition": f'attachment; filename="{file}"'}
