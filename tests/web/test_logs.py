"""What `acquire serve` writes to its log, read as an operator reads it."""

import json
import re
import sqlite3
import subprocess
import sys
import urllib.request
from contextlib import contextmanager

import httpx
import pytest

from tests.web.serving import served

LINE = re.compile(
    r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z (debug|info|warning|error) (server|worker) "
)


class Service:
    """A service that was started, and what it has written so far."""

    def __init__(self, folder, monkeypatch, **settings):
        for name, value in settings.items():
            monkeypatch.setenv(f"ACQUIRE_{name.upper()}", value)
        self.file = folder / "acquire.db"
        self.database = f"sqlite:///{self.file}"
        self.log = folder / "log"

    @contextmanager
    def running(self):
        with self.log.open("wb") as log, served(self.database, stderr=log) as (process, url):
            with httpx.Client(base_url=url, timeout=60) as client:
                yield client
            process.terminate()
            process.wait()

    def command(self, *arguments):
        command = [sys.executable, "-m", "service.cli", *arguments]
        told = subprocess.run(command, capture_output=True, text=True, check=True)
        return told.stdout, told.stderr

    @property
    def text(self):
        return self.log.read_text()

    @property
    def objects(self):
        return [json.loads(line) for line in self.text.splitlines()]


@pytest.fixture
def service(tmp_path, monkeypatch):
    return lambda **settings: Service(tmp_path, monkeypatch, **settings)


def test_a_line_says_when_how_grave_which_request_who_and_of_what_run(service, batch):
    made = service(log_format="json")
    told, _ = made.command(
        "token",
        "create",
        "J. Operator",
        "--scope",
        "read",
        "--scope",
        "submit",
        "--database",
        made.database,
    )
    token = told.split()[0]
    assert token.startswith("acq_")
    bearer = {"Authorization": f"Bearer {token}"}
    with made.running() as client:
        cookie = client.post("/api/v1/session", json={"token": token}).cookies["acquire_session"]
        client.cookies.clear()
        own = client.get("/api/v1/batches?run=pass-7&limit=3", headers=bearer)
        kept = client.get("/missing", headers=bearer | {"X-Request-ID": "proxy-12:ab/c="})
        odd = client.get(f"/{token}?token={token}", headers={"X-Request-ID": "a b" + "c" * 500})
        client.get("/alarms", headers={"Cookie": f"acquire_session={cookie}"})
        wrong = batch | {"a_priori": {"quaternion": ["body of a client"]}}
        refused = client.post("/api/v1/batches", json=wrong, headers=bearer)
        client.post("/api/v1/batches", json=batch, headers=bearer).raise_for_status()
    assert refused.status_code == 422
    lines = made.objects
    assert all({"time", "level", "process", "logger", "message"} <= set(each) for each in lines)
    by_id = {each["request_id"]: each for each in lines if "status" in each}
    line = by_id[own.headers["X-Request-ID"]]
    assert {
        name: line[name] for name in ("method", "path", "status", "caller", "run", "level")
    } == {
        "method": "GET",
        "path": "/api/v1/batches",
        "status": 200,
        "caller": "J. Operator",
        "run": "pass-7",
        "level": "info",
    }
    assert 0 < line["duration_ms"] < 60_000
    assert kept.headers["X-Request-ID"] == "proxy-12:ab/c="
    assert by_id["proxy-12:ab/c="]["status"] == 404
    assert re.fullmatch("[0-9a-f]{16}", odd.headers["X-Request-ID"])
    assert by_id[refused.headers["X-Request-ID"]]["status"] == 422
    assert len(by_id) == len([each for each in lines if "status" in each])
    for secret in (token, cookie, token[4:], cookie[4:], "body of a client", batch["batch"]):
        assert secret not in made.text
    posts = [each["status"] for each in lines if each.get("path") == "/api/v1/batches"]
    assert 201 not in posts, "a line for each recorded batch would take time from all"


@pytest.mark.slow
def test_text_is_a_line_each_and_cannot_be_forged(service, batch):
    made = service()
    with made.running() as client:
        host = str(client.base_url)
        with pytest.raises(urllib.error.HTTPError):
            urllib.request.urlopen(f"{host}/a%0a2026-01-01T00:00:00.000Z%20error%20forged")
        client.post("/api/v1/batches", json=batch).raise_for_status()
        client.get("/static/console.css").raise_for_status()
        client.get("/about").raise_for_status()
    lines = made.text.splitlines()
    assert all(LINE.match(each) for each in lines), made.text
    # Until it is ready, a probe is told so.
    shown = [each for each in lines if "service.requests" in each and " /readyz 503 " not in each]
    assert [" 404 " in each for each in shown] == [True, False]
    assert "GET /about 200" in shown[1]
    assert "caller=local" in shown[1]


@pytest.mark.slow
def test_at_debug_every_request_has_a_line(service, batch):
    made = service(log_level="debug")
    with made.running() as client:
        client.post("/api/v1/batches", json=batch).raise_for_status()
    assert "POST /api/v1/batches 201" in made.text
    assert "GET /readyz 200" in made.text
    assert "numba" not in made.text


@pytest.mark.slow
def test_an_error_that_is_repeated_is_written_once_and_counted(service):
    made = service(log_format="json")
    with made.running() as client:
        with sqlite3.connect(made.file) as database:
            database.execute("ALTER TABLE runs RENAME TO elsewhere")
        answers = [client.get("/api/v1/runs") for _ in range(30)]
    assert {each.status_code for each in answers} <= {500, 503}
    told = [each for each in made.objects if each["level"] == "error"]
    whole = [each for each in told if "repeated" not in each]
    kinds = {(each["logger"], each.get("error", "")[-80:]) for each in whole}
    assert len(whole) == len(kinds), "each error once"
    assert whole[0]["request_id"] == answers[0].headers["X-Request-ID"]
    assert {each["repeated"] for each in told if "repeated" in each} == {29}


@pytest.mark.slow
def test_an_error_line_names_the_request_that_failed(service, batch):
    made = service(log_format="json")
    with made.running() as client:
        id = client.post("/api/v1/batches", json=batch).json()["id"]
        with sqlite3.connect(made.file) as database:
            database.execute("ALTER TABLE batches RENAME TO elsewhere")
        answer = client.post(f"/api/v1/batches/{id}/what-if", json={})
    assert answer.status_code in (500, 503)
    errors = [each for each in made.objects if each["level"] == "error"]
    assert answer.headers["X-Request-ID"] in [each.get("request_id") for each in errors]


@pytest.mark.parametrize(("name", "value"), [("log_format", "xml"), ("log_level", "loud")])
def test_a_setting_that_cannot_be_is_refused_with_its_name(acquire, monkeypatch, name, value):
    monkeypatch.setenv(f"ACQUIRE_{name.upper()}", value)
    code, _, told = acquire("serve")
    assert (code, f"ACQUIRE_{name.upper()}: must be" in told) == (2, True)
