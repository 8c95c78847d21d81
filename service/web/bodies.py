"""Reading a request's body: its type checked, its size capped while it streams, its time bounded.

The server below has no deadline for a body and the framework would buffer
one whole, whatever its size.  A body that is too large is refused as soon as
it passes the bound; what still arrives of it is dropped unread.  All JSON bodies
together may take `Limits.budget_bytes` of memory until their requests are answered.
"""

import asyncio
import ctypes
import tempfile
from collections.abc import AsyncIterator
from dataclasses import dataclass
from typing import IO, Annotated, TypeVar

from fastapi import Depends
from pydantic import BaseModel, ValidationError
from pydantic_core import from_json
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import Scope

from service.errors import BadBatch, BadInput, Busy, Fault
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
    session_bytes: int = 4 << 10
    """Of `POST /session`, which asks for no token."""
    small_bytes: int = 8 << 10
    """So much of each body is not counted in `budget_bytes`: a batch of 60 stars is never
    refused because of others."""
    budget_bytes: int = 8 << 20
    replay_bytes: int = 1 << 30
    pause_s: float = 20.0
    """The longest wait for the next piece of a body."""
    json_s: float = 60.0
    replay_s: float = 3600.0
    frame_s: float = 120.0


DEFAULT_LIMITS = Limits()
COUNTED = "counted_bytes"
"""In the state of a request: how much of its body is counted in `BodyBudget`."""
RETRY_S = 1
TRIM_AFTER_BYTES, TRIM_AFTER_S = 4 << 20, 5.0
"""Memory is given back so long after so many bytes of large bodies: it takes some 5 ms."""


class BodyBudget:
    """Counts the bytes of all bodies that are held in memory."""

    def __init__(self, limits: Limits) -> None:
        self._small_bytes = limits.small_bytes
        self._most_bytes = limits.budget_bytes
        self._bytes = self._freed_bytes = 0
        self._is_trim_due = False

    def add(self, request: Request, received: int) -> None:
        """Count a request's body, of which so much has arrived; raises `Busy` beyond the bound."""
        state = request.scope.setdefault("state", {})
        counted = state.get(COUNTED, 0)
        more = max(received - self._small_bytes, 0) - counted
        if self._bytes + more > self._most_bytes:
            raise Busy("too many large bodies are being read at once", RETRY_S)
        self._bytes += more
        state[COUNTED] = counted + more

    def remove(self, scope: Scope) -> None:
        """The request is answered: forget its body, which its connection would keep."""
        state = scope.get("state", {})
        state.pop("body", None)
        counted = state.pop(COUNTED, 0)
        if not counted:
            return
        self._bytes -= counted
        self._freed_bytes += counted
        if self._freed_bytes >= TRIM_AFTER_BYTES and not self._is_trim_due:
            self._is_trim_due = True
            asyncio.get_running_loop().call_later(TRIM_AFTER_S, self._trim)

    def _trim(self) -> None:
        self._freed_bytes, self._is_trim_due = 0, False
        give_memory_back()


def give_memory_back() -> None:
    """Return to the system what the C library keeps of freed memory; glibc alone can."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


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
    return await _json_body(request, _limits(request).json_bytes)


async def session_body(request: Request) -> bytes:
    """The bytes of a JSON body that begins a session: anybody may send it."""
    return await _json_body(request, _limits(request).session_bytes)


async def _json_body(request: Request, max_bytes: int) -> bytes:
    _require_type(request, (JSON,))
    _coding(request, ("identity",))
    limits = _limits(request)
    budget: BodyBudget = request.app.state.body_budget
    pieces: list[bytes] = []
    received = 0
    async for piece in _pieces(request, max_bytes, limits.pause_s, limits.json_s):
        received += len(piece)
        budget.add(request, received)
        pieces.append(piece)
    request.state.body = body = b"".join(pieces)
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
SessionBody = Annotated[bytes, Depends(session_body)]
