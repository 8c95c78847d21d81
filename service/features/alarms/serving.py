"""Background task that raises alarms of silent spacecraft and ends expired shelving."""

import asyncio
import logging
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from anyio import CapacityLimiter
from anyio.to_thread import run_sync

from service.app.factory import App
from service.features.alarms.part import Alarms
from service.settings import Settings
from service.web.requests.metrics import Metrics

log = logging.getLogger(__name__)

EVERY_S = 1.0


def check(settings: Settings) -> None:
    """Do nothing: alarms have no settings to check."""


@asynccontextmanager
async def serving(app: App, metrics: Metrics) -> AsyncIterator[None]:
    """Check for silent spacecraft every second, in the process that runs the projector."""
    task = asyncio.create_task(_evaluate(app))
    try:
        yield
    finally:
        task.cancel()
        # Wait for the thread: a read in progress must not find the database closed.
        await asyncio.gather(task, return_exceptions=True)


async def _evaluate(app: App) -> None:
    # All handlers may wait for a hanging database; this task must not take one of their threads.
    thread = CapacityLimiter(1)
    while True:
        await asyncio.sleep(EVERY_S)
        if not app.single_projector.is_projecting:
            continue
        try:
            await run_sync(app.part(Alarms).evaluate_by_clock, limiter=thread)
        except Exception as error:
            # The database is unavailable for a while; the next round tries again.
            log.warning("silent spacecraft could not be looked for: %s", error)
