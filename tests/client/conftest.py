"""A real service, a client of it, and a proxy that cuts their connections."""

import json
from itertools import count
from pathlib import Path

import pytest
from acquire_client import Client

from service.missions.mission import load_missions
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from tests.web.serving import serving_in_process

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "docs" / "example-batch.json"


@pytest.fixture
def example():
    """The batch of the documents."""
    return json.loads(EXAMPLE.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def served(chosen_database):
    with serving_in_process(chosen_database()) as service:
        yield service


@pytest.fixture
def app(served):
    return served.app


@pytest.fixture(scope="module")
def address(served):
    return served.url


@pytest.fixture
def client(address):
    with Client(address) as client:
        yield client


@pytest.fixture(scope="session")
def drawn(sky, request):
    """Batches of a pass of XTE over the real catalog, in a run of their own."""
    numbers, seed = count(1), request.config.getoption("--seed")

    def draw(batches, run=None):
        number = next(numbers)
        drawn = draw_pass(load_missions()["XTE"], sky, Pass(batches, seed + number))
        return [each.batch | {"run": run or f"run-{number}"} for each in drawn]

    return draw
