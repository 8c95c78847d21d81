"""Histories as files to keep, in any of the output formats."""

from starlette.responses import Response, StreamingResponse

from service.app.history_table import Table
from service.app.output_formats import OUTPUT_FORMATS

THINNED = {
    "Thinned": {
        "description": "`true` if the period has more batches than the answer has points or rows.",
        "schema": {"type": "string", "enum": ["true", "false"]},
    }
}


def history_file(table: Table, format: str, name: str, *, is_thinned: bool) -> Response:
    """A short table as a file of that name."""
    written = OUTPUT_FORMATS[format]
    text = "".join(written.write(table.columns, table.pages))
    return Response(text, 200, _headers(name, format, is_thinned), media_type=written.media_type)


def streamed_file(table: Table, format: str, name: str) -> Response:
    """A table of every batch as a file of that name, sent as it is read."""
    written = OUTPUT_FORMATS[format]
    text = written.write(table.columns, table.pages)
    return StreamingResponse(text, 200, _headers(name, format, False), written.media_type)


def thinned_header(is_thinned: bool) -> dict[str, str]:
    """The header that says whether a history has less than was recorded."""
    return {"Thinned": "true" if is_thinned else "false"}


def _headers(name: str, format: str, is_thinned: bool) -> dict[str, str]:
    file = f"{name}.{format}".replace(":", "_")
    return {"Content-Disposition": f'attachment; filename="{file}"'} | thinned_header(is_thinned)
