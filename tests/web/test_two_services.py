"""Of two services on one PostgreSQL database one writes; the other stands by and takes over."""

import json
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import httpx
import pytest
from sqlalchemy import create_engine, select, text

from service.app.factory import open_app
from service.storage.sql.engines import database_url
from service.storage.sql.tables import batches
from tests.scale import size
from tests.storage import samples
from tests.storage.whole import assert_whole
from tests.waiting import wait_until
from tests.web.load import Load
from tests.web.serving import in_process_settings

KILLS, TERMINATED = 100, 12
ACKNOWLEDGED_A_ROUND = 1_000

pytestmark = pytest.mark.parametrize("database", ["postgresql"], indirect=True)

HOLDS_LOCK = """
    SELECT pid FROM pg_locks
    WHERE locktype = 'advisory' AND objid = 'event_counter'::regclass AND granted
"""
NOTE_WRITERS = f"""
    CREATE TABLE writers (number serial, pid int, holds_lock boolean);
    CREATE FUNCTION note_writer() RETURNS trigger AS $$ BEGIN
        INSERT INTO writers (pid, holds_lock)
        VALUES (pg_backend_pid(), pg_backend_pid() IN ({HOLDS_LOCK}));
        RETURN NULL;
    END $$ LANGUAGE plpgsql;
    CREATE TRIGGER note_writer AFTER INSERT ON batches
    FOR EACH STATEMENT EXECUTE FUNCTION note_writer();
"""


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
        self._process = subprocess.Popen(self._command, stderr=subprocess.DEVNULL)

    def state(self):
        """`ready`, `standby`, `busy`, or `gone` where nothing answers."""
        try:
            answer = httpx.get(f"{self.url}/readyz", timeout=60)
        except httpx.TransportError:
            assert self._process.poll() is None, "the service ended by itself"
            return "gone"
        if answer.status_code == 200:
            return "ready"
        return answer.json()["type"].removeprefix("/problems/")

    def wait_for(self, *states, seconds=120.0):
        wait_until(lambda: self.state() in states, seconds, why=self.state, every_s=0.05)

    def kill(self):
        self._process.kill()
        self._process.wait()


@contextmanager
def two_services(database):
    """The one that writes, and the one that stands by."""
    with ExitStack() as stack:
        services = []
        for state in ("ready", "standby"):
            services.append(Service(database))
            stack.callback(services[-1].kill)
            # On a fresh checkout kernels are compiled first.
            services[-1].wait_for(state, seconds=900.0)
        yield services


