"""Probes: alive, ready, and the metrics."""

import asyncio
import logging

import anyio.to_thread
from fastapi import APIRouter
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from service.errors import Busy
from service.web.describe import Gives, described
from service.web.holding import Counted, Held
from service.web.queries import NO_QUERY

router = APIRouter(tags=["probes"], dependencies=[NO_QUERY])

TEXT = "text/plain"
READY_WAIT_S = 1.5
"""Whatever the database does, the answer is due within two seconds."""

log = logging.getLogger(__name__)


@router.get("/livez", **described({200: Gives("Alive.", media_type=TEXT)}))
async def livez() -> Response:
    """Whether the process answers at all."""
    return PlainTextResponse("alive\n")


@router.get("/readyz", **described({200: Gives("Ready.", media_type=TEXT)}, problems=(503,)))
async def readyz(request: Request, operations: Held) -> Response:
    """Whether batches can be taken: catalog loaded, database within reach, last write good."""
    state = request.app.state
    if getattr(state, "getting_ready", None) is None or state.getting_ready.done():
        # A thread of its own: those of the handlers may all be at work.  One for all who ask:
        # while the database does not answer there would be more and more.
        ready = anyio.to_thread.run_sync(operations.ready, limiter=anyio.CapacityLimiter(1))
        state.getting_ready = asyncio.ensure_future(ready)
        # Nobody may be left who waits for it.
        state.getting_ready.add_done_callback(lambda done: done.cancelled() or done.exception())
    done, _ = await asyncio.wait([state.getting_ready], timeout=READY_WAIT_S)
    if not done:
        raise Busy("the service is getting ready, or the database does not answer", 5)
    try:
        state.getting_ready.result()
    except Busy:
        raise
    except Exception as error:
        log.warning("not ready: %s", error)
        raise Busy("the service is not ready; its log says why", retry_after_s=5) from None
    return PlainTextResponse("ready\n")


@router.get("/metrics", **described({200: Gives("The counters.", media_type=TEXT)}))
def metrics(counted: Counted) -> Response:
    """Counters in the text form of Prometheus."""
    return Response(counted.text(), media_type=CONTENT_TYPE_LATEST)
