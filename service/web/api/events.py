"""API route for live events, as a stream for a browser's EventSource."""

from collections.abc import AsyncIterator, Callable
from functools import partial
from typing import Annotated

import anyio
from fastapi import Depends
from pydantic import Field
from starlette.requests import Request
from starlette.responses import Response
from starlette.types import Receive, Scope, Send

from service.errors import BadBatch, Fault, shown_value
from service.observations.schema import RunName
from service.web.event_stream import Listener, Live
from service.web.openapi import EVENT_STREAM, LAST_EVENT_ID, ApiRouter, Returns
from service.web.requests.access import CallerDep, Policy, credentials
from service.web.requests.query_parameters import FromQuery, Query, SpacecraftFilter

router = ApiRouter("events")

SEND_S = 30.0
"""Seconds after which a client that reads nothing is disconnected; it may reconnect."""
HEADERS = {"Cache-Control": "no-store", "X-Accel-Buffering": "no"}


class EventQuery(Query):
    """Query that selects events by run and spacecraft, and the last one received."""

    run: Annotated[RunName | None, Field(description="Only events of this run.")] = None
    spacecraft: SpacecraftFilter = None
    last_event_id: Annotated[
        int | None,
        Field(
            ge=0, lt=1 << 63, description="Like the header `Last-Event-ID`, which takes precedence."
        ),
    ] = None


class EventStream(Response):
    """HTTP response that lasts until the client leaves, the events end, or nothing is read."""

    def __init__(self, lines: AsyncIterator[bytes], leave: Callable[[], object]) -> None:
        super().__init__(None, 200, HEADERS, EVENT_STREAM)
        del self.headers["content-length"]
        self._lines = lines
        self._leave = leave

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send lines of the event stream as they are produced."""
        async with anyio.create_task_group() as group:

            async def leave() -> None:
                while (await receive())["type"] != "http.disconnect":
                    pass
                group.cancel_scope.cancel()

            group.start_soon(leave)
            try:
                await self._send(send)
            finally:
                # Leave also if no line was ever sent: the `finally` of the lines would not run.
                self._leave()
                with anyio.CancelScope(shield=True):
                    await self._lines.aclose()  # type: ignore[attr-defined]
            group.cancel_scope.cancel()

    async def _send(self, send: Send) -> None:
        start = {"type": "http.response.start", "status": 200, "headers": self.raw_headers}
        await send(start)
        async for piece in self._lines:
            with anyio.move_on_after(SEND_S) as waiting:
                await send({"type": "http.response.body", "body": piece, "more_body": True})
            if waiting.cancelled_caught:
                return
        await send({"type": "http.response.body", "body": b"", "more_body": False})


async def _live(request: Request) -> Live:
    live = request.app.state.live
    assert isinstance(live, Live)
    return live


@router.serves(
    "GET /events",
    Policy("read", "query"),
    Returns("The stream of events.", None, media_type=EVENT_STREAM),
    problems=(503,),
    parameters=(LAST_EVENT_ID,),
)
async def events(
    request: Request,
    query: FromQuery[EventQuery],
    live: Annotated[Live, Depends(_live)],
    caller: CallerDep,
) -> Response:
    """A stream of server-sent events: batches, alarms, limits, annotations, replays."""
    last = _last_event_id(request, query)
    listener = Listener(caller, *credentials(request))
    lines = await live.stream(listener, last, query.run, query.spacecraft)
    return EventStream(lines, partial(live.leave, listener))


def _last_event_id(request: Request, query: EventQuery) -> int | None:
    text = request.headers.get("last-event-id")
    if not text:
        return query.last_event_id
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise BadBatch(Fault("Last-Event-ID", "is not the number of an event", shown_value(text)))
    return int(text)
