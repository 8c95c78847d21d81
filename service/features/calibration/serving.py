"""Start-up task that ends calibrations left unfinished by an earlier process."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from anyio.to_thread import run_sync

from service.app.factory import App
from service.features.calibration.part import Calibrations
from service.settings import Settings
from service.web.requests.metrics import Metrics


def check(settings: Settings) -> None:
    """Do nothing: calibrations have no settings to check."""


@asynccontextmanager
async def serving(app: App, metrics: Metrics) -> AsyncIterator[None]:
    """Mark leftover calibrations as interrupted at start-up, unless another service is running."""
    # A command may run beside the service that computes a calibration.
    if app.store.lock is None:
        await run_sync(app.part(Calibrations).interrupt)
    yield
