"""What happens around every request: whom it is for, HEAD, timing, the last resort."""

import logging
import re
import secrets
import time
from collections.abc import Mapping
from urllib.parse import parse_qs

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from fastapi.routing import APIRoute
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service import logs
from service.errors import Busy
from service.records.access import Access
from service.settings import is_loopback
from service.web.access import entry_of, guard, is_open
from service.web.bodies import BodyBudget
from service.web.errors import Kind, answer_to, our_fault, problem
from service.web.metrics import Metrics
from service.web.rehearsal import REHEARSAL

NOT_HERE = Kind(421, "This is another host's", "not-this-host")
NOT_FOUND = Kind(404, "Not Found")

log = logging.getLogger(__name__)
requests = logging.getLogger("service.requests")

_PROBES = ("/livez", "/readyz", "/metrics")
_MAX_PATH = 200
_SANE_ID = re.compile(rb"[A-Za-z0-9][A-Za-z0-9._:=+/@-]{0,127}")

_NOTES = CapacityLimiter(8)
_NO_SNIFF = (b"x-content-type-options", b"nosniff")


class AroundRequests:
    """Times every request, answers HEAD as GET without its body, and forbids type guessing.

    While access is open, a request for a host of another name is refused: a
    page elsewhere could let its own name lead to this machine, and would then
    be let in as this one.

    What a caller was refused, or changed in memory alone, is noted before the
    answer goes out (`service.web.access`).

    A request for one of the `direct` routes goes straight to its handler: to find
    a route, and out what its handler depends on, takes the framework twice as
    long as all else that a batch needs of it.

    An error that nothing below has answered is answered here; let through, it
    would cost the client its connection.
    """

    def __init__(
        self,
        app: ASGIApp,
        metrics: Metrics,
        access: Access,
        body_budget: BodyBudget,
        direct: Mapping[tuple[str, str], APIRoute],
    ) -> None:
        """`direct` routes stand under method and path; their handlers take the request alone."""
        self.app = app
        self.metrics = metrics
        self.access = access
        self.body_budget = body_budget
        self.direct = direct

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request, or pass on what is none."""
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
                await self._note(inner, status)
                headers = [*message["headers"], _NO_SNIFF, (b"x-request-id", about.id.encode())]
                message = {**message, "headers": headers}
            elif is_head:
                message = {**message, "body": b""}
            await send(message)

        # A scope of its own: the server still sees HEAD and frames the answer accordingly.
        inner = {**scope, "method": "GET"} if is_head else scope
        about = logs.About(_request_id(scope), run=_run(scope))
        # Every request has a task, and so a context, of its own.
        logs.request.set(about)
        try:
            host = _host(inner)
            if host is not None and not is_loopback(host) and await is_open(self.access):
                told = {"detail": f"the service answers to names of this machine, not to {host!r}"}
                await problem(Request(inner), NOT_HERE, told)(inner, receive, sent)
                return
            route = self.direct.get((inner["method"], inner["path"]))
            if route is None:
                await self.app(inner, receive, sent)
            else:
                inner["route"] = route
                response = await _answered(route, Request(inner, receive))
                await response(inner, receive, sent)
        except Busy as error:
            # Whether access is open could not be found out.
            if status:
                raise
            await (await answer_to(Request(inner), error))(inner, receive, sent)
        except Exception as error:
            if status:
                raise
            await our_fault(Request(inner), error)(inner, receive, sent)
        finally:
            self.body_budget.remove(inner)
            if REHEARSAL not in inner:
                seconds = time.perf_counter() - started
                self.metrics.count_request(inner, status, seconds)
                self._log(scope, inner, status, seconds)

    def _log(self, scope: Scope, inner: Scope, status: int, seconds: float) -> None:
        """One line for a request: no query, no header and no body."""
        method, path = scope["method"], scope["path"]
        usual = 200 <= status < 400 and (
            path in _PROBES or path.startswith("/static/") or (inner["method"], path) in self.direct
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

    async def _note(self, scope: Scope, status: int) -> None:
        state = scope.get("state", {})
        action = state.get("changes")
        # What was changed is noted with the change itself; of a 503 nothing is decided, and the
        # database that it may be about is not asked once more.
        if action is None or status == 503 or (state.get("noted") and status < 400):
            return
        try:
            entry = entry_of(scope, self.access, status)
            await run_sync(self.access.note, entry, limiter=_NOTES)
        except Exception as error:
            # Nothing in the records was changed: the answer must not be lost to this.
            log.error("%s by %s was not noted: %s", action, state["caller"].name, error)


PROBES = ("/livez", "/readyz", "/metrics")


class ProbesAlone:
    """The app of the port for probes: it passes on their paths, and answers 404 to all others."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one request.  The other port's app is opened and closed with the server."""
        if scope["path"] in PROBES:
            await self.app(scope, receive, send)
            return
        told = {"detail": f"this port answers probes alone: {', '.join(PROBES)}"}
        await problem(Request(scope), NOT_FOUND, told)(scope, receive, send)


async def _answered(route: APIRoute, request: Request) -> Response:
    """What a direct route answers, guarded as every route is."""
    try:
        await guard(request)
        response: Response = await route.endpoint(request)
    except Exception as error:
        return await answer_to(request, error)
    return response


def _request_id(scope: Scope) -> str:
    """The id that a client or a proxy gave a request, where it is a plain word; else a new one."""
    given = next((value for name, value in scope["headers"] if name == b"x-request-id"), b"")
    return given.decode() if _SANE_ID.fullmatch(given) else secrets.token_hex(8)


def _run(scope: Scope) -> str | None:
    """The run that a query names."""
    query: bytes = scope["query_string"]
    if b"run=" not in query:
        return None
    named = parse_qs(query.decode("latin-1")).get("run")
    return named[0][:128] if named else None


def _host(scope: Scope) -> str | None:
    """The name that a request is for, without its port; None where it names none."""
    text = next((value for name, value in scope["headers"] if name == b"host"), None)
    if text is None:
        return None
    host: str = text.decode("latin-1")[:255].lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]
