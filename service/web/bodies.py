"""Reading a request's body: its type checked, its size capped while it streams, its time bounded.

The server below has no deadline for a body and the framework would buffer
one whole, whatever its size.  A body that is too large is refused as soon as
it passes the bound; what still arrives of it is dropped unread.
"""

import asyncio
import tempfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import IO, Annotated, TypeVar

from fastapi import Depends
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request

from service.errors import BadBatch, BadInput, Fault
from service.observe.compressed import Coding
from service.observe.wire import faults_of
from service.web.errors import NotJson

JSON = "application/json"
BINARY = "application/octet-stream"
FRAMES = (
    "application/fits",
    "image/fits",
    "image/tiff",
    "image/png",
    "application/x-npy",
    BINARY,
)
"""A frame's file; what it is, its first bytes say."""
NDJSON = ("application/x-ndjson", "application/ndjson", "application/jsonl", BINARY)
"""The last is what generated clients can send: most know no type of lines."""

MAX_JSON_BYTES = 2 << 20
"""Ten thousand stars still fit, so that their number is what is complained of."""

Body = TypeVar("Body", bound=BaseModel)


@dataclass(frozen=True)
class Limits:
    """How large and how slow a body may be."""

    json_bytes: int = MAX_JSON_BYTES
    replay_bytes: int = 1 << 30
    pause_s: float = 20.0
    """The longest wait for the next piece of a body."""
    json_s: float = 60.0
    replay_s: float = 3600.0
    frame_s: float = 120.0


DEFAULT_LIMITS = Limits()


def _limits(request: Request) -> Limits:
    limits = request.app.state.limits
    assert isinstance(limits, Limits)
    return limits


def _require_type(request: Request, allowed: tuple[str, ...]) -> None:
    # Also a guard: a page of another site can only send form types without asking first.
    sent = request.headers.get("content-type", "")
    kind, _, parameters = sent.partition(";")
    kind, parameters = kind.strip().lower(), parameters.strip().lower().replace('"', "")
    json_like = JSON in allowed and kind.startswith("application/") and kind.endswith("+json")
    if kind not in allowed and not json_like:
        raise HTTPException(415, f"Content-Type must be {allowed[0]}, not {sent[:80] or 'absent'}")
    if parameters.startswith("charset=") and parameters not in ("charset=utf-8", "charset=utf8"):
        raise HTTPException(415, f"the body must be in UTF-8, not {parameters[:40]}")


def _coding(request: Request, allowed: tuple[Coding, ...]) -> Coding:
    sent = request.headers.get("content-encoding", "identity").strip().lower()
    for coding in allowed:
        if sent == coding:
            return coding
    known = ", ".join(allowed)
    detail = f"Content-Encoding {sent[:40]} is not supported here; there is {known}"
    raise HTTPException(415, detail, {"Accept-Encoding": known})


async def _pieces(
    request: Request, max_bytes: int, pause_s: float, total_s: float
) -> AsyncIterator[bytes]:
    too_large = HTTPException(413, f"the body may have at most {max_bytes} bytes")
    declared = request.headers.get("content-length", "")
    if (
        declared.isascii()
        and declared.isdigit()
        and (len(declared) > 15 or int(declared) > max_bytes)
    ):
        raise too_large
    received = 0
    clock = asyncio.get_running_loop().time
    deadline, more = clock() + total_s, True
    while more:
        try:
            async with asyncio.timeout_at(min(clock() + pause_s, deadline)):
                message = await request.receive()
        except TimeoutError:
            detail = f"the body did not arrive in time ({received} bytes did)"
            raise HTTPException(408, detail, {"Connection": "close"}) from None
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        piece: bytes = message.get("body", b"")
        more = message.get("more_body", False)
        received += len(piece)
        if received > max_bytes:
            raise too_large
        yield piece


async def json_body(request: Request) -> bytes:
    """The bytes of a JSON body."""
    _require_type(request, (JSON,))
    _coding(request, ("identity",))
    limits = _limits(request)
    pieces = _pieces(request, limits.json_bytes, limits.pause_s, limits.json_s)
    request.state.body = body = b"".join([piece async for piece in pieces])
    return body


@dataclass(frozen=True)
class Spooled:
    """A body in a file, rewound, with its number of lines where it is not packed."""

    file: IO[bytes]
    coding: Coding
    lines: int | None


async def ndjson_body(request: Request) -> Spooled:
    """An NDJSON body, perhaps packed; its file has no name and is gone once it is closed."""
    _require_type(request, NDJSON)
    coding = _coding(request, ("identity", "gzip", "zstd"))
    limits = _limits(request)
    file = tempfile.TemporaryFile()  # noqa: SIM115 - whoever reads the lines closes it
    lines, last = 0, b"\n"
    try:
        async for piece in _pieces(request, limits.replay_bytes, limits.pause_s, limits.replay_s):
            file.write(piece)
            lines, last = lines + piece.count(b"\n"), piece[-1:] or last
    except BaseException:
        file.close()
        raise
    if file.tell() == 0:
        file.close()
        raise BadBatch(Fault("body", "there are no lines; it must hold a batch a line"))
    file.seek(0)
    # A last line without an end is one, too.
    return Spooled(file, coding, lines + (last != b"\n") if coding == "identity" else None)


async def frame_body(request: Request, max_bytes: int) -> IO[bytes]:
    """A frame's file, rewound; it has no name and is gone once it is closed."""
    _require_type(request, FRAMES)
    _coding(request, ("identity",))
    limits = _limits(request)
    file = tempfile.TemporaryFile()  # noqa: SIM115 - whoever reads it closes it
    try:
        async for piece in _pieces(request, max_bytes, limits.pause_s, limits.frame_s):
            file.write(piece)
    except BaseException:
        file.close()
        raise
    file.seek(0)
    return file


def read_model(model: type[Body], body: bytes) -> Body:
    """The checked object in a body; an empty body is the object with every default."""
    try:
        return model.model_validate_json(body or b"{}")
    except ValidationError as error:
        raise refused(body, BadBatch(faults_of(error))) from None


def refused(body: bytes, refusal: BadInput) -> BadInput:
    """The refusal of a body, or `NotJson` where the form of its text is at fault.

    That is only looked at when something is wrong.
    """
    try:
        from_json(body)
    except ValueError:
        return NotJson(refusal.faults)
    return refusal


JsonBody = Annotated[bytes, Depends(json_body)]
