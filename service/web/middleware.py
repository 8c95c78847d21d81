"""What happens around every request: whom it is for, HEAD, timing, the last resort."""

import time

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.settings import is_loopback
from service.web.errors import Kind, our_fault, problem
from service.web.metrics import Metrics

NOT_HERE = Kind(421, "This is another host's", "not-this-host")

_NO_SNIFF = (b"x-content-type-options", b"nosniff")


class AroundRequests:
    """Times every request, answers HEAD as GET without its body, and forbids type guessing.

    A request for a host of another name is refused: a page elsewhere could let
    its own name lead to this machine, and would then be let in as this one.

    An error that nothing below has answered is answered here; let through, it
    would cost the client its connection.
    """

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app = app
        self.metrics = metrics

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
                message = {**message, "headers": [*message["headers"], _NO_SNIFF]}
            elif is_head:
                message = {**message, "body": b""}
            await send(message)

        # A scope of its own: the server still sees HEAD and frames the answer accordingly.
        inner = {**scope, "method": "GET"} if is_head else scope
        try:
            host = _host(inner)
            if host is not None and not is_loopback(host):
                told = {"detail": f"the service answers to names of this machine, not to {host!r}"}
                await problem(Request(inner), NOT_HERE, told)(inner, receive, sent)
                return
            await self.app(inner, receive, sent)
        except Exception as error:
            if status:
                raise
            await our_fault(Request(inner), error)(inner, receive, sent)
        finally:
            self.metrics.count_request(inner, status, time.perf_counter() - started)


def _host(scope: Scope) -> str | None:
    """The name that a request is for, without its port; None where it names none."""
    text = next((value for name, value in scope["headers"] if name == b"host"), None)
    if text is None:
        return None
    host: str = text.decode("latin-1")[:255].lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.partition(":")[0]
