"""Responses that a connection writes itself, for requests that never reach the app."""

import json
from http import HTTPStatus

MAX_HEAD_BYTES = 64 << 10
"""Of a request line with its header fields, and of the trailer fields after a chunked body."""
MAX_FIELDS = 100
"""Header fields of a head, or trailer fields."""


def _raw_response(status: HTTPStatus, detail: str, *headers: str) -> bytes:
    problem = {"type": "about:blank", "title": status.phrase, "status": int(status)}
    body = json.dumps(problem | {"detail": detail}, separators=(",", ":"))
    lines = (
        f"HTTP/1.1 {int(status)} {status.phrase}",
        "content-type: application/problem+json",
        f"content-length: {len(body)}",
        "connection: close",
        *headers,
    )
    return ("\r\n".join(lines) + "\r\n\r\n" + body).encode()


RAW_RESPONSES = {
    status: _raw_response(status, detail, *headers)
    for status, detail, *headers in (
        (
            HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE,
            f"a head, or trailers, may have {MAX_HEAD_BYTES} bytes and {MAX_FIELDS} fields",
        ),
        (
            HTTPStatus.SERVICE_UNAVAILABLE,
            "all connections that the service or this address may have are in use",
            "retry-after: 1",
        ),
    )
}
"""Whole responses by status, as bytes."""
