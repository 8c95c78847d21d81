"""What happens around every request: whom it is for, HEAD, timing, the last resort."""

import logging
import time
from collections.abc import Mapping

from anyio import CapacityLimiter
from anyio.to_thread import run_sync
from fastapi.routing import APIRoute
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.errors import Busy
from service.records.access import Access
from service.settings import is_loopback
from service.web.access import entry_of, guard, is_open
from service.web.errors import Kind, answer_to, our_fault, problem
from service.web.metrics import Metrics
from service.web.rehearsal import REHEARSAL

NOT_HERE = Kind(421, "This is another host's", "not-this-host")

log = logging.getLogger(__name__)

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
        direct: Mapping[tuple[str, str], APIRoute],
    ) -> None:
        """`direct` routes stand under method and path; their handlers take the request alone."""
        self.app = app
        self.metrics = metrics
        self.access = access
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
                message = {**message, "headers": [*message["headers"], _NO_SNIFF]}
            elif is_head:
                message = {**message, "body": b""}
            await send(message)

        # A scope of its own: the server still sees HEAD and frames the answer accordingly.
        inner = {**scope, "method": "GET"} if is_head else scope
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
            if REHEARSAL not in inner:
                self.metrics.count_request(inner, status, time.perf_counter() - started)

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


async def _answered(route: APIRoute, request: Request) -> Response:
    """What a direct route answers, guarded as every route is."""
    try:
        await guard(request)
        response: Response = await route.endpoint(request)
    except Exception as error:
        return await answer_to(request, error)
    return response


def _host(scope: Scope) -> str | None:
    """The name that a request is for, without its port; None where it names none."""
    text = next((value for name, value in scope["headers"] if name == b"host"), None)
    if text is None:
        return None
    host: str = text.decode("latin-1")[:255].lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]
