"""Events are delivered to webhooks while the service serves."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from service.app.factory import App
from service.features.webhooks.part import Webhooks
from service.settings import Settings
from service.web.requests.metrics import Metrics


def check(settings: Settings) -> None:
    """Every setting of webhooks was checked where it was read."""


@asynccontextmanager
async def serving(app: App, metrics: Metrics) -> AsyncIterator[None]:
    """Start the sender; the app stops it when it closes."""
    app.part(Webhooks).sender.start()
    yield
