"""Assembly of the web application: routes, middleware, lifespan, error handlers."""

import asyncio
import json
import logging
import os
import socket
import threading
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack, asynccontextmanager

import anyio
import anyio.to_thread
import yaml
from fastapi import APIRouter, Depends, FastAPI
from fastapi.routing import APIRoute
from starlette.exceptions import HTTPException
from starlette.middleware.gzip import DEFAULT_EXCLUDED_CONTENT_TYPES, GZipMiddleware
from starlette.staticfiles import StaticFiles

from service import __version__
from service.app.factory import App
from service.errors import AcquisitionError
from service.feature import feature_folders, feature_modules
from service.table_files.formats import TABLE_FORMATS
from service.web.api import (
    annotations,
    batches,
    events,
    probes,
    runs,
    spacecraft,
    tokens,
    zones,
)
from service.web.console import console_router
from service.web.console.page import page_or_problem
from service.web.event_stream import Live
from service.web.middleware import AroundRequests, BelowPath, ConditionalAnswers, warm_request
from service.web.openapi import add_reference
from service.web.requests.access import authorize
from service.web.requests.exports import Exports
from service.web.requests.metrics import Metrics
from service.web.requests.problems import add_error_handlers
from service.web.requests.request_body import DEFAULT_LIMITS, BodyBudget, BodyLimits

log = logging.getLogger(__name__)

WORKER_THREADS = 64
"""Number of threads for request handlers; handlers of repeated posts wait in them."""

ROUTERS: tuple[APIRouter, ...] = (
    batches.router,
    spacecraft.router,
    batches.gyro_router,
    batches.compare_router,
    zones.router,
    runs.router,
    spacecraft.overview_router,
    annotations.router,
    events.router,
    tokens.router,
    probes.router,
)

COMPRESS_LEVEL = 4
"""gzip compression level: a third of the default's time, for 7 % more bytes of a list."""

COMPRESSED = (*DEFAULT_EXCLUDED_CONTENT_TYPES, TABLE_FORMATS["parquet"].media_type)
"""Media types that are sent uncompressed: compressed formats and event streams."""

DIRECT = (batches.submit_batch,)
"""Handlers that skip routing, for thousands of requests a second: see `AroundRequests`."""


def create_app(app: App, limits: BodyLimits = DEFAULT_LIMITS) -> FastAPI:
    """Create the web application of an open `App`, which is closed after the last request."""

    @asynccontextmanager
    async def lifespan(web_app: FastAPI) -> AsyncIterator[None]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = WORKER_THREADS
        loop = asyncio.get_running_loop()
        warming = threading.Thread(target=_warm_up, args=(web_app, app, loop), name="warm-up")
        warming.start()
        reporting = asyncio.create_task(report_to_supervisor(app))
        try:
            await web_app.state.live.start()
            async with AsyncExitStack() as running:
                for module in feature_modules("serving", app.settings.features_off):
                    own = module.serving(app, web_app.state.metrics)
                    await running.enter_async_context(own)
                yield
        finally:
            reporting.cancel()
            notify_supervisor("STOPPING=1")
            await web_app.state.live.close()
            app.service.cancel_warmup()
            # All threads of the handlers may still be busy.
            own = anyio.CapacityLimiter(1)
            await anyio.to_thread.run_sync(warming.join, limiter=own)
            await anyio.to_thread.run_sync(app.close, limiter=own)
            web_app.state.metrics.close()

    web_app = bare_app(app.settings.features_off)
    web_app.router.lifespan_context = lifespan
    web_app.state.app = app
    web_app.state.limits = limits
    web_app.state.body_budget = BodyBudget(limits)
    web_app.state.metrics = Metrics(app)
    web_app.state.live = Live(app)
    # Added last, so outermost: the direct routes skip the two below.
    web_app.add_middleware(ConditionalAnswers)
    web_app.add_middleware(
        GZipMiddleware,
        minimum_size=1_000,
        compresslevel=COMPRESS_LEVEL,
        exclude_content_types=COMPRESSED,
    )
    web_app.state.exports = Exports()
    web_app.add_middleware(
        AroundRequests,
        metrics=web_app.state.metrics,
        access=app.access,
        body_budget=web_app.state.body_budget,
        direct={
            (method, route.path): route
            for route in web_app.state.routes
            if isinstance(route, APIRoute) and route.endpoint in DIRECT
            for method in route.methods or ()
        },
    )
    web_app.state.root_path = app.settings.root_path
    if app.settings.root_path:
        web_app.add_middleware(BelowPath, root_path=app.settings.root_path)
    return web_app


