"""Server processes for measurements: the service, and the no-op server."""

import os
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

START_S = 600.0
"""Seconds to wait for a server, more than a first start compiles on a busy machine."""
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Served:
    """Running server: its port and process, and the seconds until it reported ready."""

    port: int
    pid: int
    ready_s: float

    def cpu_s(self) -> float:
        """Processor seconds so far of the server and its child processes."""
        return sum(int(each) for pid in self._pids() for each in _stat(pid)[11:13]) / _TICKS

    def resident_mb(self) -> float:
        """Memory in MB of the server and its child processes; shared pages count repeatedly."""
        pages = sum(int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in self._pids())
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def _pids(self) -> list[int]:
        """Process ids of the server and of all its descendants."""
        parents = {}
        for each in Path("/proc").iterdir():
            if each.name.isdigit():
                with suppress(OSError):
                    parents[int(each.name)] = int(_stat(int(each.name))[1])
        found = [self.pid]
        for pid in found:
            found += [child for child, parent in parents.items() if parent == pid]
        return found

    def address(self, path: str) -> str:
        return f"http://127.0.0.1:{self.port}{path}"


def _stat(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()


@contextmanager
def service(
    database: Path | str,
    missions: Path | None = None,
    environment: Mapping[str, str] = MappingProxyType({}),
) -> Iterator[Served]:
    """Run `acquire serve` with an SQLite file or a database URL, and stop it at the end.

    `missions` is a folder of missions that replaces the one in the environment.
    """
    url = database if isinstance(database, str) else f"sqlite:///{database}"
    arguments = ["-m", "service.cli", "serve", "--database", url]
    own = dict(environment)
    if missions is not None:
        own["ACQUIRE_MISSIONS"] = str(missions)
    with _served(arguments, "/readyz", own) as served:
        yield served


@contextmanager
def no_op() -> Iterator[Served]:
    """Run the no-op server (`benchmarks.speed.no_op`) on the same HTTP server."""
    arguments = ["-m", "uvicorn", "benchmarks.speed.no_op:app", "--http", "httptools"]
    arguments += ["--loop", "uvloop", "--no-access-log", "--log-level", "warning"]
    with _served(arguments, "/") as served:
        yield served


@contextmanager
def _served(
    arguments: list[str], path: str, environment: Mapping[str, str] = MappingProxyType({})
) -> Iterator[Served]:
    port = free_port()
    started = time.perf_counter()
    command = [sys.executable, *arguments, "--port", str(port)]
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, **environment},
    )
    try:
        while not _answers(f"http://127.0.0.1:{port}{path}"):
            if process.poll() is not None or time.perf_counter() - started > START_S:
                raise RuntimeError(f"no answer from: {' '.join(command)}")
            time.sleep(0.02)
        yield Served(port, process.pid, time.perf_counter() - started)
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(60)


def free_port() -> int:
    """Number of a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def _answers(url: str) -> bool:
    try:
        with urllib.request.urlopen(url, timeout=5):
            return True
    except urllib.error.HTTPError as error:
        return error.code == 404
    except OSError:
        return False
