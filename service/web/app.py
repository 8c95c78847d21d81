"""The app, put together in one place."""

import asyncio
import logging
import threading
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import anyio.to_thread
from fastapi import APIRouter, Depends, FastAPI
from fastapi.routing import APIRoute
from starlette.staticfiles import StaticFiles

from service import __version__
from service.operations import Operations
from service.web.access import guard
from service.web.bodies import DEFAULT_LIMITS, BodyBudget, Limits
from service.web.dashboard import PAGES
from service.web.errors import add_error_handlers
from service.web.live import Live
from service.web.metrics import Metrics
from service.web.middleware import AroundRequests
from service.web.reference import add_reference
from service.web.rehearsal import rehearse
from service.web.routes import (
    access,
    advice,
    alarms,
    batches,
    compare,
    events,
    frames,
    overview,
    probes,
    runs,
    spacecraft,
    zones,
)

log = logging.getLogger(__name__)

WORKER_THREADS = 64
"""Handlers run in threads, and those of concurrent repeats wait there for the first."""

ROUTERS: tuple[APIRouter, ...] = (
    batches.router,
    frames.router,
    spacecraft.router,
    advice.router,
    compare.router,
    zones.router,
    runs.router,
    overview.router,
    alarms.router,
    events.router,
    access.router,
    probes.router,
    *PAGES,
)

DIRECT = (batches.submit_batch,)
"""Handlers that are asked by the thousand a second: see `AroundRequests`."""


def create_app(operations: Operations, limits: Limits = DEFAULT_LIMITS) -> FastAPI:
    """The app over open operations, which it closes when it has served its last request."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = WORKER_THREADS
        await operations.attach()
        here = asyncio.get_running_loop()
        warming = threading.Thread(target=_warm_up, args=(app, operations, here), name="warm-up")
        warming.start()
        try:
            await app.state.live.start()
            yield
        finally:
            await app.state.live.close()
            operations.stop_warming()
            # The handlers' own threads may all be at work still.
            own = anyio.CapacityLimiter(1)
            await anyio.to_thread.run_sync(warming.join, limiter=own)
            await anyio.to_thread.run_sync(operations.close, limiter=own)

    app = bare_app()
    app.router.lifespan_context = lifespan
    app.state.operations = operations
    app.state.limits = limits
    app.state.body_budget = BodyBudget(limits)
    app.state.metrics = Metrics(operations)
    app.state.live = Live(operations)
    app.add_middleware(
        AroundRequests,
        metrics=app.state.metrics,
        access=operations.access,
        body_budget=app.state.body_budget,
        direct={
            (method, route.path): route
            for route in app.state.routes
            if isinstance(route, APIRoute) and route.endpoint in DIRECT
            for method in route.methods or ()
        },
    )
    return app


def bare_app() -> FastAPI:
    """The app without anything behind it: enough to describe it."""
    app = FastAPI(
        title="Attitude acquisition",
        version=__version__,
        # The framework's own pages load scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
        redirect_slashes=False,
        generate_unique_id_function=_operation_id,
    )
    for router in ROUTERS:
        app.include_router(router, dependencies=[Depends(guard)])
    app.state.routes = [route for router in ROUTERS for route in router.routes]
    app.mount("/static", StaticFiles(packages=[("service.web.dashboard", "static")]))
    add_error_handlers(app)
    add_reference(app)
    return app


def _warm_up(app: FastAPI, operations: Operations, loop: asyncio.AbstractEventLoop) -> None:
    try:
        operations.ready()
        asyncio.run_coroutine_threadsafe(rehearse(app), loop).result()
    except Exception as error:
        # Whoever asks /readyz is told, and the next call tries again.
        log.warning("not ready yet: %s", error)


def _operation_id(route: APIRoute) -> str:
    return route.name
