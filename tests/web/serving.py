"""The app behind a real server: in a thread of this process, or as `acquire serve` has it."""

import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import IO, Any

import httpx
from fastapi import FastAPI

from service.acquire.prewarm import compile_beside_batches, prewarm_kernels
from service.app.factory import App, open_app
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Mission, load_missions
from service.settings import Settings
from service.simulate.stretches import Pass
from service.simulate.telemetry import draw_pass
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.web.app import create_app
from service.web.server import Server as StreamingServer
from service.web.server import configuration
from service.web.slow_clients import Admission
from tests.waiting import wait_until


def _stop_streams_of(app: FastAPI) -> Callable[[], None]:
    # Some tests put another app around the real one.
    stop: Callable[[], None] = getattr(app, "app", app).state.live.stop
    return stop


@cache
def compile_kernels() -> None:
    """Compile what a first request would wait for: on a fresh checkout that takes minutes."""
    sky = SkyModel(load_embedded(), LruCache(64 << 20))
    prewarm_kernels(sky, load_missions(), IDENTIFIERS, seldom=True)
    compile_beside_batches()


class Server:
    """The app behind uvicorn on a free port, in a thread of this process."""

    def __init__(
        self,
        app: FastAPI,
        port: int = 0,
        admission: Admission | None = None,
        keep_alive_seconds: int = Settings.keep_alive_seconds,
    ) -> None:
        compile_kernels()
        settings = Settings(port=port, keep_alive_seconds=keep_alive_seconds)
        config = configuration(settings, app)
        self._server = StreamingServer(config, _stop_streams_of(app), admission)
        # Signals belong to the main thread, which is the caller's.
        self._thread = threading.Thread(target=self._server.run, name="server")

    def __enter__(self) -> str:
        self._thread.start()

        def has_started() -> bool:
            assert self._thread.is_alive(), "the server did not start"
            return self._server.started

        wait_until(has_started)
        port = self._server.servers[0].sockets[0].getsockname()[1]
        return f"http://127.0.0.1:{port}"

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join()


@dataclass(frozen=True)
class InProcess:
    """A service in a thread of this process, and a client of it."""

    app: App
    url: str
    client: httpx.Client

    def draw(self, spacecraft: str, batches: int, **wanted: Any) -> list[dict[str, Any]]:
        """Batches of a pass over the real catalog."""
        wanted_pass = Pass(batches=batches, **wanted)
        drawn = draw_pass(self.app.missions[spacecraft], self.app.sky, wanted_pass)
        return [each.batch for each in drawn]

    def send_full_run(self) -> str:
        """Send 20 batches of XTE and 20 of SOHO, stretches of trouble included; their run.

        Those of XTE by votes, which leave more stars ambiguous.
        """
        for spacecraft, options in (("XTE", {"identifier": "starid"}), ("SOHO", {})):
            for batch in self.draw(spacecraft, 20, seed=4):
                body = batch | {"run": "full", "options": options}
                self.client.post("/api/v1/batches", json=body).raise_for_status()
        return "full"


def in_process_settings(database: str, **wanted: Any) -> Settings:
    """Settings of a service for tests: replays are computed in its own process.

    Two further processes take seconds to start, and the answers are the same.
    """
    return Settings(**({"database": database, "replay_processes": 0} | wanted))


@contextmanager
def serving_in_process(
    database: str, mission: Mission | None = None, **wanted: Any
) -> Iterator[InProcess]:
    """A service with `in_process_settings`, ready for work, until its end."""
    app = open_app(in_process_settings(database, **wanted), mission)
    with Server(create_app(app)) as url, httpx.Client(base_url=url, timeout=120) as client:
        # Its warm-up builds zones, which tests count.
        wait_until(lambda: client.get("/readyz").status_code == 200, 600.0)
        yield InProcess(app, url, client)


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
    return port


@contextmanager
def serving(
    database: str, stderr: IO[bytes] | None = None
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """`acquire serve` on a database: its process, which has others, and its URL."""
    port = free_port()
    command = [sys.executable, "-m", "service.cli", "serve", "--port", str(port)]
    process = subprocess.Popen([*command, "--database", database], stderr=stderr)
    try:
        yield process, f"http://127.0.0.1:{port}"
    finally:
        process.terminate()
        process.wait()


@contextmanager
def served(
    database: str, stderr: IO[bytes] | None = None
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """`serving`, ready for work."""
    with serving(database, stderr) as (process, url):
        wait_until(lambda: is_ready(process, url), 600.0, every_s=0.1)
        yield process, url


def is_ready(process: subprocess.Popen[bytes], url: str, probe: str = "readyz") -> bool:
    """Whether a service that was started takes batches; fails where its process has ended."""
    assert process.poll() is None, "the service ended by itself"
    try:
        return httpx.get(f"{url}/{probe}", timeout=60).status_code == 200
    except httpx.TransportError:
        return False


def ended(client: httpx.Client, begun: httpx.Response | str, **more: Any) -> dict[str, Any]:
    """A replay or a calibration when it is over: of the answer that began it, or of its address."""
    if isinstance(begun, httpx.Response):
        assert begun.status_code == 202, begun.text
        begun = begun.headers["Location"]

    def over() -> dict[str, Any] | None:
        answer = client.get(begun, **more)
        assert answer.status_code == 200, answer.text
        found: dict[str, Any] = answer.json()
        return None if found["state"] in ("queued", "running") else found

    found = wait_until(over, 300.0)
    assert found is not None
    return found
