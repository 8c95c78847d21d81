"""Encoding of the client's requests: addresses, queries and bodies."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeAlias, TypeVar
from urllib.parse import quote

import httpx
import msgspec

from .errors import InvalidArgument, UnexpectedAnswer

Batch: TypeAlias = Mapping[str, Any] | str | bytes
"""Batch in the API's form: a mapping, which may hold numpy arrays, or its JSON text."""

Time: TypeAlias = str | datetime
"""UTC as text, such as `1996-01-10T12:00:00Z` or `1996-010T12:00:00Z`, or with a time zone."""

Query: TypeAlias = Mapping[str, str | int | float | bool | Sequence[str] | datetime | None]

PIECE_BYTES = 1 << 16
BINARY = {"Content-Type": "application/octet-stream"}

T = TypeVar("T")


def checked_address(url: str) -> httpx.URL:
    """Parse the address of a service; raises `InvalidArgument` for an invalid one."""
    try:
        parsed = httpx.URL(url)
        valid = parsed.scheme in ("http", "https") and bool(parsed.host)
    except httpx.InvalidURL:
        valid = False
    if not valid:
        raise InvalidArgument(
            f"url must be the address of a service, such as http://127.0.0.1:8000 (got {url!r})"
        )
    return parsed


def bearer_of(token: str | None) -> dict[str, str]:
    """Header with a token, none without one; raises `InvalidArgument`, which hides the token.

    A token that was read from a file may end in a newline.
    """
    if token is None:
        return {}
    secret = token.strip()
    if not (secret and secret.isascii() and secret.isprintable() and " " not in secret):
        raise InvalidArgument("token must be printable ASCII characters without a space")
    return {"Authorization": f"Bearer {secret}"}


def path_of(*parts: str) -> str:
    """Path of the API from its parts, such as `/api/v1/batches/ID`."""
    return "/api/v1/" + "/".join(quote(each, safe="") for each in parts)


def parameters_of(query: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a query or a body; those that are None are left out."""
    return {name: _parameter(name, value) for name, value in query.items() if value is not None}


def _parameter(name: str, value: object) -> object:
    if isinstance(value, Iterable) and not isinstance(value, str | Mapping):
        return list(value)
    return _utc(name, value) if isinstance(value, datetime) else value


def _utc(name: str, value: datetime) -> str:
    if value.tzinfo is None:
        raise InvalidArgument(f"{name} must have a time zone, or be text in UTC (got {value!r})")
    return value.astimezone(UTC).replace(tzinfo=None).isoformat() + "Z"


def json_of(body: Batch) -> bytes:
    """Encode a body as JSON. NaN stays NaN: the service refuses it and names the field."""
    if isinstance(body, bytes):
        return body
    try:
        text = body if isinstance(body, str) else json.dumps(body, default=_plain)
        return text.encode()
    except (TypeError, ValueError) as error:
        if isinstance(error, InvalidArgument):
            raise
        raise InvalidArgument(f"the body cannot be sent as JSON: {error}") from None


def _plain(value: Any) -> Any:
    # Numpy's arrays and numbers have it.
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, datetime):
        return _utc("a time", value)
    raise InvalidArgument(f"JSON has no form for {value!r}")


def decoded(response: httpx.Response, kind: type[T]) -> T:
    """Decode the body of an answer as a model; raises `UnexpectedAnswer`."""
    try:
        return msgspec.json.decode(response.content, type=kind)
    except msgspec.DecodeError as error:
        request = response.request
        raise UnexpectedAnswer(f"{request.method} {request.url}: {error}") from None


def pieces_of(file: Path) -> Iterator[bytes]:
    """Read a file piece by piece."""
    with file.open("rb") as stream:
        while piece := stream.read(PIECE_BYTES):
            yield piece
