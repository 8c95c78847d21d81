"""systemd hears that the service is ready, that it is alive, and that it stops."""

import os
import signal
import socket
from contextlib import suppress

import httpx
import pytest
from service.storage.sql.writing_lock import WritingLock
from sqlalchemy import create_engine
from sqlalchemy.pool import NullPool

from service.storage.sql.engines import database_url
from tests.fresh_databases import sqlite_at
from tests.waiting import wait_until
from tests.web.serving import served, serving


@pytest.fixture
def heard(tmp_path, monkeypatch):
    """The socket that a unit of `Type=notify` has, with a watchdog of two seconds."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as inbox:
        inbox.bind(str(path))
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        monkeypatch.setenv("WATCHDOG_USEC", "2000000")

        def heard(longest_s=60.0):
            inbox.settimeout(longest_s)
            return inbox.recv(4096).decode()

        yield heard


def test_it_reports_ready_then_signs_of_life_none_where_it_stands_and_that_it_stops(
    heard, tmp_path
):
    with served(sqlite_at(tmp_path / "acquire.db")) as (process, _):
        assert heard().startswith("READY=1")
        assert [heard(), heard()] == ["WATCHDOG=1", "WATCHDOG=1"]
        os.kill(process.pid, signal.SIGSTOP)
        try:
            with pytest.raises(TimeoutError):
                # At most one was on its way.
                [heard(longest_s=4.0), heard(longest_s=4.0)]
        finally:
            os.kill(process.pid, signal.SIGCONT)
        process.terminate()
        last = heard()
        while last == "WATCHDOG=1":
            last = heard()
        assert last == "STOPPING=1"
        assert process.wait(20) in (0, -signal.SIGTERM)


@pytest.mark.parametrize("database", ["postgresql"], indirect=True)
def test_a_service_that_stands_by_has_started(heard, database):
    engine = create_engine(database_url(database), poolclass=NullPool)
    with engine.connect() as other:
        assert WritingLock().take(other) == "taken"
        with serving(database) as (_, url):
            wait_until(lambda: standing_by(url))
            assert heard() == "READY=1\nSTATUS=standing by"
            other.close()
            while (told := heard()) != "STATUS=ready":
                assert told == "WATCHDOG=1"


def standing_by(url):
    with suppress(httpx.TransportError):
        answer = httpx.get(f"{url}/readyz")
        return answer.status_code == 503 and answer.json()["type"] == "/problems/standby"
    return False
