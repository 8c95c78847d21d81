"""systemd hears that the service is ready, that it is alive, and that it stops."""

import os
import signal
import socket

import pytest
from sqlalchemy import create_engine
from sqlalchemy.pool import NullPool

from service.storage.sql.engines import database_url
from service.storage.sql.projector_lock import ProjectorLock
from tests.fresh_databases import sqlite_at
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


@pytest.mark.slow
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
@pytest.mark.slow
def test_a_service_beside_one_that_projects_is_ready(heard, database):
    engine = create_engine(database_url(database), poolclass=NullPool)
    with engine.connect() as other:
        assert ProjectorLock().take(other) == "taken"
        with serving(database):
            assert heard() == "READY=1\nSTATUS=ready"
