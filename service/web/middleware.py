"""Middleware: host check, HEAD, timing, audit, unanswered errors, and conditional requests."""

import json
import logging
import re
import time
from collections.abc import Mapping
from hashlib import blake2b
from random import getrandbits
from urllib.parse import parse_qs

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from fastapi.routing import APIRoute
from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import logs
from service.access import Access
from service.errors import Busy
from service.settings import is_loopback
from service.web.requests import problems
from service.web.requests.access import authorize, entry_of, is_open
from service.web.requests.metrics import Metrics
from service.web.requests.request_body import BodyBudget

log = logging.getLogger(__name__)

NOT_FOUND = problems.ProblemType(404, "Not Found")

requests = logging.getLogger("service.requests")

PROBES = ("/livez", "/readyz", "/metrics")
_MAX_PATH = 200
_SANE_ID = re.compile(rb"[A-Za-z0-9][A-Za-z0-9._:=+/@-]{0,127}")

_AUDIT_THREADS = CapacityLimiter(8)
_NO_SNIFF = (b"x-content-type-options", b"nosniff")


class AroundRequests:
    """Outermost middleware: times requests, answers HEAD as GET without body, forbids sniffing.

    While access is open, a request for a host of another name is refused: the
    page of another site could otherwise resolve its own name to this machine.

    Changes that were refused, or that changed memory only, get their audit entry
    before the answer is sent (`service.web.requests.access`).

    A request for one of the `direct` routes goes straight to its handler: the
    framework's routing and dependencies take twice as long as the rest of a
    submission's handling.

    An error that no other handler answered is answered here; otherwise the client
    would lose its connection.
    """

    def __init__(
        self,
        app: ASGIApp,
        metrics: Metrics,
        access: Access,
        body_budget: BodyBudget,
        direct: Mapping[tuple[str, str], APIRoute],
    ) -> None:
        """Keep `direct`, routes by method and path whose handlers take only the request."""
        self.app = app
        self.metrics = metrics
        self.access = access
        self.body_budget = body_budget
        self.direct = direct

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one HTTP request; pass on other ASGI events."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        started = time.perf_counter()
        is_head = scope["method"] == "HEAD"
        status = 0

        async def sent(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                if "changes" in inner.get("state", ()):
                    await self._audit(inner, status)
                headers = [*message["headers"], _NO_SNIFF, (b"x-request-id", about.id.encode())]
                if about.behind_s:
                    headers.append((b"x-behind-seconds", b"%.1f" % about.behind_s))
                message = {**message, "headers": headers}
            elif is_head:
                message = {**message, "body": b""}
            await send(message)

        # A scope of its own: the server still sees HEAD and frames the answer accordingly.
        inner = {**scope, "method": "GET"} if is_head else scope
        about = logs.RequestContext(_request_id(scope), run=_run(scope))
        # Every request has a task, and so a context, of its own.
        logs.request.set(about)
        try:
            host = _host(inner)
            is_other = host is not None and not is_loopback(host)
            if is_other and await self._is_open(inner["path"]):
                details = {"detail": f"the host must be a name of this machine, not {host!r}"}
                await problems.problem_response(Request(inner), problems.WRONG_HOST, details)(
                    inner, receive, sent
                )
                return
            route = self.direct.get((inner["method"], inner["path"]))
            if route is None:
                await self.app(inner, receive, sent)
            else:
                inner["route"] = route
                request = Request(inner, receive)
                response: Response
                try:
                    await authorize(request)
                    response = await route.endpoint(request)
                except Exception as error:
                    response = await problems.error_response(request, error)
                await response(inner, receive, sent)
        except Busy as error:
            # The database did not tell whether access is open.
            if status:
                raise
            await (await problems.error_response(Request(inner), error))(inner, receive, sent)
        except Exception as error:
            if status:
                raise
            await problems.internal_error(Request(inner), error)(inner, receive, sent)
        finally:
            self.body_budget.remove(inner)
            if WARM_REQUEST not in inner:
                seconds = time.perf_counter() - started
                self.metrics.count_request(inner, status, seconds)
                self._log(scope, inner, status, seconds)

    async def _is_open(self, path: str) -> bool:
        """True if access is open; for probes without a database, the last known answer."""
        try:
            return await is_open(self.access)
        except Busy:
            if path not in PROBES:
                raise
            return self.access.was_open

    def _log(self, scope: Scope, inner: Scope, status: int, seconds: float) -> None:
        """Log one line for a request, without query, headers and body."""
        method, path = scope["method"], scope["path"]
        usual = 200 <= status < 400 and (
            path in PROBES or path.startswith("/static/") or (inner["method"], path) in self.direct
        )
        level = logging.DEBUG if usual else logging.INFO
        if not requests.isEnabledFor(level):
            return
        milliseconds = round(1e3 * seconds, 1)
        fields = {"method": method, "path": path[:_MAX_PATH], "status": status or None}
        requests.log(
            level,
            "%s %s %s %.1f ms",
            method,
            path[:_MAX_PATH],
            status or "no answer",
            milliseconds,
            extra={"access": {**fields, "duration_ms": milliseconds}},
        )

    async def _audit(self, scope: Scope, status: int) -> None:
        state = scope["state"]
        action = state["changes"]
        # A change stores its own entry.  A 503 decides nothing, and the database may be its cause.
        if status == 503 or (state.get("noted") and status < 400):
            return
        try:
            entry = entry_of(scope, self.access, status)
            await run_sync(self.access.add_entry, entry, limiter=_AUDIT_THREADS)
        except Exception as error:
            # No record was changed: a failed entry must not replace the answer.
            log.error("%s by %s has no audit entry: %s", action, state["caller"].name, error)


class BelowPath:
    """Middleware that serves the app below a proxy's path, stripped by the proxy or not.

    The app itself does not know the path: it is put before every path in the headers of an
    answer.  `service.web.console.rendering` does the same for pages.
    """

    def __init__(self, app: ASGIApp, root_path: str) -> None:
        self.app = app
        self.root_path = root_path
        self._prefix = root_path.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one HTTP request below the path; pass on other ASGI events."""
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        path: str = scope["path"]
        if path == self.root_path or path.startswith(f"{self.root_path}/"):
            scope = {**scope, "path": path.removeprefix(self.root_path) or "/"}

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [(name, self._rooted(name, value)) for name, value in message["headers"]]
                message = {**message, "headers": headers}
            await send(message)

        await self.app(scope, receive, sent)

    def _rooted(self, name: bytes, value: bytes) -> bytes:
        if name in (b"location", b"content-location") and value.startswith(b"/"):
            return self._prefix + value
        if name == b"link":
            return value.replace(b"</", b"<" + self._prefix + b"/")
        if name == b"set-cookie":
            return value.replace(b"Path=/", b"Path=" + self._prefix)
        return value


class ProbesOnly:
    """ASGI app of the probe port: answers the paths of probes, and 404 for all others."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request to the probe port."""
        if scope["path"] in PROBES:
            await self.app(scope, receive, send)
            return
        details = {"detail": f"this port answers only probes: {', '.join(PROBES)}"}
        await problems.problem_response(Request(scope), NOT_FOUND, details)(scope, receive, send)


def _header(scope: Scope, name: bytes) -> bytes | None:
    for each, value in scope["headers"]:
        if each == name:
            return bytes(value)
    return None


def _request_id(scope: Scope) -> str:
    """Request id given by a client or proxy if it is a plain word; otherwise a new one."""
    # Not by `secrets`: its system call gives up the interpreter's lock, and an id may be guessed.
    sent = _header(scope, b"x-request-id") or b""
    return sent.decode() if _SANE_ID.fullmatch(sent) else f"{getrandbits(64):016x}"


def _run(scope: Scope) -> str | None:
    """Run named in the query of a request, None without one."""
    query: bytes = scope["query_string"]
    if b"run=" not in query:
        return None
    named = parse_qs(query.decode("latin-1")).get("run")
    return named[0][:128] if named else None


def _host(scope: Scope) -> str | None:
    """Host name of a request without the port; None without a Host field."""
    text = _header(scope, b"host")
    if text is None:
        return None
    host: str = text.decode("latin-1")[:255].lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]


