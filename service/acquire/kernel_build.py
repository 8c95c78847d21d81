"""Compiling the kernels in child processes, before the first batch.

Compiling takes a minute, holds the interpreter's lock and cannot be interrupted.
Children can be killed, and the parent goes on answering probes; it then loads the
kernels from the cache on disk.
"""

import multiprocessing
import os
import signal
import threading
from collections.abc import Mapping
from multiprocessing import connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any

import llvmlite.binding  # type: ignore[import-untyped]
import numba

from service.acquire.prewarm import prewarm_kernels
from service.errors import Busy, Stopping
from service.missions.mission import Mission
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import load_embedded
from service.sky.model import SkyModel

RETRY_S = 10

_CONTEXT = multiprocessing.get_context("spawn")
SIDE_BY_SIDE = (True, False), (False, True)
"""What each of two children compiles: kernels of zones, the others; see `prewarm_kernels`."""
SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""By which the service is stopped; they may reach its whole process group."""


class KernelBuild:
    """One build of the kernels, where this machine's cache does not hold them yet."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._children: list[SpawnProcess] = []
        self._cancelled = False
        self.is_needed = not _marker().exists()
        """Until a build has succeeded: an answer must not depend on what is compiled."""

    def require_built(self) -> None:
        """Raise `Busy` until the kernels are compiled."""
        if self.is_needed:
            raise Busy("the service is compiling its kernels", RETRY_S)

    def run(self, missions: Mapping[str, Mission]) -> None:
        """Compile what is not compiled, in a child for each of two parts.

        In one, without a second processor.  Raises `Busy` where that fails, `Stopping` if
        cancelled.
        """
        if not self.is_needed:
            return
        with self._lock:
            if self._cancelled:
                raise Stopping("the service is stopping")
            for zones, others in SIDE_BY_SIDE if _processors() > 1 else ((True, True),):
                child = _CONTEXT.Process(
                    target=_compile, args=(dict(missions), zones, others), daemon=True
                )
                self._children.append(child)
                child.start()
        for child in self._children:
            child.join()
        if self._cancelled:
            raise Stopping("the service is stopping")
        failed = any(child.exitcode != 0 for child in self._children)
        self._children.clear()
        if failed:
            raise Busy("the kernels could not be compiled; the log says why", RETRY_S)
        mark_built()
        self.is_needed = False

    def cancel(self) -> None:
        """End a build that is running, and let none begin."""
        with self._lock:
            self._cancelled = True
            for child in self._children:
                child.kill()


def mark_built() -> None:
    """Note in the cache that it holds every kernel."""
    marker = _marker()
    marker.parent.mkdir(parents=True, exist_ok=True)
    marker.touch()


def end_with_parent(stop: connection.Connection | None = None) -> None:
    """In a child process: ignore the signals that stop the parent, and exit when it has ended.

    Or when the other end of `stop` is closed.
    """
    for each in SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    parent = multiprocessing.parent_process()
    assert parent is not None
    ends: list[int | connection.Connection] = [parent.sentinel]
    if stop is not None:
        ends.append(stop)
    threading.Thread(target=_exit_after, args=(ends,), daemon=True).start()


def _exit_after(ends: "list[int | connection.Connection]") -> None:
    connection.wait(ends)
    os._exit(1)


def _marker() -> Path:
    # numba compiles for one processor, and keys what it caches by that and by its version.
    config: Any = numba.config
    processor = config.CPU_NAME or llvmlite.binding.get_host_cpu_name()
    return Path(config.CACHE_DIR) / f"complete-{numba.__version__}-{processor}"


def _processors() -> int:
    return len(os.sched_getaffinity(0))


def _compile(missions: Mapping[str, Mission], zones: bool, others: bool) -> None:
    end_with_parent()
    prewarm_kernels(SkyModel(load_embedded(), LruCache(64 << 20)), missions, zones, others)
