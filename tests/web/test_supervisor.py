"""systemd hears that the service is ready, that it is alive, and that it stops."""

import os
import signal
import socket

import pytest

from tests.web.serving import served


@pytest.fixture
def heard(tmp_path, monkeypatch):
    """The socket that a unit of `Type=notify` has, with a watchdog of two seconds."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as inbox:
        inbox.bind(str(path))
        inbox.settimeout(10)
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        monkeypatch.setenv("WATCHDOG_USEC", "2000000")
        yield lambda: inbox.recv(4096).decode()


def test_it_reports_ready_then_signs_of_life_then_that_it_stops(heard, tmp_path):
    with served(f"sqlite:///{tmp_path / 'acquire.db'}") as (process, _):
        assert heard().startswith("READY=1")
        assert [heard(), heard()] == ["WATCHDOG=1", "WATCHDOG=1"]
        process.terminate()
        last = heard()
        while last == "WATCHDOG=1":
            last = heard()
        assert last == "STOPPING=1"
        assert process.wait(20) in (0, -signal.SIGTERM)


def test_a_process_that_stands_gives_no_sign_of_life(heard, tmp_path):
    with served(f"sqlite:///{tmp_path / 'acquire.db'}") as (process, _):
        assert heard().startswith("READY=1")
        assert heard() == "WATCHDOG=1"
        os.kill(process.pid, signal.SIGSTOP)
        try:
            with pytest.raises(TimeoutError):
                # At most one was on its way.
                [heard(), heard()]
        finally:
            os.kill(process.pid, signal.SIGCONT)
