"""API routes for probes: liveness, readiness, and metrics."""

import asyncio
import logging

import anyio.to_thread
from prometheus_client import CONTENT_TYPE_LATEST
from starlette.requests import Request
from starlette.responses import PlainTextResponse, Response

from service.app.factory import App
from service.errors import Busy
from service.storage.progress import WAIT_S, Lag
from service.web.openapi import ApiRouter, Returns
from service.web.requests.access import OPEN, AppDep, MetricsDep, Policy

router = ApiRouter("probes", prefix="")

TEXT = "text/plain"
READY_WAIT_S = 1.5
"""Seconds to wait for readiness; the probe must answer within two seconds."""

log = logging.getLogger(__name__)


@router.serves("GET /livez", OPEN, Returns("Alive.", media_type=TEXT))
async def livez(app: AppDep) -> Response:
    """Liveness: the process answers and works on submissions."""
    app.submissions.require_alive()
    return PlainTextResponse("alive\n")


@router.serves("GET /readyz", OPEN, Returns("Ready.", media_type=TEXT), problems=(503,))
async def readyz(request: Request, app: AppDep) -> Response:
    """Readiness: catalog loaded, database reachable, last write succeeded."""
    state = request.app.state
    if getattr(state, "getting_ready", None) is None or state.getting_ready.done():
        # A thread apart from those of handlers, which may all be busy; one for all probes:
        # while the database does not answer, threads would pile up.
        ready = anyio.to_thread.run_sync(_ready, app, limiter=anyio.CapacityLimiter(1))
        state.getting_ready = asyncio.ensure_future(ready)
        # Every waiting probe may have given up by then.
        state.getting_ready.add_done_callback(lambda done: done.cancelled() or done.exception())
    done, _ = await asyncio.wait([state.getting_ready], timeout=READY_WAIT_S)
    if not done:
        raise Busy("the service is starting, or the database does not answer", 5)
    try:
        lag: Lag = state.getting_ready.result()
    except Busy:
        raise
    except Exception as error:
        log.warning("not ready: %s", error)
        raise Busy("the service is not ready; its log says why", retry_after_s=5) from None
    behind = f"; trends and alarms are {lag.results} results, {lag.seconds:.0f} s behind the record"
    kinds = app.service.being_compiled()
    compiling = f"; kernels are being compiled for {'; '.join(kinds)}" if kinds else ""
    return PlainTextResponse(f"ready{compiling}{behind if lag.seconds > WAIT_S else ''}\n")


def _ready(app: App) -> Lag:
    """Wait until the service is ready; returns the lag of projections."""
    app.service.ready()
    return app.store.progress.lag()


@router.serves(
    "GET /metrics", Policy("read", without_database=True), Returns("The counters.", media_type=TEXT)
)
def metrics(counted: MetricsDep) -> Response:
    """Counters in the text format of Prometheus."""
    return Response(counted.text(), media_type=CONTENT_TYPE_LATEST)
