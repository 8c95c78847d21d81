"""A machine whose clock is years off: everything is recorded and shown all the same."""

import time

import httpx
import pytest

from service.app.factory import open_app
from service.web.app import create_app
from tests.web.console_pages import console_addresses
from tests.web.serving import Server, in_process_settings

PAGES = (
    *console_addresses(),
    "/compare?spacecraft=XTE",
    "/sign-in",
    "/api/v1/overview",
    "/api/v1/spacecraft/XTE",
    "/api/v1/alarms?state=all",
)


@pytest.mark.parametrize(("unix_s", "year"), [(5.0, "1970"), (4.2e9, "2103")])
@pytest.mark.slow("1970")
def test_every_page_works_whatever_the_year(chosen_database, drawn, monkeypatch, unix_s, year):
    """As on a machine without a battery: it begins in 1970 until somebody tells it the time."""
    database = in_process_settings(chosen_database())
    with monkeypatch.context() as clock:
        clock.setattr(time, "time", lambda: unix_s)
        clock.setattr(time, "time_ns", lambda: int(unix_s) * 10**9)
        with (
            Server(create_app(open_app(database))) as url,
            httpx.Client(base_url=url, timeout=60, trust_env=False) as client,
        ):
            settings = {"critical": {"high": 0.5}, "minimum_count": 2, "duration_s": 0}
            limit = "/api/v1/spacecraft/XTE/limits/no_attitude_share"
            client.put(limit, json={"settings": settings, "who": "jb"}).raise_for_status()
            for each in drawn("XTE", 2, stars=1):
                answer = client.post("/api/v1/batches", json=each)
                assert answer.status_code == 201, answer.text
            # By a clock of 1970 every batch is of the future, and is not judged.
            raised = [each["id"] for each in client.get("/api/v1/alarms").json()["items"]]
            assert len(raised) == (unix_s > 4e9)
            for id in raised:
                shelved = {"who": "jb", "minutes": 5}
                client.post(f"/api/v1/alarms/{id}/shelve", json=shelved).raise_for_status()
            alarms = (f"/alarms/{id}" for id in raised)
            pages = (*PAGES, f"/batches/{answer.json()['id']}", *alarms)
            assert _statuses(client, pages) == dict.fromkeys(pages, 200)
            assert f"{year}-0" in client.get("/").text
    # The clock is set right, and what was recorded before that is still shown.
    with (
        Server(create_app(open_app(database))) as url,
        httpx.Client(base_url=url, timeout=60, trust_env=False) as client,
    ):
        assert _statuses(client, pages) == dict.fromkeys(pages, 200)
        (later,) = drawn("XTE", 1, seed=9)
        answer = client.post("/api/v1/batches", json=later | {"batch": "clock set right"})
        assert answer.status_code == 201, answer.text


def _statuses(client, pages):
    return {page: client.get(page).status_code for page in pages}
