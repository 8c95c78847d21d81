"""Services that share one PostgreSQL are one: each batch is recorded once, whoever is asked."""

import json
import socket
import subprocess
import sys
import time
from contextlib import ExitStack
from itertools import cycle

import httpx
import pytest
from sqlalchemy import select

from service.app.factory import open_app
from service.settings import Settings
from service.storage.sql.tables import batches
from tests.scale import size
from tests.storage import samples
from tests.storage.whole import assert_whole
from tests.web.load import Load

KILLS = 100
ACKNOWLEDGED_A_ROUND = 2_000


def is_ready_within(seconds, url):
    give_up = time.monotonic() + seconds
    while httpx.get(f"{url}/readyz", timeout=60).status_code != 200:
        if time.monotonic() > give_up:
            return False
        time.sleep(0.1)
    return True


class Service:
    """`acquire serve` on a port that stays the same however often it is started."""

    def __init__(self, database):
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}"
        command = [sys.executable, "-m", "service.cli", "serve", "--port", str(self.port)]
        self._command = [*command, "--database", database]
        self.start()

    def start(self):
        self._process = subprocess.Popen(self._command)
        give_up = time.monotonic() + 60
        while not self._answers():
            assert self._process.poll() is None, "the service ended by itself"
            assert time.monotonic() < give_up
            time.sleep(0.05)

    def _answers(self):
        try:
            return httpx.get(f"{self.url}/livez", timeout=60).status_code == 200
        except httpx.TransportError:
            return False

    def kill(self):
        self._process.kill()
        self._process.wait()


@pytest.mark.torture
@pytest.mark.parametrize("empty_database", ["postgresql"], indirect=True)
def test_two_services_under_load_lose_and_double_nothing_while_one_or_the_other_dies(
    database, sky, missions, rng, figures
):
    """Both are sent the same names; they are killed by turns and started again."""
    kills, a_round = size(KILLS), size(ACKNOWLEDGED_A_ROUND)
    template = samples.batch(sky, missions, "NAME")
    assert json.loads(template)["batch"] == "NAME"
    with ExitStack() as stack:
        services = [Service(database) for _ in range(2)]
        for each in services:
            stack.callback(each.kill)
        loads = [Load(each.port, template) for each in services]
        try:
            for _, service in zip(range(kills), cycle(services), strict=False):
                wanted = [len(load.acknowledged) + a_round for load in loads]
                give_up = time.monotonic() + 120
                while time.monotonic() < give_up and any(
                    len(load.acknowledged) < least
                    for load, least in zip(loads, wanted, strict=True)
                ):
                    time.sleep(0.005)
                time.sleep(float(rng.uniform(0, 0.05)))
                service.kill()
                service.start()
            for load in loads:
                load.stop()
        finally:
            for load in loads:
                load.give_up()
        for each in services:
            assert is_ready_within(60.0, each.url)
    one, other = (load.acknowledged for load in loads)
    figures(
        kills=kills,
        acknowledged=[len(one), len(other)],
        by_both=len(one.keys() & other.keys()),
        answers=[dict(load.met) for load in loads],
    )
    assert min(len(one), len(other)) >= kills * a_round
    for name in one.keys() & other.keys():
        assert one[name] == other[name], name
    app = open_app(Settings(database=database))
    try:
        assert_whole(app, dict((one | other).values()))
        with app.store.reading() as connection:
            held = dict(connection.execute(select(batches.c.batch, batches.c.id)).all())
        assert held == {name: id for name, (id, _) in (one | other).items()}
    finally:
        app.close()
