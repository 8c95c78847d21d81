"""Local worker process that computes chunks of long work: its settings and functions.

The process has its own missions and sky and never sees the database.
"""

import gc
import logging
import os
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier
from pathlib import Path
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


_solver: Solver | BadConfiguration
_all_ready: Barrier


def begin(
    config: WorkerConfig,
    stop: Connection,
    all_ready: Barrier,
    log_settings: logs.LogSettings | None,
) -> None:
    """Initialise a worker process; it exits when its parent does, or closes `stop`."""
    global _solver, _all_ready
    end_with_parent(stop)
    _all_ready = all_ready
    if log_settings is not None:
        logs.configure(log_settings, "worker")
    os.nice(NICENESS)
    try:
        _solver = config.solver()
    except BadConfiguration as error:
        # Raised here, the error would break the executor.
        log.error("a worker cannot compute: %s", error)
        _solver = error
        return
    prewarm_kernels(_solver.sky, _solver.missions)
    gc.collect()
    gc.freeze()


def ready_pid() -> int:
    """Return the process id after all worker processes have started, so that each answers once."""
    _all_ready.wait()
    return os.getpid()


def compute(work: Work[Any, Any], task: Any) -> list[bytes]:
    """Compute a task's results, in packs; raises `BadConfiguration` without a solver."""
    if isinstance(_solver, BadConfiguration):
        raise _solver
    return packed(work(_solver, task))


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
