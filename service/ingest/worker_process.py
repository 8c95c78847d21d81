"""Local worker process that computes chunks of long work: its settings and functions.

The process has its own missions and sky and never sees the database.
"""

import gc
import logging
import os
import pickle
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, TypeVar

from service import logs
from service.acquire.kernel_build import end_with_parent
from service.acquire.prewarm import prewarm_kernels
from service.child_processes import Source, own_source, require_source
from service.errors import BadConfiguration
from service.ingest.solver_pool import Solver
from service.missions.mission import Mission
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import open_catalog
from service.sky.model import SkyModel

NICENESS = 10
"""Niceness of worker processes, so that single batches go first."""
PACKED_TOGETHER, MOST_BYTES = 8, 65_536
"""Number of results that a worker packs together, and the size limit of a pack in bytes."""

log = logging.getLogger(__name__)

Input = TypeVar("Input")
Output = TypeVar("Output")
Work = Callable[[Solver, Input], Sequence[Output]]


@dataclass(frozen=True)
class WorkerConfig:
    """Settings of a worker process: the same missions, catalog and cache as its parent's."""

    missions: Mapping[str, Mission]
    catalog: Path | None
    catalog_digest: str
    cache_bytes: int
    source: Source = field(default_factory=own_source)
    """Version and digest of the parent's code."""

    def solver(self) -> Solver:
        """Build the solver of a worker process from its settings.

        Raises `BadConfiguration` where the catalog's file has changed, or the code is not the
        parent's.
        """
        require_source(self.source)
        catalog = open_catalog(self.catalog)
        if catalog.digest != self.catalog_digest:
            raise BadConfiguration(f"catalog {self.catalog}: the file has changed since the start")
        return Solver(self.missions, SkyModel(catalog, LruCache(self.cache_bytes)))


def serve(
    config: WorkerConfig,
    work: Work[Any, Any],
    connection: Connection,
    log_settings: logs.LogSettings | None,
) -> None:
    """Main function of a worker: compute the tasks from a connection, until it is closed.

    Sends an empty message when it is ready; then for each task the packs of its results, pickled,
    or in words why there are none.  The process exits when its parent does, too.
    """
    end_with_parent()
    tasks: SimpleQueue[bytes] = SimpleQueue()
    Thread(target=_receive, args=(connection, tasks), daemon=True).start()
    if log_settings is not None:
        logs.configure(log_settings, "worker")
    os.nice(NICENESS)
    solver: Solver | BadConfiguration
    try:
        solver = config.solver()
    except BadConfiguration as error:
        log.error("a worker cannot compute: %s", error)
        solver = error
    else:
        prewarm_kernels(solver.sky, solver.missions)
        gc.collect()
        gc.freeze()
    with suppress(BrokenPipeError):  # nobody waits any more
        connection.send_bytes(b"")
        while True:
            connection.send_bytes(_answer(solver, work, tasks.get()))


def _receive(connection: Connection, tasks: "SimpleQueue[bytes]") -> None:
    """Queue the tasks that arrive while others are computed, so that the parent can always send."""
    try:
        while True:
            tasks.put(connection.recv_bytes())
    except (EOFError, OSError):
        os._exit(1)


def _answer(solver: Solver | BadConfiguration, work: Work[Any, Any], task: bytes) -> bytes:
    found: list[bytes] | str
    try:
        if isinstance(solver, BadConfiguration):
            raise solver
        found = packed(work(solver, pickle.loads(task)))
    except Exception as error:  # the parent says so of the task, and the worker goes on
        found = repr(error)
    return pickle.dumps(found, pickle.HIGHEST_PROTOCOL)


def packed(found: Sequence[object]) -> list[bytes]:
    """Pickle results in packs that share names; large ones singly: unpickling holds the GIL."""
    packs = []
    for first in range(0, len(found), PACKED_TOGETHER):
        chunk = found[first : first + PACKED_TOGETHER]
        pack = pickle.dumps(chunk, pickle.HIGHEST_PROTOCOL)
        if len(pack) <= MOST_BYTES:
            packs.append(pack)
        else:
            packs += [pickle.dumps([each], pickle.HIGHEST_PROTOCOL) for each in chunk]
    return packs