WARM_REQUEST = "service.warm_request"
"""Key in the scope of the warm-up request, which metrics and logs leave out."""

_PATH = "/api/v1/batches"
# Its form is right, but there is no such spacecraft.
_STARS = [{"vector": [0.0, 0.01 * k, 1.0 - 5e-5 * k * k], "magnitude": 5.0} for k in range(5)]
_BATCH = {
    "spacecraft": "none:warm-up",
    "batch": "warm-up",
    "time": "2000-01-01T00:00:00Z",
    "a_priori": {"quaternion": [0.0, 0.0, 0.0, 1.0]},
    "velocity_km_per_s": [7.5, 0.0, 0.0],
    "observations": [{"tracker": "1", "stars": _STARS}],
}
_BODY = json.dumps(_BATCH).encode()


async def warm_request(app: ASGIApp) -> int:
    """Send the app a batch of an unknown spacecraft to warm it up; returns the HTTP status.

    The batch is checked, queued and refused by the writer's thread, or by the access check if
    tokens are required.
    """
    head = (
        ("host", "localhost"),
        ("content-type", "application/json"),
        ("content-length", str(len(_BODY))),
    )
    scope: Scope = {
        "type": "http",
        "asgi": {"version": "3.0"},
        "http_version": "1.1",
        "scheme": "http",
        "method": "POST",
        "path": _PATH,
        "raw_path": _PATH.encode(),
        "root_path": "",
        "query_string": b"",
        "headers": [(name.encode(), value.encode()) for name, value in head],
        "client": None,
        "server": None,
        WARM_REQUEST: True,
    }
    status = 0

    async def receive() -> Message:
        return {"type": "http.request", "body": _BODY, "more_body": False}

    async def send(message: Message) -> None:
        nonlocal status
        status = message.get("status", status)

    await app(scope, receive, send)
    return status


