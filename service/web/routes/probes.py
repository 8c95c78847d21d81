"""Probes: alive, ready, and the metrics."""

import logging

import anyio.to_thread
from fastapi import APIRouter
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.responses import PlainTextResponse, Response

from service.errors import Busy
from service.web.describe import Gives, described
from service.web.holding import Counted, Held
from service.web.queries import NO_QUERY

router = APIRouter(tags=["probes"], dependencies=[NO_QUERY])

TEXT = "text/plain"

log = logging.getLogger(__name__)


@router.get("/livez", **described({200: Gives("Alive.", media_type=TEXT)}))
async def livez() -> Response:
    """Whether the process answers at all."""
    return PlainTextResponse("alive\n")


@router.get("/readyz", **described({200: Gives("Ready.", media_type=TEXT)}, problems=(503,)))
async def readyz(operations: Held) -> Response:
    """Whether batches can be taken: catalog loaded, database within reach."""
    try:
        # A thread of its own: those of the handlers may all be at work.
        await anyio.to_thread.run_sync(operations.ready, limiter=anyio.CapacityLimiter(1))
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
