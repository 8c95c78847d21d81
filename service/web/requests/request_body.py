"""Request bodies: media type, size and time limits while streaming; and Idempotency-Key.

The server has no deadline for a body, and the framework would buffer a body
of any size.  A body that is too large is refused as soon as
it passes the bound; what still arrives of it is dropped unread.  All JSON bodies
together may take `Limits.budget_bytes` of memory until their requests are answered.
"""

import asyncio
import ctypes
import tempfile
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass
from typing import IO, Annotated, Any, TypeVar

from fastapi import Depends
from pydantic import BaseModel
from pydantic_core import from_json
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.types import Scope

from service.errors import BadBatch, BadInput, Busy, Fault, shown_value
from service.observations.decompress import Coding
from service.observations.field_faults import checked_by
from service.observations.input_formats import NDJSON, InputFormat
from service.web.requests.problems import NotJson

JSON = "application/json"
BINARY = "application/octet-stream"

MAX_JSON_BYTES = 2 << 20
"""Greatest size of a JSON body, enough for ten thousand stars, so that the error names them."""

Body = TypeVar("Body", bound=BaseModel)


@dataclass(frozen=True)
class BodyLimits:
    """Limits on the size and the duration of request bodies."""

    json_bytes: int = MAX_JSON_BYTES
    session_bytes: int = 4 << 10
    """Greatest size in bytes of the body of `POST /session`, which needs no token."""
    small_bytes: int = 8 << 10
    """Number of bytes of each body that the common budget leaves out: a batch of 60 stars is never
    refused because of others.
    """
    budget_bytes: int = 8 << 20
    replay_bytes: int = 1 << 30
    pause_s: float = 20.0
    """Longest wait in seconds for the next piece of a body."""
    json_s: float = 60.0
    replay_s: float = 3600.0
    file_s: float = 120.0


DEFAULT_LIMITS = BodyLimits()
COUNTED = "counted_bytes"
"""Key in the state of a request for the bytes that `BodyBudget` counts."""
RETRY_S = 1
TRIM_AFTER_BYTES, TRIM_AFTER_S = 4 << 20, 5.0
"""Freed bytes of large bodies, and delay in seconds, after which memory is returned."""


class BodyBudget:
    """Limits the total memory of all request bodies in progress."""

    def __init__(self, limits: BodyLimits) -> None:
        self._small_bytes = limits.small_bytes
        self._most_bytes = limits.budget_bytes
        self._bytes = self._freed_bytes = 0
        self._is_trim_due = False

    def add(self, request: Request, received: int) -> None:
        """Count the received bytes of a body; raises `Busy` beyond the limit."""
        state = request.scope.setdefault("state", {})
        counted = state.get(COUNTED, 0)
        more = max(received - self._small_bytes, 0) - counted
        if self._bytes + more > self._most_bytes:
            raise Busy("too many large bodies are being read at once", RETRY_S)
        self._bytes += more
        state[COUNTED] = counted + more

    def remove(self, scope: Scope) -> None:
        """Release the body of an answered request, which its connection would keep in memory."""
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
        trim_memory()


