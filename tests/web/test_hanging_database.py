"""While the database hangs every request is answered in time, and nothing is lost or doubled."""

import json
import os
import socket
import sqlite3
import threading
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import httpx
import pytest
from sqlalchemy import create_engine, make_url, select, text

from service.app.factory import open_app
from service.storage.sql.engines import database_url
from service.storage.sql.tables import batches, idempotency_keys
from tests import scale
from tests.storage import samples
from tests.storage.whole import assert_whole
from tests.waiting import wait_until
from tests.web.serving import in_process_settings, served

PATIENCE_S = 60.0
"""Far beyond the time-outs of the service, even on a machine that has other work."""
POSTERS, READERS, PAUSE_S = 8, 4, 0.1
MORE_MB = 50
PROBES = ("/livez", "/readyz", "/metrics")
TABLES = ("batches", "results")
"""What is looked up first, and what is written last."""
UNTOUCHED = ("/api/v1/spacecraft/XTE/limits", "/api/v1/zones", "/api/v1/session")
"""What needs none of the tables that are locked."""

pytestmark = pytest.mark.torture


def hold_s():
    """How long the database hangs: 30 s at full size, else long enough for every time-out."""
    return 30.0 if scale.at_full_size() else 6.0


class Clients:
    """Clients that post and read until they are stopped, and what they were told."""

    def __init__(self, url, template, paths):
        self.url, self.template, self.paths = url, template, paths
        self.answers = []
        self.sent = {}
        self.acknowledged = {}
        self._over = threading.Event()
        self._numbers = iter(range(10**9))
        self._threads = [threading.Thread(target=self._post) for _ in range(POSTERS)]
        self._threads += [threading.Thread(target=self._read) for _ in range(READERS)]

    def __enter__(self):
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *_):
        self._over.set()
        for thread in self._threads:
            thread.join()

    def post(self, client, name):
        """Send a batch under its name, which is its key as well."""
        body = self.template.replace("NAME", name)
        answer = client.post(
            "/api/v1/batches",
            content=body,
            headers={"Content-Type": "application/json", "Idempotency-Key": name},
        )
        self.answers.append(("post", answer))
        if answer.status_code in (200, 201):
            self.acknowledged[name] = answer.json()["id"]
        return answer

    def _post(self):
        with httpx.Client(base_url=self.url, timeout=PATIENCE_S, verify=False) as client:
            while not self._over.is_set():
                name = f"b{next(self._numbers)}-{threading.get_ident()}"
                self.sent[name] = self.post(client, name).status_code
                time.sleep(PAUSE_S)

    def _read(self):
        with httpx.Client(base_url=self.url, timeout=PATIENCE_S, verify=False) as client:
            while not self._over.is_set():
                for path in self.paths:
                    self.answers.append((path, client.get(path)))

    def come_again(self):
        """Send what was not acknowledged until it is."""
        with httpx.Client(base_url=self.url, timeout=PATIENCE_S, verify=False) as client:
            give_up = time.monotonic() + 60
            for name in self.sent:
                while name not in self.acknowledged:
                    assert time.monotonic() < give_up, "writing did not resume"
                    if self.post(client, name).status_code == 503:
                        time.sleep(0.2)


def probed(url, paths, seconds, pause_s=0.05):
    """Ask for each path again and again while the database hangs; what came, by path.

    For `seconds`, and on a busy machine until the service has noticed.
    """
    told = {path: [] for path in paths}
    until = time.monotonic() + seconds
    give_up = until + PATIENCE_S
    with httpx.Client(base_url=url, timeout=PATIENCE_S, verify=False) as client:
        while (now := time.monotonic()) < until or (
            told["/readyz"][-1].status_code != 503 and now < give_up
        ):
            for path in paths:
                told[path].append(client.get(path))
            time.sleep(pause_s)
    return told


def descendants(pid):
    found = [pid]
    for task in Path(f"/proc/{pid}/task").iterdir():
        for child in (task / "children").read_text().split():
            found += descendants(int(child))
    return found


