"""The app behind a real server: in a thread of this process, or as `acquire serve` has it."""

import asyncio
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import IO, cast

import httpx
import uvicorn
from fastapi import FastAPI

from service.acquire.prewarm import prewarm_kernels
from service.missions.mission import load_missions
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel
from service.web.connection_limits import Admission
from service.web.server import Server as StreamingServer
from service.web.slow_clients import Connection


def _stop_streams_of(app: FastAPI) -> Callable[[], None]:
    # Some tests put another app around the real one.
    stop: Callable[[], None] = getattr(app, "app", app).state.live.stop
    return stop


@cache
def compile_kernels() -> None:
    """Compile what a first request would wait for: on a fresh checkout that takes minutes."""
    prewarm_kernels(SkyModel(load_embedded(), LruCache(64 << 20)), load_missions())


class Server:
    """The app behind uvicorn on a free port, in a thread of this process."""

    def __init__(self, app: FastAPI, port: int = 0, admission: Admission | None = None) -> None:
        compile_kernels()
        protocol = cast(type[asyncio.Protocol], Connection)
        config = uvicorn.Config(app, port=port, http=protocol, ws="none", log_level="warning")
        self._server = StreamingServer(config, _stop_streams_of(app), admission)
        # Signals belong to the main thread, which is the caller's.
        self._thread = threading.Thread(target=self._server.run, name="server")

    def __enter__(self) -> str:
        self._thread.start()
        while not self._server.started:
            assert self._thread.is_alive(), "the server did not start"
            time.sleep(0.01)
        port = self._server.servers[0].sockets[0].getsockname()[1]
        return f"http://127.0.0.1:{port}"

    def __exit__(self, *_: object) -> None:
        self._server.should_exit = True
        self._thread.join()


@contextmanager
def serving(
    database: str, stderr: IO[bytes] | None = None
) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """`acquire serve` on a database: its process, which has others, and its URL."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
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
        while True:
            assert process.poll() is None
            try:
                if httpx.get(f"{url}/readyz").status_code == 200:
                    break
            except httpx.TransportError:
                pass
            time.sleep(0.1)
        yield process, url
