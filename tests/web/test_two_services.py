"""Two services on one PostgreSQL database record; one projects, and the other takes over."""

import asyncio
import json
import signal
import socket
import subprocess
import sys
import time
import uuid
from collections import Counter
from contextlib import AsyncExitStack, ExitStack, contextmanager
from pathlib import Path

import httpx
import pytest
from sqlalchemy import create_engine, make_url, select, text

from service.app.factory import open_app
from service.storage.sql.engines import database_url
from service.storage.sql.tables import batches
from tests.features.follow.bus import bus, followers
from tests.features.follow.nats_server import nats_server
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
MESSAGES_A_ROUND, FOLLOWERS = 200, 2
BALANCER_FORGETS_S = 2.5
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
@pytest.mark.parametrize(
    "through",
    [
        "ports",
        pytest.param("nginx", marks=pytest.mark.skipif(NGINX is None, reason="there is no nginx")),
    ],
)
def test_the_services_are_restarted_one_after_the_other_and_no_post_fails(
    database, sky, missions, figures, tmp_path, through
):
    with two_services(database) as services, ExitStack() as stack:
        ports = tuple(each.port for each in services)
        if through == "nginx":
            ports = (stack.enter_context(balancer(services, tmp_path)),)
        load = Load(ports, samples.batch(sky, missions, "NAME"))
        try:
            for service in (*services, *services):
                _wait_for(load, 50, seconds=120.0)
                assert service.stop() in (0, -signal.SIGTERM)
                _wait_for(load, 50, seconds=120.0)
                service.start()
                service.wait_until_ready()
                # For so long nginx sends nothing to a service that it has found gone.
                time.sleep(BALANCER_FORGETS_S if through == "nginx" else 0.0)
            load.stop()
        finally:
            load.give_up()
    figures(acknowledged=len(load.acknowledged), answers=dict(load.met))
    # A client that knows both services goes to the other one; nginx does so for its clients.
    allowed = {200, 201, 503, "broken off"} if through == "ports" else {200, 201}
    assert set(load.met) <= allowed
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
    """Posts go through the configuration of nginx that is shipped, and so do two followers.

    Services, the one that projects, sessions of PostgreSQL, NATS and followers are killed.
    """
    template = samples.batch(sky, missions, "NAME")
    published, kills = [], Counter()
    # Other tests have sessions on the same server.
    own = make_url(database).update_query_dict({"application_name": uuid.uuid4().hex})
    database = own.render_as_string(hide_password=False)
    with ExitStack() as stack:
        server = stack.enter_context(nats_server(tmp_path / "nats"))
        runner = stack.enter_context(asyncio.Runner())
        opened = AsyncExitStack()
        made = runner.run(opened.enter_async_context(bus(server.url)))
        stack.callback(lambda: runner.run(opened.aclose()))
        running = []

        def balanced(services):
            port = stack.enter_context(balancer(services, tmp_path))
            url = f"http://127.0.0.1:{port}"
            running.extend(stack.enter_context(followers(made, url, FOLLOWERS)))
            return (port,)

        def disturb(services, at_database):
            names = [f"bus-{len(published) + k}" for k in range(size(MESSAGES_A_ROUND, 10))]
            texts = [template.replace("NAME", name) for name in names]
            runner.run(made.publish_until_kept(texts))
            published.extend(names)
            kind = rng.choice(["service", "projector", "session", "sessions", "NATS", "follower"])
            kills[str(kind)] += 1
            if kind == "NATS":
                server.kill()
                return [server]
            if kind == "follower":
                killed = running[rng.integers(FOLLOWERS)]
            elif kind == "service":
                killed = services[rng.integers(len(services))]
            elif kind == "projector":
                killed = next((each for each in services if each.is_projecting()), services[0])
            else:
                # All that a database server closes when it is restarted, or one of them.
                ended = "" if kind == "sessions" else "ORDER BY random() LIMIT 1"
                chosen = f"({SESSIONS} {ended}) s"
                at_database.execute(text(f"SELECT pg_terminate_backend(pid) FROM {chosen}"))
                return []
            killed.kill()
            return [killed]

        def recover(killed):
            for each in killed:
                each.start()
                if isinstance(each, Service):
                    each.wait_until_ready()

        def finish():
            runner.run(made.wait_until_empty(seconds=600.0))
            assert runner.run(made.kept_of(made.refusals)) == []
            return published

        _under_load(
            *(database, sky, missions, rng, figures, size(KILLS), disturb, recover),
            *(balanced, finish),
            kills=kills,
        )


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


def _under_load(
    database,
    sky,
    missions,
    rng,
    figures,
    times,
    disturb,
    recover,
    balanced=None,
    finish=lambda: (),
    **noted,
):
    """Disturb two services so many times while clients post to whichever takes their batches.

    `balanced` gives the ports that clients use in the place of the services' own, `finish` the
    names of batches that came another way.
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
            others = set(finish())
        finally:
            load.give_up()
        steps = at_database.exec_driver_sql("SELECT * FROM projectors ORDER BY number").all()
    sessions = _sessions_in_order(steps)
    figures(
        times=times,
        acknowledged=len(load.acknowledged),
        answers=dict(load.met),
        longest_pause_s=round(max(pauses_s), 2),
        from_the_bus=len(others),
        sessions=len(sessions),
        **noted,
    )
    assert len(load.acknowledged) >= times * a_round
    assert all(each.holds_lock for each in steps)
    assert len(set(sessions)) == len(sessions)
    _assert_recorded_once(database, load, others)


def _assert_recorded_once(database, load, others=frozenset()):
    """Each acknowledged batch is there once, with its answer, and projections are a rebuild's.

    `others` are the names of batches that did not come from the load.
    """
    app = open_app(in_process_settings(database))
    try:
        assert_whole(app, dict(load.acknowledged.values()))
        with app.store.reading() as connection:
            rows = connection.execute(select(batches.c.batch, batches.c.id)).all()
            assert_equal_to_a_recount(connection)
        held = {name: id for name, id in rows if name not in others}
        assert held == {name: id for name, (id, _) in load.acknowledged.items()}
        assert sorted(name for name, _ in rows if name in others) == sorted(others)
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
