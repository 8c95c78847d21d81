"""Conditional requests: an answer that the client holds already is not sent again (RFC 9110)."""

from hashlib import blake2b

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

API = "/api/"
DIGEST_BYTES = 16
KEPT_ON_304 = frozenset({b"cache-control", b"content-location", b"etag", b"link", b"vary"})
"""Headers that an answer without a body repeats."""


class ConditionalAnswers:
    """Gives the answers to GET under `/api/` an ETag, and answers 304 where the client has it.

    Only whole answers in one piece have one: streams are passed on.  The ETag is weak, for it is
    the same whether the answer is compressed or not.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request; HEAD comes as GET (`AroundRequests`)."""
        if scope["type"] != "http" or scope["method"] != "GET" or not scope["path"].startswith(API):
            await self.app(scope, receive, send)
            return
        start: Message | None = None

        async def sent(message: Message) -> None:
            nonlocal start
            if _is_whole(message):
                start = message
                return
            if start is not None:
                start, message = _tagged(start, message, Headers(scope=scope))
                await send(start)
                start = None
            await send(message)

        await self.app(scope, receive, sent)


def _is_whole(message: Message) -> bool:
    """Whether a message begins an answer that comes in one piece; streams tell no length."""
    return (
        message["type"] == "http.response.start"
        and message["status"] == 200
        and any(name == b"content-length" for name, _ in message["headers"])
    )


def _tagged(start: Message, message: Message, asked: Headers) -> tuple[Message, Message]:
    """The answer with its ETag, or without its body where the client names that ETag."""
    digest = blake2b(message.get("body", b""), digest_size=DIGEST_BYTES).hexdigest()
    headers = MutableHeaders(raw=list(start["headers"]))
    headers["ETag"] = tag = f'W/"{digest}"'
    # It may be the caller's alone, and is asked for again each time: a session may have ended.
    headers.setdefault("Cache-Control", "private, no-cache")
    if not _names(asked, tag):
        return {**start, "headers": headers.raw}, message
    kept = [each for each in headers.raw if each[0] in KEPT_ON_304]
    return {**start, "status": 304, "headers": kept}, {**message, "body": b""}


def _names(asked: Headers, tag: str) -> bool:
    """Whether `If-None-Match` names a tag; weak and strong ones of one name are the same."""
    opaque = tag.removeprefix("W/")
    named = [each.strip() for line in asked.getlist("if-none-match") for each in line.split(",")]
    return any(each == "*" or each.removeprefix("W/") == opaque for each in named)