def resident_mb(pid):
    pages = 0
    for each in descendants(pid):
        with suppress(FileNotFoundError):
            pages += int(Path(f"/proc/{each}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


@contextmanager
def locked(database, table):
    """The table, so that nobody else can read or write it."""
    engine = create_engine(database_url(database))
    with engine.connect() as connection, connection.begin():
        connection.execute(text(f"LOCK TABLE {table} IN ACCESS EXCLUSIVE MODE"))
        yield
    engine.dispose()


class Proxy:
    """Stands between a service and its database, and can stop passing anything on."""

    def __init__(self, host, port):
        self._target = host, port
        self._flows = threading.Event()
        self._flows.set()
        self._over = False
        self._ends, self._threads = [], []
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._start(self._accept)

    def _start(self, target, *ends):
        self._threads.append(threading.Thread(target=target, args=ends, daemon=True))
        self._threads[-1].start()

    def stall(self):
        self._flows.clear()

    def resume(self):
        self._flows.set()

    def close(self):
        self._over = True
        self._flows.set()
        for end in (self._server, *self._ends):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join()
        for end in (self._server, *self._ends):
            end.close()

    def _accept(self):
        while not self._over:
            with suppress(OSError):
                here, _ = self._server.accept()
                self._ends.append(here)
                # A connection that nobody greets.
                self._flows.wait()
                there = socket.create_connection(self._target)
                self._ends.append(there)
                self._start(self._pass_on, here, there)
                self._start(self._pass_on, there, here)

    def _pass_on(self, source, target):
        with suppress(OSError):
            while data := source.recv(65536):
                self._flows.wait()
                target.sendall(data)
        with suppress(OSError):
            target.shutdown(socket.SHUT_WR)


@pytest.fixture
def template(sky, missions):
    return samples.batch(sky, missions, "NAME")


def ready_again(url):
    ready = f"{url}/readyz"
    wait_until(lambda: httpx.get(ready, timeout=PATIENCE_S).status_code == 200, PATIENCE_S)


def assert_answered(clients, probes):
    """Every request has an answer, each refusal the time to come again.

    The probes were answered while the database was hanging: it went on after the last one.
    """
    posts = {answer.status_code for kind, answer in clients.answers if kind == "post"}
    assert posts <= {200, 201, 503}
    for kind, answer in clients.answers:
        if answer.status_code == 503:
            assert int(answer.headers["Retry-After"]) >= 1, kind
        assert answer.status_code < 500 or answer.status_code == 503, kind
    assert {answer.status_code for answer in probes["/livez"]} == {200}
    assert all(probes[path] for path in PROBES)


def assert_each_recorded_once(database, clients):
    app = open_app(in_process_settings(database))
    try:
        with app.store.reading() as connection:
            held = dict(connection.execute(select(batches.c.batch, batches.c.id)).all())
            keys = Counter(connection.scalars(select(idempotency_keys.c.key)))
        assert held == clients.acknowledged
        assert keys == dict.fromkeys(clients.sent, 1)
        assert_whole(app, {})
    finally:
        app.close()


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
@pytest.mark.slow
def test_a_locked_table_delays_nobody_for_long(database, template, figures):
    refused = 0
    with served(database) as (process, url):
        httpx.get(f"{url}/api/v1/batches", timeout=60).raise_for_status()
        before_mb = resident_mb(process.pid)
        with Clients(url, template, ["/api/v1/batches?limit=5"]) as clients:
            for table in TABLES if scale.is_full() else TABLES[:1]:
                with locked(database, table):
                    probes = probed(url, (*PROBES, *UNTOUCHED), hold_s())
                assert_answered(clients, probes)
                codes = [answer.status_code for answer in probes["/readyz"]]
                assert 503 in codes, table
                # Once it was noticed, it is not ready as long as the table is locked.
                assert codes[codes.index(503) :] == [503] * (len(codes) - codes.index(503)), table
                ready_again(url)
                for path in UNTOUCHED:
                    assert {answer.status_code for answer in probes[path]} == {200}, path
            refused = sum(status == 503 for status in clients.sent.values())
            more_mb = resident_mb(process.pid) - before_mb
        clients.come_again()
        metrics = httpx.get(f"{url}/metrics").text
        assert "starid_last_write_succeeded 1.0" in metrics
        assert 'starid_queue_depth{queue="posts"} 0.0' in metrics
    figures(sent=len(clients.sent), refused=refused, more_mb=round(more_mb))
    assert refused > 0
    assert more_mb < MORE_MB
    assert_each_recorded_once(database, clients)


@pytest.mark.slow
@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_a_server_that_does_not_answer_delays_nobody_for_long(database, template, figures):
    """Whatever was on its way arrives in the end, and was given up by then."""
    there = make_url(database)
    proxy = Proxy(there.host, there.port or 5432)
    url = there.set(host="127.0.0.1", port=proxy.port)
    try:
        with served(url.render_as_string(hide_password=False)) as (_, url):
            with Clients(url, template, ["/api/v1/batches?limit=5"]) as clients:
                time.sleep(1.0)
                proxy.stall()
                probes = probed(url, PROBES, hold_s())
                proxy.resume()
                time.sleep(1.0)
            assert_answered(clients, probes)
            assert probes["/readyz"][-1].status_code == 503
            refused = sum(status == 503 for status in clients.sent.values())
            clients.come_again()
            ready_again(url)
    finally:
        proxy.close()
    figures(sent=len(clients.sent), refused=refused)
    assert refused > 0
    assert_each_recorded_once(database, clients)


@pytest.mark.parametrize("database", ["sqlite"], indirect=True)
def test_a_file_that_another_process_writes_to_for_long_delays_nobody_for_long(
    database, template, figures
):
    with served(database) as (_, url):
        with Clients(url, template, ["/api/v1/batches?limit=5"]) as clients:
            other = sqlite3.connect(make_url(database).database, isolation_level=None)
            other.execute("BEGIN IMMEDIATE")
            probes = probed(url, (*PROBES, *UNTOUCHED), hold_s())
            other.execute("ROLLBACK")
            other.close()
        assert_answered(clients, probes)
        assert probes["/readyz"][-1].status_code == 503
        for path in UNTOUCHED:
            assert {answer.status_code for answer in probes[path]} == {200}, path
        refused = sum(status == 503 for status in clients.sent.values())
        clients.come_again()
        ready_again(url)
    figures(sent=len(clients.sent), refused=refused)
    assert refused > 0
    assert_each_recorded_once(database, clients)


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
@pytest.mark.slow
def test_tokens_out_of_reach_are_told_of_at_once(database, template):
    """Nobody can be known then: everything but the open routes says so, in time."""
    with served(database) as (_, url), locked(database, "access_tokens"):
        time.sleep(1.1)
        with ThreadPoolExecutor(32) as threads:
            asked = threads.map(
                lambda _: httpx.get(f"{url}/api/v1/zones", timeout=PATIENCE_S), range(64)
            )
            answers = list(asked)
        assert {answer.status_code for answer in answers} == {503}
        assert json.loads(answers[0].content)["type"] == "/problems/busy"
        # Each of them has an answer before the table is free again.
        for path in PROBES:
            httpx.get(f"{url}{path}", timeout=PATIENCE_S)