def bare_app(features_off: str = "") -> FastAPI:
    """Web application without a service behind it, sufficient for its OpenAPI description."""
    feature_modules("pages", features_off)
    features = feature_modules("routes", features_off)
    of_features = [router for each in features for router in each.ROUTERS]
    web_app = FastAPI(
        title="Attitude acquisition",
        version=__version__,
        # The framework's own pages load scripts from elsewhere.
        docs_url=None,
        redoc_url=None,
        openapi_url="/api/v1/openapi.json",
        redirect_slashes=False,
        generate_unique_id_function=_operation_id,
    )
    routers = (*ROUTERS, *of_features, console_router())
    for router in routers:
        web_app.include_router(router, dependencies=[Depends(authorize)])
    web_app.state.routers = routers
    web_app.state.routes = [route for router in routers for route in router.routes]
    static = ("service.web.console", *feature_folders("static"))
    web_app.mount("/static", StaticFiles(packages=[(each, "static") for each in static]))
    add_error_handlers(web_app)
    web_app.add_exception_handler(HTTPException, page_or_problem)
    add_reference(web_app)
    return web_app


def _warm_up(web_app: FastAPI, app: App, loop: asyncio.AbstractEventLoop) -> None:
    try:
        app.service.ready()
        asyncio.run_coroutine_threadsafe(warm_request(web_app), loop).result()
    except Exception as error:
        # /readyz reports the error, and the next call of it tries again.
        log.warning("not ready yet: %s", error)


def _operation_id(route: APIRoute) -> str:
    return route.name


async def report_to_supervisor(app: App) -> None:
    """Report readiness to systemd, and then liveness as often as the watchdog requires.

    Runs until cancelled.  A blocked event loop or writer thread stops the reports: systemd then
    restarts the service (`WatchdogSec`).
    """
    if "NOTIFY_SOCKET" not in os.environ:
        return
    # All threads of the handlers may be busy.
    own = anyio.CapacityLimiter(1)
    while not await anyio.to_thread.run_sync(_is_ready, app, limiter=own):
        await asyncio.sleep(1.0)
    notify_supervisor("READY=1\nSTATUS=ready")
    every_s = int(os.environ.get("WATCHDOG_USEC", "0")) / 2e6
    while every_s > 0.0:
        try:
            app.submissions.require_alive()
        except AcquisitionError as error:
            log.error("no sign of life to systemd: %s", error)
        else:
            notify_supervisor("WATCHDOG=1")
        await asyncio.sleep(every_s)


def notify_supervisor(message: str) -> None:
    """Send lines such as `READY=1` to the supervisor's socket, if the environment names one."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    # A name that begins with @ is not in the file system.
    path = "\0" + address[1:] if address.startswith("@") else address
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
            # A supervisor that reads nothing must not hold up the event loop.
            sender.setblocking(False)
            sender.connect(path)
            sender.sendall(message.encode())
    except OSError as error:
        log.warning("systemd is not told %r: %s", message, error)


def _is_ready(app: App) -> bool:
    try:
        app.service.ready()
    except Exception:  # the warm-up logs why, and the next call tries again
        return False
    return True


class _Dumper(yaml.SafeDumper):
    """YAML writer that keeps multi-line texts as literal blocks."""


def _text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    style = "|" if "\n" in text else None
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


_Dumper.add_representer(str, _text)


def openapi_yaml() -> str:
    """Text of `openapi.yaml`, made without a running service."""
    # Convert by JSON, since YAML would mark objects that are shared between places.
    plain = json.loads(json.dumps(bare_app().openapi()))
    return str(yaml.dump(plain, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=100))
