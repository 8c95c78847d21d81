"""Export responses: files written while they are sent, a limited number at a time."""

from collections import Counter
from collections.abc import Callable, Generator, Iterator
from threading import Lock
from typing import Annotated

from anyio import CancelScope
from anyio.to_thread import run_sync
from fastapi import Depends
from starlette.requests import Request
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from service.access import Caller
from service.errors import Busy, RateLimited
from service.table_files.formats import TABLE_FORMATS, write_table
from service.table_files.table import Table

MAX_OF_ONE_TOKEN = 2
MAX_EXPORTS = 8
"""Greatest number of simultaneous exports; each occupies a thread while it is written."""
RETRY_AFTER_S = 5


class Exports:
    """Limits and counts the exports in progress."""

    def __init__(self) -> None:
        self._under_way: Counter[str | None] = Counter()
        self._lock = Lock()

    def response(
        self,
        caller: Caller,
        write: Callable[[], Iterator[bytes]],
        media_type: str,
        headers: dict[str, str] | None = None,
    ) -> Response:
        """HTTP response that sends the output of `write`.

        Raises `RateLimited` if the caller's token has too many exports in progress, `Busy` if all
        callers together have, and any exception of `write`.
        """
        self._begin(caller)
        try:
            content = write()
        except BaseException:
            self._end(caller)
            raise
        return FileResponse(content, media_type, headers, lambda: self._end(caller))

    def _begin(self, caller: Caller) -> None:
        token = caller.token_id
        with self._lock:
            if token is not None and self._under_way[token] >= MAX_OF_ONE_TOKEN:
                message = f"{caller.name} has {MAX_OF_ONE_TOKEN} exports under way, which is most"
                raise RateLimited(message, RETRY_AFTER_S)
            if self._under_way.total() >= MAX_EXPORTS:
                raise Busy(f"{MAX_EXPORTS} exports are under way", RETRY_AFTER_S)
            self._under_way[token] += 1

    def _end(self, caller: Caller) -> None:
        with self._lock:
            self._under_way[caller.token_id] -= 1
            self._under_way += Counter()


class FileResponse(StreamingResponse):
    """Streaming response of a file written while sent; `leave` is called at the end in any case."""

    def __init__(
        self,
        content: Iterator[bytes],
        media_type: str,
        headers: dict[str, str] | None,
        leave: Callable[[], object],
    ) -> None:
        super().__init__(content, 200, headers, media_type)
        self._written, self._leave = content, leave

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send the file; its generator is closed also if the client has left."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._leave()
            if isinstance(self._written, Generator):
                with CancelScope(shield=True):
                    await run_sync(self._written.close)


async def _exports(request: Request) -> Exports:
    exports = request.app.state.exports
    assert isinstance(exports, Exports)
    return exports


ExportsDep = Annotated[Exports, Depends(_exports)]


THINNED = {
    "Thinned": {
        "description": "`true` if the period has more batches than the answer has points or rows.",
        "schema": {"type": "string", "enum": ["true", "false"]},
    }
}


def history_file(table: Table, format: str, name: str, *, is_thinned: bool) -> Response:
    """HTTP response with a short table as a file."""
    media_type = TABLE_FORMATS[format].media_type
    content = b"".join(write_table(format, table))
    headers = history_headers(name, format, is_thinned=is_thinned)
    return Response(content, 200, headers, media_type=media_type)


def thinned_header(is_thinned: bool) -> dict[str, str]:
    """HTTP header that tells if a history was thinned."""
    return {"Thinned": "true" if is_thinned else "false"}


def history_headers(name: str, format: str, *, is_thinned: bool) -> dict[str, str]:
    """HTTP headers of a history file."""
    return attached_as(name, TABLE_FORMATS[format].suffix or format) | thinned_header(is_thinned)


def attached_as(name: str, suffix: str) -> dict[str, str]:
    """HTTP header with the name under which a file is saved."""
    file = f"{name}.{suffix}".replace(":", "_")
    return {"Content-Disposition": f'attachment; filename="{file}"'}
