"""Probes and metrics; the answer to a fault of ours."""

import asyncio
import gc
import math
import sys
import threading
import time
import weakref
from concurrent.futures import ThreadPoolExecutor

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families
from sqlalchemy import text

from service.app.factory import open_app
from service.errors import Busy, Stopping
from service.storage import progress
from service.storage.projections import projector
from service.web.app import create_app
from service.web.middleware import warm_request
from tests.fresh_databases import sqlite_at
from tests.scale import draws
from tests.storage.samples import submission
from tests.waiting import wait_until
from tests.web.serving import Server, in_process_settings


def samples(client):
    told = client.get("/metrics").text
    return {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(told)
        for sample in family.samples
    }


def stars(found, outcome):
    return found["starid_stars_total", ("outcome", outcome), ("spacecraft", "XTE")]


def test_it_lives_and_becomes_ready(client):
    assert client.get("/livez").status_code == 200

    def is_ready():
        answer = client.get("/readyz")
        assert answer.status_code == 200 or "Retry-After" in answer.headers
        return answer.status_code == 200

    wait_until(is_ready)


@pytest.mark.slow
def test_answers_say_how_far_trends_are_behind_the_record(client, post, batch, monkeypatch):
    """They come within a second of a held-up projector, and are right once it goes on."""
    go_on = threading.Event()

    def held_up(connection, new):
        if not go_on.is_set():
            raise Busy("held up")

    def depth():
        return samples(client)["starid_queue_depth", ("queue", "projections")]

    monkeypatch.setattr(projector, "PROJECTIONS", (held_up, *projector.PROJECTIONS))
    monkeypatch.setattr(progress, "WAIT_S", 0.2)
    trends = "/api/v1/spacecraft/XTE/rates"
    before = sum(each["batches"] for each in client.get(trends).json()["items"])
    post(batch)
    late = client.get(trends)
    assert sum(each["batches"] for each in late.json()["items"]) == before
    assert float(late.headers["X-Behind-Seconds"]) > 0.1
    assert "behind the batches" in client.get("/spacecraft/XTE").text
    assert depth() == 1
    assert "X-Behind-Seconds" not in client.get("/api/v1/batches").headers
    wait_until(lambda: "1 results" in client.get("/readyz").text)
    go_on.set()
    wait_until(lambda: depth() == 0)
    caught_up = client.get(trends)
    assert sum(each["batches"] for each in caught_up.json()["items"]) == before + 1
    assert "X-Behind-Seconds" not in caught_up.headers
    assert client.get("/readyz").text == "ready\n"


def test_live_stars_are_counted_once_by_outcome(client, post, batch, run):
    before = samples(client)
    post(batch)
    post(batch)
    post(batch | {"run": run})
    after = samples(client)
    assert stars(after, "unique") - stars(before, "unique") == 5
    assert stars(after, "unmatched") == stars(before, "unmatched")
    assert after["starid_batches_repeated_total",] - before["starid_batches_repeated_total",] == 1


def test_a_what_if_is_no_new_observation(client, post, batch):
    id = post(batch).json()["id"]
    before = samples(client)
    client.post(
        f"/api/v1/batches/{id}/what-if", json={"options": {"solver": "triad"}, "adopt": True}
    )
    assert stars(samples(client), "unique") == stars(before, "unique")


def test_requests_are_counted_under_their_route_and_not_their_address(client, post, batch):
    client.get(post(batch).headers["Location"])
    client.get("/nothing/of/the/kind")
    routes = {dict(key[1:]).get("route") for key in samples(client) if "request" in key[0]}
    assert {"/api/v1/batches", "/api/v1/batches/{id}", "none"} <= routes
    assert not any("nothing" in (route or "") for route in routes)


def test_the_cache_of_zones_is_counted(client):
    found = samples(client)
    for name in ("hits_total", "misses_total", "bytes"):
        assert (f"starid_zone_cache_{name}",) in found


def test_two_apps_share_no_counter(client, tmp_path):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "other.db")))
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as other:
        assert stars(samples(other), "unique") == 0


