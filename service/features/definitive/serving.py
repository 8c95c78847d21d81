"""Live filters and daily jobs, where missions ask for them, while the service serves."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from service.app.factory import App
from service.features.definitive.part import Definitive
from service.settings import Settings
from service.web.requests.metrics import Metrics


def check(settings: Settings) -> None:
    """Live filters and jobs have no settings: missions ask for them."""


@asynccontextmanager
async def serving(app: App, metrics: Metrics) -> AsyncIterator[None]:
    """Start the threads; closing the app ends them."""
    definitive = app.part(Definitive)
    definitive.live_filter.start()
    definitive.jobs.start_schedule()
    yield
