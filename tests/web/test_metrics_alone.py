"""The metrics of the process answer whatever the database does."""

import httpx
import pytest

from service import access as sessions
from service.app.factory import open_app
from service.settings import Settings
from service.web.app import create_app
from tests.fresh_databases import sqlite_at
from tests.web.serving import Server


@pytest.fixture
def served(tmp_path):
    app = open_app(Settings(database=sqlite_at(tmp_path / "acquire.db"), replay_processes=0))
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=60) as client:
        yield app, client, tmp_path / "acquire.db"


@pytest.mark.parametrize("is_open", [True, False])
def test_metrics_are_there_while_the_database_is_not(served, is_open, monkeypatch):
    app, client, file = served
    # As if the second were over for which what is known of a caller is believed.
    monkeypatch.setattr(sessions, "KNOWN_FOR_S", 0.0)
    shown = {}
    if not is_open:
        shown["Authorization"] = f"Bearer {app.tokens.add('prometheus', ['read']).token}"
        app.access.forget()
    assert client.get("/metrics", headers=shown).status_code == 200
    assert client.get("/api/v1/overview", headers=shown).status_code == 200
    file.rename(file.with_name("away"))
    try:
        answer = client.get("/metrics", headers=shown)
        refused = client.get("/api/v1/overview", headers=shown)
        unknown = client.get("/metrics", headers={"Authorization": "Bearer acq_unknown"})
    finally:
        file.with_name("away").rename(file)
    assert (answer.status_code, refused.status_code) == (200, 503)
    assert unknown.status_code == (200 if is_open else 503)
    for name in (
        "starid_last_write_succeeded",
        "starid_queue_depth",
        "starid_build_info",
        "process_resident_memory_bytes",
        "process_cpu_seconds_total",
        "process_open_fds",
        "python_info",
    ):
        assert f"\n{name}" in answer.text, name
    assert "\nstarid_alarms{" not in answer.text