API = "/api/"
DIGEST_BYTES = 16
KEPT_ON_304 = frozenset({b"cache-control", b"content-location", b"etag", b"link", b"vary"})
"""Headers that a 304 answer without a body repeats."""


class ConditionalAnswers:
    """Middleware that adds ETags to GET answers under `/api/`, and answers 304 if unchanged.

    Only whole answers in one piece have one: streams are passed on.  The ETag is weak, for it is
    the same whether the answer is compressed or not.
    """

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request; HEAD arrives as GET (`AroundRequests`)."""
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
    """True if a message begins a 200 answer in one piece; streams have no content length."""
    return (
        message["type"] == "http.response.start"
        and message["status"] == 200
        and any(name == b"content-length" for name, _ in message["headers"])
    )


def _tagged(start: Message, message: Message, asked: Headers) -> tuple[Message, Message]:
    """Answer with its ETag, or without its body if the client already has that ETag."""
    digest = blake2b(message.get("body", b""), digest_size=DIGEST_BYTES).hexdigest()
    headers = MutableHeaders(raw=list(start["headers"]))
    headers["ETag"] = tag = f'W/"{digest}"'
    # The answer may be for one caller, and must be checked each time: a session may have ended.
    headers.setdefault("Cache-Control", "private, no-cache")
    if not _names(asked, tag):
        return {**start, "headers": headers.raw}, message
    kept = [each for each in headers.raw if each[0] in KEPT_ON_304]
    return {**start, "status": 304, "headers": kept}, {**message, "body": b""}


def _names(asked: Headers, tag: str) -> bool:
    """True if `If-None-Match` contains a tag; weak and strong tags compare equal."""
    opaque = tag.removeprefix("W/")
    named = [each.strip() for line in asked.getlist("if-none-match") for each in line.split(",")]
    return any(each == "*" or each.removeprefix("W/") == opaque for each in named)
