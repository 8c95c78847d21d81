"""Services that share one PostgreSQL are one: each batch is recorded once, whoever is asked."""

import json
import os
import signal
import time
from contextlib import ExitStack
from itertools import cycle

import httpx
import pytest
from sqlalchemy import select

from service.operations import Operations
from service.records.tables import batches
from service.settings import Settings
from tests.records import samples
from tests.records.whole import assert_whole
from tests.scale import size
from tests.web.load import Load
from tests.web.serving import served

KILLS = 100
ACKNOWLEDGED_A_ROUND = 2_000


def backend_of(process):
    """The process that computes and writes for a served one."""
    with open(f"/proc/{process.pid}/task/{process.pid}/children", encoding="ascii") as children:
        (pid,) = children.read().split()
    return int(pid)


def is_ready_within(seconds, url):
    give_up = time.monotonic() + seconds
    while httpx.get(f"{url}/readyz", timeout=60).status_code != 200:
        if time.monotonic() > give_up:
            return False
        time.sleep(0.1)
    return True


@pytest.mark.torture
@pytest.mark.parametrize("empty_database", ["postgresql"], indirect=True)
def test_two_services_under_load_lose_and_double_nothing_while_one_or_the_other_dies(
    database, sky, missions, rng, figures
):
    """Both are sent the same names; who computes and writes for one of them is killed by turns."""
    kills, a_round = size(KILLS), size(ACKNOWLEDGED_A_ROUND)
    template = samples.batch(sky, missions, "NAME")
    assert json.loads(template)["batch"] == "NAME"
    with ExitStack() as stack:
        services = [stack.enter_context(served(database)) for _ in range(2)]
        loads = [Load(httpx.URL(url).port, template) for _, url in services]
        try:
            for _, (process, _) in zip(range(kills), cycle(services), strict=False):
                wanted = [len(load.acknowledged) + a_round for load in loads]
                give_up = time.monotonic() + 120
                while time.monotonic() < give_up and any(
                    len(load.acknowledged) < least
                    for load, least in zip(loads, wanted, strict=True)
                ):
                    time.sleep(0.005)
                time.sleep(float(rng.uniform(0, 0.05)))
                os.kill(backend_of(process), signal.SIGKILL)
            for load in loads:
                load.stop()
        finally:
            for load in loads:
                load.give_up()
        # The fronts were there all the time, and are ready again soon.
        for _, url in services:
            assert is_ready_within(60.0, url)
    one, other = (load.acknowledged for load in loads)
    figures(
        kills=kills,
        acknowledged=[len(one), len(other)],
        by_both=len(one.keys() & other.keys()),
        answers=[dict(load.met) for load in loads],
    )
    assert min(len(one), len(other)) >= kills * a_round
    # Who asked while a backend was gone was told to come again, over the same connection.
    assert all("broken off" not in load.met for load in loads)
    for name in one.keys() & other.keys():
        assert one[name] == other[name], name
    operations = Operations.open(Settings(database=database))
    try:
        assert_whole(operations, dict((one | other).values()))
        with operations.store.reading() as connection:
            held = dict(connection.execute(select(batches.c.batch, batches.c.id)).all())
        assert held == {name: id for name, (id, _) in (one | other).items()}
    finally:
        operations.close()
