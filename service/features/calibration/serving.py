"""Calibrations that an earlier process left unfinished end as the service starts."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from anyio.to_thread import run_sync

from service.app.factory import App
from service.features.calibration.part import Calibrations
from service.settings import Settings
from service.web.requests.metrics import Metrics


def check(settings: Settings) -> None:
    """Calibrations have no settings."""


@asynccontextmanager
async def serving(app: App, metrics: Metrics) -> AsyncIterator[None]:
    """Close what was left, where no other service may be at work on it."""
    # A command may run beside the service that computes a calibration.
    if app.store.lock is None:
        await run_sync(app.part(Calibrations).interrupt)
    yield
