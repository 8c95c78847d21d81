"""A real server over a real database, and real stars to send to it."""

import json
import resource
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import httpx
import pytest

from service.app.factory import App, open_app
from service.missions.mission import load_missions
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.web.app import create_app
from tests.web.conformance import check
from tests.web.serving import Server

Json = dict[str, Any]


@pytest.fixture(scope="session")
def app(chosen_database: Callable[[], str]) -> App:
    """The real operations over a new database; the server closes them."""
    return open_app(Settings(database=chosen_database()))


@pytest.fixture(scope="session")
def address(app: App) -> Iterator[str]:
    with Server(create_app(app)) as url:
        yield url


@pytest.fixture(scope="session")
def client(address: str) -> Iterator[httpx.Client]:
    """Talks to the server; every answer it gets is held against openapi.yaml."""
    hooks = {"response": [check]}
    with httpx.Client(base_url=address, timeout=60, event_hooks=hooks) as client:
        yield client


@pytest.fixture(scope="session")
def drawn(app: App) -> Callable[..., list[Json]]:
    """Batches of a pass over the real catalog."""

    def draw(spacecraft: str, batches: int, **wanted: Any) -> list[Json]:
        mission = load_missions()[spacecraft]
        wanted_pass = Pass(batches=batches, **wanted)
        return [each.batch for each in draw_pass(mission, app.sky, wanted_pass)]

    return draw


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
def full_run(client: httpx.Client, drawn: Callable[..., list[Json]]) -> str:
    """A run with 20 batches of XTE and 20 of SOHO, stretches of trouble included.

    Those of XTE by votes, which leave more stars ambiguous.
    """
    for spacecraft, options in (("XTE", {"identifier": "starid"}), ("SOHO", {})):
        for each in drawn(spacecraft, 20, seed=4):
            body = each | {"run": "full", "options": options}
            client.post("/api/v1/batches", json=body).raise_for_status()
    return "full"


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
