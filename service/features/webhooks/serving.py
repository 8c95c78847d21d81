"""Start of webhook deliveries with the service."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from service.app.factory import App
from service.features.webhooks.part import Webhooks
from service.settings import Settings
from service.web.requests.metrics import Metrics


def check(settings: Settings) -> None:
    """Do nothing: settings of webhooks are checked when they are read."""


@asynccontextmanager
async def serving(app: App, metrics: Metrics) -> AsyncIterator[None]:
    """Start the sender of webhooks; the app stops it on closing."""
    app.part(Webhooks).sender.start()
    yield
