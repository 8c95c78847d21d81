"""Two services on one PostgreSQL database record; one projects, and the other takes over."""

import json
import signal
import socket
import subprocess
import sys
import time
import uuid
from contextlib import ExitStack, contextmanager
from pathlib import Path

import httpx
import pytest
from sqlalchemy import create_engine, make_url, select, text

from service.app.factory import open_app
from service.storage.sql.engines import database_url
from service.storage.sql.tables import batches
from tests.scale import size
from tests.storage import samples
from tests.storage.recount import assert_equal_to_a_recount
from tests.storage.whole import assert_whole
from tests.waiting import wait_until
from tests.web.load import Load
from tests.web.serving import free_port, in_process_settings
from tests.web.test_behind_proxy import NGINX

KILLS, TERMINATED = 100, 12
ACKNOWLEDGED_A_ROUND = 1_000
BALANCER = Path(__file__).parents[2] / "docker" / "balanced" / "nginx.conf"
BUSY_S = 2.0
"""By so much a look at a service takes longer while other tests run."""

pytestmark = pytest.mark.parametrize("database", ["postgresql"], indirect=True)

HOLDS_LOCK = """
    SELECT pid FROM pg_locks
    WHERE locktype = 'advisory' AND objid = 'event_counter'::regclass AND granted
"""
SESSIONS = """
    SELECT pid FROM pg_stat_activity
    WHERE application_name = current_setting('application_name') AND pid != pg_backend_pid()
"""
NOTE_PROJECTORS = f"""
    CREATE TABLE projectors (number serial, pid int, holds_lock boolean);
    CREATE FUNCTION note_projector() RETURNS trigger AS $$ BEGIN
        INSERT INTO projectors (pid, holds_lock)
        VALUES (pg_backend_pid(), pg_backend_pid() IN ({HOLDS_LOCK}));
        RETURN NULL;
    END $$ LANGUAGE plpgsql;
    CREATE TRIGGER note_projector AFTER UPDATE ON projector
    FOR EACH STATEMENT EXECUTE FUNCTION note_projector();
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

    def is_ready(self):
        try:
            return httpx.get(f"{self.url}/readyz", timeout=60).status_code == 200
        except httpx.TransportError:
            assert self._process.poll() is None, "the service ended by itself"
            return False

    def is_projecting(self):
        try:
            metrics = httpx.get(f"{self.url}/metrics", timeout=60).text
        except httpx.TransportError:
            return False
        return "starid_projecting 1.0" in metrics

    def wait_until_ready(self, seconds=120.0):
        wait_until(self.is_ready, seconds, every_s=0.05)

    def stop(self):
        """End in order; its exit code."""
        self._process.terminate()
        return self._process.wait(60)

    def kill(self):
        self._process.kill()
        self._process.wait()


@contextmanager
def two_services(database):
    """The one that projects, and another one."""
    with ExitStack() as stack:
        services = []
        for _ in range(2):
            services.append(Service(database))
            stack.callback(services[-1].kill)
            # On a fresh checkout kernels are compiled first.
            services[-1].wait_until_ready(seconds=900.0)
        yield services


@contextmanager
def asking(database):
    engine = create_engine(database_url(database), isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        yield connection
    engine.dispose()


@pytest.mark.slow
def test_both_services_record_and_answer_and_the_second_takes_over(database, sky, missions):
    def post(service, path, content, **headers):
        return httpx.post(f"{service.url}{path}", content=content, headers=headers, timeout=60)

    with two_services(database) as (first, second):
        assert (first.is_projecting(), second.is_projecting()) == (True, False)
        for number, service in enumerate((second, first)):
            body = samples.batch(sky, missions, f"b{number}")
            new = post(service, "/api/v1/batches", body, **JSON)
            again = post(first if service is second else second, "/api/v1/batches", body, **JSON)
            assert (new.status_code, again.status_code) == (201, 200)
            assert new.content == again.content
            (rate,) = httpx.get(f"{second.url}/api/v1/spacecraft/XTE/rates").json()["items"]
            assert rate["batches"] == number + 1
        body = samples.batch(sky, missions, "line")
        replay = post(second, "/api/v1/replays?run=r", body, **NDJSON).json()["id"]
        progress = f"{first.url}/api/v1/replays/{replay}"
        wait_until(lambda: httpx.get(progress).json()["state"] == "done", 60.0)
        first.kill()
        begun_s = time.monotonic()
        wait_until(second.is_projecting, 30.0, every_s=0.02)
        took_s = time.monotonic() - begun_s
        assert took_s < 2.0 + BUSY_S
        first.start()
        first.wait_until_ready()
        assert (first.is_projecting(), second.is_projecting()) == (False, True)


@pytest.mark.slow
def test_the_services_are_restarted_one_after_the_other_and_no_post_fails(
    database, sky, missions, figures
):
    with two_services(database) as services:
        load = Load(tuple(each.port for each in services), samples.batch(sky, missions, "NAME"))
        try:
            for service in services:
                _wait_for(load, 50, seconds=120.0)
                assert service.stop() in (0, -signal.SIGTERM)
                _wait_for(load, 50, seconds=120.0)
                service.start()
                service.wait_until_ready()
            load.stop()
        finally:
            load.give_up()
    figures(acknowledged=len(load.acknowledged), answers=dict(load.met))
    # What a balancer sends to the other service counts as broken off; nothing else is met.
    assert set(load.met) <= {200, 201, 503, "broken off"}
    _assert_recorded_once(database, load)


@pytest.mark.torture
@pytest.mark.slow
def test_after_kills_nothing_acknowledged_is_lost_or_doubled_and_projections_are_whole(
    database, sky, missions, rng, figures
):
    def kill(services, at_database):
        killed = services[rng.integers(len(services))]
        killed.kill()
        return killed

    def recover(killed):
        killed.start()
        killed.wait_until_ready()

    _under_load(database, sky, missions, rng, figures, size(KILLS), kill, recover)


@pytest.mark.torture
@pytest.mark.slow
def test_a_projector_that_loses_its_session_projects_nothing_until_it_has_the_lock_again(
    database, sky, missions, rng, figures
):
    def terminate(services, at_database):
        (pid,) = at_database.scalars(text(HOLDS_LOCK)).all()
        assert at_database.scalar(text(f"SELECT pg_terminate_backend({pid}, 5000)"))
        return services

    def recover(services):
        wait_until(lambda: sum(each.is_projecting() for each in services) == 1, 60.0)

    times = max(3, size(TERMINATED))
    _under_load(database, sky, missions, rng, figures, times, terminate, recover)


@pytest.mark.torture
@pytest.mark.slow
@pytest.mark.skipif(NGINX is None, reason="there is no nginx on this machine")
def test_behind_a_balancer_kills_and_ended_sessions_lose_and_double_nothing(
    database, sky, missions, rng, figures, tmp_path
):
    """One post after the other goes through the configuration of nginx that is shipped."""

    def disturb(services, at_database):
        if rng.random() < 0.5:
            killed = services[rng.integers(len(services))]
            killed.kill()
            return [killed]
        # All that a database server closes when it is restarted, or one of them.
        ended = "" if rng.random() < 0.5 else "ORDER BY random() LIMIT 1"
        at_database.execute(text(f"SELECT pg_terminate_backend(pid) FROM ({SESSIONS} {ended}) s"))
        return []

    def recover(killed):
        for service in killed:
            service.start()
            service.wait_until_ready()

    # Other tests have sessions on the same server.
    own = make_url(database).update_query_dict({"application_name": uuid.uuid4().hex})
    database = own.render_as_string(hide_password=False)
    with ExitStack() as stack:

        def balanced(services):
            return (stack.enter_context(balancer(services, tmp_path)),)

        _under_load(database, sky, missions, rng, figures, size(KILLS), disturb, recover, balanced)


@contextmanager
def balancer(services, folder):
    """The port of nginx before the services."""
    port, shipped = free_port(), BALANCER.read_text(encoding="utf-8")
    for name, service in zip(("one:8000", "two:8000"), services, strict=True):
        assert name in shipped
        shipped = shipped.replace(name, f"127.0.0.1:{service.port}")
    shipped = shipped.replace("listen 8000", f"listen 127.0.0.1:{port}")
    paths = "".join(
        f"{kind}_temp_path {folder}/{kind};"
        for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    shipped = shipped.replace("access_log off;", f"access_log off; {paths}")
    log = folder / "error.log"
    own = f"daemon off; pid {folder}/pid; error_log {log}; worker_processes 1;\n"
    (folder / "nginx.conf").write_text(own + shipped)
    process = subprocess.Popen([NGINX, "-e", log, "-c", folder / "nginx.conf"])

    def is_up():
        try:
            return httpx.get(f"http://127.0.0.1:{port}/livez").is_success
        except httpx.TransportError:
            return False

    try:
        wait_until(is_up, 30.0)
        yield port
    finally:
        process.terminate()
        process.wait()


def _under_load(database, sky, missions, rng, figures, times, disturb, recover, balanced=None):
    """Disturb two services so many times while clients post to whichever takes their batches.

    `balanced` gives the ports that clients use in the place of the services' own.
    """
    template = samples.batch(sky, missions, "NAME")
    assert json.loads(template)["batch"] == "NAME"
    a_round = size(ACKNOWLEDGED_A_ROUND, 50)
    pauses_s = []
    with asking(database) as at_database, two_services(database) as services:
        at_database.exec_driver_sql(NOTE_PROJECTORS)
        ports = balanced(services) if balanced else tuple(each.port for each in services)
        load = Load(ports, template)
        try:
            for _ in range(times):
                _wait_for(load, a_round, seconds=120.0)
                time.sleep(float(rng.uniform(0, 0.05)))
                disturbed = disturb(services, at_database)
                begun_s = time.monotonic()
                # Answers that were under way come first.
                _wait_for(load, 20, seconds=120.0)
                pauses_s.append(time.monotonic() - begun_s)
                recover(disturbed)
            load.stop()
        finally:
            load.give_up()
        noted = at_database.exec_driver_sql("SELECT * FROM projectors ORDER BY number").all()
    sessions = _sessions_in_order(noted)
    figures(
        times=times,
        acknowledged=len(load.acknowledged),
        answers=dict(load.met),
        longest_pause_s=round(max(pauses_s), 2),
        sessions=len(sessions),
    )
    assert len(load.acknowledged) >= times * a_round
    assert all(each.holds_lock for each in noted)
    assert len(set(sessions)) == len(sessions)
    _assert_recorded_once(database, load)


def _assert_recorded_once(database, load):
    """Each acknowledged batch is there once, with its answer, and projections are a rebuild's."""
    app = open_app(in_process_settings(database))
    try:
        assert_whole(app, dict(load.acknowledged.values()))
        with app.store.reading() as connection:
            held = dict(connection.execute(select(batches.c.batch, batches.c.id)).all())
            assert_equal_to_a_recount(connection)
        assert held == {name: id for name, (id, _) in load.acknowledged.items()}
    finally:
        app.close()


def _wait_for(load, acknowledged, seconds):
    wanted = len(load.acknowledged) + acknowledged
    wait_until(lambda: len(load.acknowledged) >= wanted, seconds, why=lambda: dict(load.met))


def _sessions_in_order(noted):
    """The sessions that projected, in order; one that comes back comes twice."""
    sessions = []
    for each in noted:
        if not sessions or sessions[-1] != each.pid:
            sessions.append(each.pid)
    return sessions


JSON = {"content-type": "application/json"}
NDJSON = {"content-type": "application/x-ndjson"}
