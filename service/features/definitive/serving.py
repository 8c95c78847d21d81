"""Start of live filters and daily jobs, for missions that configure them."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from service.app.factory import App
from service.features.definitive.part import Definitive
from service.settings import Settings
from service.web.requests.metrics import Metrics


def check(settings: Settings) -> None:
    """Accept any settings of the service: missions configure live filters and jobs."""


@asynccontextmanager
async def serving(app: App, metrics: Metrics) -> AsyncIterator[None]:
    """Start the threads of live filters and daily jobs; closing the app stops them."""
    definitive = app.part(Definitive)
    definitive.live_filter.start()
    definitive.jobs.start_schedule()
    yield
