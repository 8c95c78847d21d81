"""Real services over databases of both kinds."""

import time

import httpx
import pytest

from service.app.factory import open_app
from service.settings import Settings
from service.storage.sql.migrations import upgrade
from service.storage.upkeep.verify import verify
from service.web.app import create_app
from tests.web.conformance import check
from tests.web.serving import Server


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def served_database(request, tmp_path_factory):
    """The URL of a database for one module."""
    if request.param == "sqlite":
        yield f"sqlite:///{tmp_path_factory.mktemp('gyro') / 'acquire.db'}"
        return
    with request.getfixturevalue("postgresql_schema")() as url:
        upgrade(url)
        yield url


@pytest.fixture(scope="module")
def client(served_database):
    """Talks to a server whose answers are held against openapi.yaml; verifies its records."""
    app = create_app(open_app(Settings(database=served_database, replay_processes=0)))
    hooks = {"response": [check]}
    with (
        Server(app) as address,
        httpx.Client(base_url=address, timeout=60, event_hooks=hooks) as client,
    ):
        while client.get("/readyz").status_code != 200:
            time.sleep(0.05)
        yield client
    assert verify(served_database) == []


@pytest.fixture
def opened(database):
    """Opens apps on the test's database; all are closed at the end."""
    held = []

    def open_one():
        held.append(open_app(Settings(database=database, replay_processes=0)))
        return held[-1]

    yield open_one
    for app in held:
        app.close()


@pytest.fixture
def app(opened):
    return opened()
