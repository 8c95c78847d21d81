"""What happens around every request: HEAD, timing, one header for all, the last resort."""

import time

from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.web.errors import our_fault
from service.web.metrics import Metrics

_NO_SNIFF = (b"x-content-type-options", b"nosniff")


class AroundRequests:
    """Times every request, answers HEAD as GET without its body, and forbids type guessing.

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
            await self.app(inner, receive, sent)
        except Exception as error:
            if status:
                raise
            await our_fault(Request(inner), error)(inner, receive, sent)
        finally:
            self.metrics.count_request(inner, status, time.perf_counter() - started)
