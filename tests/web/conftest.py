"""A real server over a real database, and real stars to send to it."""

import json
import resource
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.app.factory import App
from tests.web.conformance import checked
from tests.web.serving import InProcess

Json = dict[str, Any]


@pytest.fixture(scope="session")
def app(shared_service: InProcess) -> App:
    """The real operations behind the shared server."""
    return shared_service.app


@pytest.fixture(scope="session")
def address(shared_service: InProcess) -> str:
    return shared_service.url


@pytest.fixture(scope="session")
def client(shared_service: InProcess) -> httpx.Client:
    """Talks to the server; every answer it gets is held against openapi.yaml."""
    return checked(shared_service.client)


@pytest.fixture(scope="session")
def drawn(shared_service: InProcess) -> Callable[..., list[Json]]:
    """Batches of a pass over the real catalog."""
    return shared_service.draw


_numbers = count(1)


@pytest.fixture
def batch(drawn: Callable[..., list[Json]]) -> Json:
    """A batch of XTE with five real stars, under an id of its own."""
    return drawn("XTE", 1)[0] | {"batch": f"one-{next(_numbers)}"}


@pytest.fixture
def run() -> str:
    """The name of a run that nothing else writes to."""
    return f"run-{next(_numbers)}"


@pytest.fixture(scope="session")
def full_run(shared_service: InProcess, client: httpx.Client) -> str:
    """A run with 20 batches of XTE and 20 of SOHO, stretches of trouble included."""
    return shared_service.send_full_run()


@pytest.fixture
def post(client: httpx.Client) -> Callable[..., httpx.Response]:
    """Send a batch as the JSON it would be sent as."""

    def send(body: Json | bytes, **headers: str) -> httpx.Response:
        content = body if isinstance(body, bytes) else json.dumps(body).encode()
        headers = {"Content-Type": "application/json"} | {
            name.replace("_", "-"): value for name, value in headers.items()
        }
        return client.post("/api/v1/batches", content=content, headers=headers)

    return send


@pytest.fixture
def resident_mb() -> Callable[[], float]:
    """How much memory this process, and with it the server, holds."""

    def measure() -> float:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize() / 1e6

    return measure
