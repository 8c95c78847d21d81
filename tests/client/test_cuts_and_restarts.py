"""Events are followed through cut connections and killed services: none is lost, none doubled."""

import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from acquire_client import Client
from sqlalchemy import select

from service.app.factory import open_app
from service.storage.sql.tables import batches
from service.storage.sql.tables import events as recorded_events
from tests.client.cutting_proxy import CuttingProxy
from tests.scale import size
from tests.waiting import wait_until
from tests.web.serving import in_process_settings, is_ready

CUTS, RESTARTS, EVENTS = 50, 10, 10_000
PATIENCE_S = 300.0
"""A start loads kernels, on a machine with other work to do."""


class Service:
    """`acquire serve` on one port, which can be killed and started again."""

    def __init__(self, database):
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self._command = [sys.executable, "-m", "service.cli", "serve", "--port", str(self.port)]
        self._command += ["--database", database]
        self.start()

    def start(self):
        self._process = subprocess.Popen(
            self._command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        url = f"http://127.0.0.1:{self.port}"
        wait_until(lambda: is_ready(self._process, url), PATIENCE_S, every_s=0.05)

    def end(self, number):
        self._process.send_signal(number)
        self._process.wait()


class Follower:
    """Follows events in a thread and keeps them."""

    def __init__(self, url):
        self.events, self.error = [], None
        self._client = Client(url, give_up_after_s=PATIENCE_S)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._follow)
        self._thread.start()

    def _follow(self):
        try:
            with self._client:
                for event in self._client.events(after=0):
                    self.events.append(event)
                    if self._stop.is_set() and event.kind == "annotation":
                        return
        except Exception as error:
            self.error = error

    def finish(self):
        """Stop at the annotation that comes next."""
        self._stop.set()

    def join(self):
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()


@pytest.mark.slow
@pytest.mark.torture
def test_a_stream_that_is_cut_and_a_service_that_is_killed_lose_and_double_nothing(
    database, example, rng, figures
):
    """Batches go through the same cuts, and each is recorded and told once."""
    cuts, restarts, wanted = size(CUTS, 2), size(RESTARTS), size(EVENTS, 30)
    service = Service(database)
    at = rng.choice(wanted, cuts + restarts, replace=False)
    is_cut = rng.permutation([True] * cuts + [False] * restarts)
    plan = dict(zip(at.tolist(), is_cut.tolist(), strict=True))
    troubles = ThreadPoolExecutor(1)

    def trouble(cut, wait_s, number):
        time.sleep(wait_s)
        if cut:
            assert proxy.cut() > 0
        else:
            service.end(number)
            service.start()

    try:
        with (
            CuttingProxy(service.port) as proxy,
            Client(proxy.url, give_up_after_s=PATIENCE_S) as client,
        ):
            follower = Follower(proxy.url)
            met = []
            for sent in range(wanted):
                if sent in plan:
                    number = signal.SIGKILL if rng.random() < 0.5 else signal.SIGTERM
                    wait_s = float(rng.uniform(0, 0.1))
                    met.append(troubles.submit(trouble, plan[sent], wait_s, number))
                client.submit(example | {"batch": f"b-{sent}"})
            for each in met:
                each.result()
            follower.finish()
            note = {"text": "the last", "start": example["time"], "who": "a test"}
            client.request("POST", "/api/v1/annotations", body=note)
            follower.join()
    finally:
        service.end(signal.SIGTERM)

    assert follower.error is None
    figures(cuts=cuts, restarts=restarts, events=len(follower.events), batches=wanted)
    app = open_app(in_process_settings(database))
    try:
        with app.store.reading() as connection:
            rows = connection.execute(select(recorded_events).order_by(recorded_events.c.id))
            recorded = [(row.id, row.kind) for row in rows]
            held = connection.execute(select(batches.c.batch)).scalars().all()
    finally:
        app.close()
    assert [(each.id, each.kind) for each in follower.events] == recorded
    told = [event.data for event in follower.events if event.kind == "batches"]
    assert sum(each.batches for each in told) == wanted
    # One event may stand for several batches, where the projector came late.
    latest = [int(each.latest.batch.removeprefix("b-")) for each in told]
    assert latest == (np.cumsum([each.batches for each in told]) - 1).tolist()
    assert sorted(held) == sorted(f"b-{n}" for n in range(wanted))
