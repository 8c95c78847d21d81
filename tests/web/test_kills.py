"""A server that is killed again and again under load keeps every batch it acknowledged, once."""

import hashlib
import http.client
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from itertools import count

import httpx
import pytest
from sqlalchemy import make_url, select

from service.operations import Operations
from service.records.tables import batches
from service.settings import Settings
from tests.records import samples
from tests.records.whole import assert_whole
from tests.scale import size

KILLS = {"sqlite": 500, "postgresql": 100}
ACKNOWLEDGED_A_ROUND = 2_000
"""At full size: a million in all on SQLite."""
CLIENTS = 8


class Load:
    """Clients that send batch after batch, and each again until it is acknowledged.

    They speak through the standard library: a client that takes as long as the server would
    leave it half of the processors.
    """

    def __init__(self, port, template, names):
        self.acknowledged = {}
        self.met, self._counting = Counter(), threading.Lock()
        self._port, self._template, self._names = port, template, names
        self._again = deque()
        self._stopping = threading.Event()
        self._faults = []
        self._threads = [threading.Thread(target=self._send) for _ in range(CLIENTS)]
        for thread in self._threads:
            thread.start()

    def stop(self):
        self._stopping.set()
        for thread in self._threads:
            thread.join()
        assert not self._faults, self._faults[0]

    def _count(self, met):
        with self._counting:
            self.met[met] += 1

    def _next(self):
        try:
            return self._again.popleft()
        except IndexError:
            return None if self._stopping.is_set() else next(self._names)

    def _send(self):
        server = http.client.HTTPConnection("127.0.0.1", self._port, timeout=30)
        while (name := self._next()) is not None:
            body = self._template.replace("NAME", name)
            headers = {"Content-Type": "application/json", "Idempotency-Key": name}
            try:
                server.request("POST", "/api/v1/batches", body, headers)
                answer = server.getresponse()
                content = answer.read()
            except (http.client.HTTPException, OSError):
                server.close()
                self._count("broken off")
                self._again.append(name)
                # More often would keep the processor from the start that is waited for.
                time.sleep(0.1)
                continue
            self._count(answer.status)
            if answer.status == 503:
                self._again.append(name)
                time.sleep(0.1)
            elif answer.status in (200, 201):
                digest = hashlib.sha256(content).hexdigest()
                self.acknowledged[name] = (json.loads(content)["id"], digest)
            else:
                self._faults.append(content)
                break
        server.close()


class Locked:
    """An iterator that several threads may draw from."""

    def __init__(self, inner):
        self._inner, self._lock = inner, threading.Lock()

    def __next__(self):
        with self._lock:
            return next(self._inner)


@pytest.mark.torture
def test_a_server_killed_under_load_loses_tears_and_doubles_nothing(
    database, sky, missions, rng, figures
):
    kills = size(KILLS[make_url(database).get_backend_name()])
    a_round = size(ACKNOWLEDGED_A_ROUND)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    url = f"http://127.0.0.1:{port}"
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    template = samples.batch(sky, missions, "NAME")
    assert json.loads(template)["batch"] == "NAME"

    def serve():
        server = subprocess.Popen(
            [*command, "--database", database], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        while True:
            assert server.poll() is None, "the server ended by itself"
            try:
                if httpx.get(f"{url}/livez").status_code == 200:
                    return server
            except httpx.TransportError:
                time.sleep(0.02)

    server = serve()
    load = Load(port, template, Locked(f"batch-{number}" for number in count()))
    try:
        for _ in range(kills):
            wanted = len(load.acknowledged) + a_round
            give_up = time.monotonic() + 120
            while len(load.acknowledged) < wanted and time.monotonic() < give_up:
                time.sleep(0.005)
            time.sleep(float(rng.uniform(0, 0.05)))
            server.send_signal(signal.SIGKILL)
            server.wait()
            server = serve()
        load.stop()
    finally:
        load._stopping.set()
        server.terminate()
        server.wait()

    figures(kills=kills, acknowledged=len(load.acknowledged), answers=dict(load.met))
    assert len(load.acknowledged) >= kills * a_round
    operations = Operations.open(Settings(database=database))
    try:
        assert_whole(operations, dict(load.acknowledged.values()))
        with operations.store.reading() as connection:
            held = dict(connection.execute(select(batches.c.batch, batches.c.id)).all())
        # Nothing is left waiting at the end: what is there is what was acknowledged, one for one.
        assert held == {name: id for name, (id, _) in load.acknowledged.items()}
    finally:
        operations.close()