@contextmanager
def asking(database):
    engine = create_engine(database_url(database), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        yield connection
    engine.dispose()


def test_the_second_service_answers_reads_and_refuses_writes_until_it_takes_over(
    database, sky, missions
):
    body = samples.batch(sky, missions, "first")
    with two_services(database) as (writes, stands_by):
        assert httpx.post(f"{writes.url}/api/v1/batches", content=body, headers=JSON).is_success
        of_batch = f"{stands_by.url}/api/v1/batches?spacecraft={json.loads(body)['spacecraft']}"
        assert [each["batch"] for each in httpx.get(of_batch).json()["items"]] == ["first"]
        assert "This service stands by" in httpx.get(f"{stands_by.url}/").text
        assert "This service stands by" not in httpx.get(f"{writes.url}/").text
        assert httpx.get(f"{stands_by.url}/livez").status_code == 200
        assert "starid_standby 1.0" in httpx.get(f"{stands_by.url}/metrics").text
        assert "starid_standby 0.0" in httpx.get(f"{writes.url}/metrics").text
        refused = [
            httpx.get(f"{stands_by.url}/readyz"),
            httpx.post(f"{stands_by.url}/api/v1/batches", content=body, headers=JSON),
            httpx.post(f"{stands_by.url}/api/v1/batches/many", content=f"[{body}]", headers=JSON),
            httpx.post(f"{stands_by.url}/api/v1/replays?run=r", content=body, headers=NDJSON),
            httpx.post(f"{stands_by.url}/api/v1/annotations", json={}),
        ]
        for answer in refused:
            assert answer.status_code == 503, answer.text
            assert answer.json()["type"] == "/problems/standby"
            assert answer.headers["retry-after"] == "2"
        writes.kill()
        stands_by.wait_for("ready")
        again = httpx.post(f"{stands_by.url}/api/v1/batches", content=body, headers=JSON)
        assert again.status_code == 200
        other = samples.batch(sky, missions, "second")
        new = httpx.post(f"{stands_by.url}/api/v1/batches", content=other, headers=JSON)
        assert new.status_code == 201
        writes.start()
        writes.wait_for("standby")


@pytest.mark.torture
def test_a_killed_writer_is_replaced_and_nothing_acknowledged_is_lost_or_doubled(
    database, sky, missions, rng, figures
):
    def kill(services, at_database):
        writes = next(each for each in services if each.state() == "ready")
        writes.kill()
        return writes

    def recover(writes):
        writes.start()
        writes.wait_for("standby")

    _under_load(database, sky, missions, rng, figures, size(KILLS), kill, recover)


@pytest.mark.torture
@pytest.mark.slow
def test_a_writer_that_loses_its_session_writes_nothing_until_it_has_the_lock_again(
    database, sky, missions, rng, figures
):
    def terminate(services, at_database):
        (pid,) = at_database.scalars(text(HOLDS_LOCK)).all()
        assert at_database.scalar(text(f"SELECT pg_terminate_backend({pid}, 5000)"))
        return services

    def recover(services):
        def states():
            return sorted(each.state() for each in services)

        wait_until(lambda: states() == ["ready", "standby"], 60.0, why=states, every_s=0.05)

    times = max(3, size(TERMINATED))
    _under_load(database, sky, missions, rng, figures, times, terminate, recover)


def _under_load(database, sky, missions, rng, figures, times, disturb, recover):
    """Disturb two services so many times while clients post to whichever takes their batches."""
    template = samples.batch(sky, missions, "NAME")
    assert json.loads(template)["batch"] == "NAME"
    a_round = size(ACKNOWLEDGED_A_ROUND, 50)
    took_over_s = []
    with asking(database) as at_database, two_services(database) as services:
        at_database.exec_driver_sql(NOTE_WRITERS)
        load = Load(tuple(each.port for each in services), template)
        try:
            for _ in range(times):
                _wait_for(load, a_round, seconds=120.0)
                time.sleep(float(rng.uniform(0, 0.05)))
                disturbed = disturb(services, at_database)
                begun_s = time.monotonic()
                # Answers that were under way come first.
                _wait_for(load, 20, seconds=120.0)
                took_over_s.append(time.monotonic() - begun_s)
                recover(disturbed)
            load.stop()
        finally:
            load.give_up()
        writers = at_database.exec_driver_sql("SELECT * FROM writers ORDER BY number").all()
    sessions = _sessions_in_order(writers)
    figures(
        times=times,
        acknowledged=len(load.acknowledged),
        answers=dict(load.met),
        longest_take_over_s=round(max(took_over_s), 2),
        sessions=len(sessions),
    )
    assert len(load.acknowledged) >= times * a_round
    assert all(each.holds_lock for each in writers)
    assert len(set(sessions)) == len(sessions) == times + 1
    app = open_app(in_process_settings(database))
    try:
        assert_whole(app, dict(load.acknowledged.values()))
        with app.store.reading() as connection:
            held = dict(connection.execute(select(batches.c.batch, batches.c.id)).all())
        assert held == {name: id for name, (id, _) in load.acknowledged.items()}
    finally:
        app.close()


def _wait_for(load, acknowledged, seconds):
    wanted = len(load.acknowledged) + acknowledged
    wait_until(lambda: len(load.acknowledged) >= wanted, seconds, why=lambda: dict(load.met))


def _sessions_in_order(writers):
    """The sessions that wrote, in the order of their writes; one that comes back comes twice."""
    sessions = []
    for each in writers:
        if not sessions or sessions[-1] != each.pid:
            sessions.append(each.pid)
    return sessions


JSON = {"content-type": "application/json"}
NDJSON = {"content-type": "application/x-ndjson"}