def test_the_warm_up_request_reaches_the_queue_and_is_not_counted(
    tmp_path,
):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "rehearsed.db")))
    web_app = create_app(app)
    try:
        assert asyncio.run(warm_request(web_app)) == 422
        assert math.isfinite(app.submissions.idle_s), "nothing was queued"
        assert b'route="/api/v1/batches"' not in web_app.state.metrics.text()
    finally:
        app.close()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_queue_whose_thread_has_ended_is_told_by_the_probe_of_life(
    tmp_path, sky, missions, monkeypatch
):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "ended.db")))
    with Server(create_app(app)) as address, httpx.Client(base_url=address) as client:
        assert client.get("/livez").status_code == 200
        monkeypatch.setattr("service.ingest.queue.look_up", lambda *asked: sys.exit())
        body, headers = submission(sky, missions).text, {"Content-Type": "application/json"}
        refused = client.post("/api/v1/batches", content=body, headers=headers)
        assert refused.status_code == 503
        assert client.get("/livez").status_code == 503


def test_where_the_records_cannot_be_followed_it_does_not_start_and_ends(tmp_path, monkeypatch):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "unread.db")))
    app.service.ready()
    web_app = create_app(app)

    def unreadable():
        raise RuntimeError("there is nothing to follow")

    monkeypatch.setattr(app.events, "last", unreadable)

    async def start():
        async with web_app.router.lifespan_context(web_app):
            raise AssertionError("it started")

    with pytest.raises(RuntimeError, match="nothing to follow"):
        asyncio.run(start())
    assert not [thread for thread in threading.enumerate() if thread.name == "warm-up"]
    with pytest.raises(Stopping):
        app.submissions.require_alive()


def test_a_fault_of_ours_is_logged_and_says_nothing_of_what_is_inside(tmp_path, caplog):
    app = open_app(in_process_settings(sqlite_at(tmp_path / "gone.db")))
    with Server(create_app(app)) as address:
        rename = text("ALTER TABLE runs RENAME TO elsewhere")
        app.context.change(lambda connection: connection.execute(rename).close())
        with httpx.Client(base_url=address) as client:
            answer = client.get("/api/v1/runs")
            assert client.get("/livez").status_code == 200, "on the same connection"
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.status_code in (500, 503)
    assert "runs" not in answer.json()["detail"]
    assert "elsewhere" not in answer.text
    assert "GET /api/v1/runs failed" in caplog.text


def test_with_every_handler_at_work_it_is_still_ready_and_still_stops(tmp_path, monkeypatch):
    """Probes and the way out have threads of their own."""
    app = open_app(in_process_settings(sqlite_at(tmp_path / "busy.db")))
    app.service.ready()
    monkeypatch.setattr("service.web.app.WORKER_THREADS", 2)
    go_on = threading.Event()
    monkeypatch.setattr(app.runs, "all", lambda: go_on.wait(30) and [])
    with Server(create_app(app)) as address, ThreadPoolExecutor(2) as threads:
        for _ in range(2):
            threads.submit(httpx.get, f"{address}/api/v1/runs", timeout=60)
        time.sleep(0.3)
        assert httpx.get(f"{address}/readyz", timeout=10).status_code == 200
        go_on.set()


def opened_and_closed(database, serves):
    """Open a service, let it serve where wanted, close it; what must not be left of it."""
    app = open_app(in_process_settings(database))
    web_app = create_app(app)
    if serves:
        with Server(web_app) as address:
            wait_until(lambda: httpx.get(f"{address}/readyz").status_code == 200)
            assert httpx.get(f"{address}/metrics").status_code == 200
    else:
        app.close()
    return weakref.ref(app), weakref.ref(web_app)


def test_closed_services_leave_no_memory_and_no_thread(tmp_path, resident_mb):
    """A service that is ready keeps its objects from the garbage collector, until it is closed."""
    services = draws(10, 20)
    databases = (sqlite_at(tmp_path / f"{number}.db") for number in range(1 + services))
    # The first one fills caches that the process keeps.
    references = [opened_and_closed(next(databases), serves=True)]
    gc.collect()
    before_mb, threads = resident_mb(), set(threading.enumerate())
    references += [opened_and_closed(each, n % 10 == 0) for n, each in enumerate(databases)]
    gc.collect()
    assert [each() for pair in references for each in pair] == [None] * 2 * (1 + services)
    assert set(threading.enumerate()) <= threads
    assert resident_mb() - before_mb < 40