def trim_memory() -> None:
    """Return freed memory from the C library to the system; only glibc supports this."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


def _require_type(request: Request, allowed: tuple[str, ...]) -> str:
    """Media type of a body; raises 415 unless it is among `allowed`."""
    # Also a protection: pages of other sites can send only form types without a preflight.
    sent = request.headers.get("content-type", "")
    kind, _, parameters = sent.partition(";")
    kind, parameters = kind.strip().lower(), parameters.strip().lower().replace('"', "")
    json_like = JSON in allowed and kind.startswith("application/") and kind.endswith("+json")
    if kind not in allowed and not json_like:
        raise HTTPException(415, f"Content-Type must be {allowed[0]}, not {sent[:80] or 'absent'}")
    if parameters.startswith("charset=") and parameters not in ("charset=utf-8", "charset=utf8"):
        raise HTTPException(415, f"the body must be in UTF-8, not {parameters[:40]}")
    return kind


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
    """Read a JSON body within the limits."""
    return await read_json(request, request.app.state.limits.json_bytes)


async def session_body(request: Request) -> bytes:
    """Read the JSON body that begins a session; it needs no token."""
    return await read_json(request, request.app.state.limits.session_bytes)


async def read_json(request: Request, max_bytes: int) -> bytes:
    """Read a JSON body of at most `max_bytes` bytes."""
    _require_type(request, (JSON,))
    _coding(request, ("identity",))
    limits: BodyLimits = request.app.state.limits
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
    """A body stored in a rewound file, with its number of lines if known."""

    file: IO[bytes]
    coding: Coding
    lines: int | None
    form: str = NDJSON


async def telemetry_body(
    request: Request,
    new_file: Callable[[], IO[bytes]],
    discard: Callable[[IO[bytes]], object],
    formats: Mapping[str, InputFormat],
) -> Spooled:
    """Read telemetry in one of the formats into a new file; an incomplete one is discarded.

    Formats with one batch per line may be compressed.  `formats` are input formats by name.
    """
    kind = _require_type(request, sum((each.media_types for each in formats.values()), ()))
    form = next(name for name, each in formats.items() if kind in each.media_types)
    codings: tuple[Coding, ...] = (
        ("identity", "gzip", "zstd") if formats[form].one_a_line else ("identity",)
    )
    coding = _coding(request, codings)
    limits: BodyLimits = request.app.state.limits
    file = new_file()
    lines, last = 0, b"\n"
    try:
        async for piece in _pieces(request, limits.replay_bytes, limits.pause_s, limits.replay_s):
            file.write(piece)
            lines, last = lines + piece.count(b"\n"), piece[-1:] or last
    except OSError as error:
        discard(file)
        raise Busy(f"the upload cannot be stored now: {error.strerror}", RETRY_S) from None
    except BaseException:
        discard(file)
        raise
    if file.tell() == 0:
        discard(file)
        raise BadBatch(Fault("body", "has no lines; it must hold one batch per line"))
    file.seek(0)
    if not formats[form].one_a_line:
        return Spooled(file, coding, None, form)
    # The last line may lack its newline.
    return Spooled(file, coding, lines + (last != b"\n") if coding == "identity" else None)


async def file_body(request: Request, types: tuple[str, ...], max_bytes: int) -> IO[bytes]:
    """Read a file of some media types into a rewound temporary file that is deleted when closed."""
    _require_type(request, types)
    _coding(request, ("identity",))
    limits: BodyLimits = request.app.state.limits
    file = tempfile.TemporaryFile()  # noqa: SIM115 - its reader closes it
    try:
        async for piece in _pieces(request, max_bytes, limits.pause_s, limits.file_s):
            file.write(piece)
    except BaseException:
        file.close()
        raise
    file.seek(0)
    return file


def read_model(model: type[Body], body: bytes) -> Body:
    """Validated model of a body; an empty body gives the defaults."""
    try:
        return checked_by(model.model_validate_json, body or b"{}")
    except BadBatch as error:
        raise refused(body, error) from None


def refused(body: bytes, refusal: BadInput) -> BadInput:
    """Error for a refused body: `NotJson` if its text is not JSON.

    The text is parsed for this only after an error.
    """
    try:
        from_json(body)
    except ValueError:
        return NotJson(refusal.faults)
    return refusal


async def optional_json_body(request: Request) -> bytes:
    """Read a JSON body that may be absent, since all its fields have defaults."""
    has_none = request.headers.get("content-length", "0") == "0"
    if has_none and "transfer-encoding" not in request.headers:
        return b""
    return await json_body(request)


JsonBody = Annotated[bytes, Depends(json_body)]
OptionalJsonBody = Annotated[bytes, Depends(optional_json_body)]
SessionBody = Annotated[bytes, Depends(session_body)]


async def require_no_query(request: Request) -> None:
    """Raise `BadBatch` for every query parameter of a request."""
    faults = [
        Fault(name[:80], "unknown parameter; this route has none", shown_value(value))
        for name, value in request.query_params.items()
    ]
    if faults:
        raise BadBatch(faults)


async def idempotency_key(request: Request) -> str | None:
    """Idempotency key of a request, None without one; raises `BadBatch` for several."""
    keys = request.headers.getlist("Idempotency-Key")
    if not keys:
        return None
    key = keys[0]
    if len(set(keys)) > 1:
        raise BadBatch(Fault("Idempotency-Key", "must be sent only once", shown_value(keys)))
    return key


IdempotencyKey = Annotated[str | None, Depends(idempotency_key)]


def _no_idempotency_key(message: str) -> Any:
    async def require_none(request: Request) -> None:
        key = request.headers.get("Idempotency-Key")
        if key is not None:
            # An ignored key would let a client rely on it.
            raise BadBatch(Fault("Idempotency-Key", message, shown_value(key)))

    return Depends(require_none)


NO_IDEMPOTENCY_KEY = _no_idempotency_key(
    "belongs to new batches: a what-if that is recorded twice is there twice"
)
"""Dependency of a route that refuses idempotency keys, as a repeat makes another result."""
NO_KEY_OF_MANY = _no_idempotency_key(
    "belongs to one batch: of an array, each batch is recognised by its own batch id"
)
"""Dependency of a route for several batches, which refuses idempotency keys."""
NO_KEY_OF_A_BLOCK = _no_idempotency_key(
    "belongs to batches: a gyro block is recognised by its own name"
)
"""Dependency of a route for gyro blocks, which refuses idempotency keys."""
