"""Local processes that compute chunks of long work, kept by the standard executor.

Each has missions and a sky of its own and never sees the database.  A child that dies
breaks an executor whole: another takes its place, and what was unfinished is handed
in again, one chunk at a time, so that a chunk that ends its process is known by name.
"""

import gc
import logging
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier
from pathlib import Path
from typing import Any, Generic, TypeVar

from service import logs
from service.acquire.kernel_build import SIGNALS, end_with_parent
from service.acquire.prewarm import prewarm_kernels
from service.errors import BadConfiguration, Stopping
from service.ingest.solver_pool import Solver
from service.missions.mission import Mission
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import open_catalog
from service.sky.model import SkyModel

NICENESS = 10
"""Single batches go first."""
PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
"""Before processes are started in place of some that died: twice as long each time."""
IDLE_S = 600.0
"""After so long without a chunk the processes end, and give their memory back."""
MOST_STARTS = 3
"""Of processes for one chunk, where they die before they have it."""
MOST_DEATHS = 2
"""A chunk that was alone at work when so many processes died is given up."""
PACKED_TOGETHER, MOST_BYTES = 8, 65_536
"""Results of a worker, unless they are larger than so."""

log = logging.getLogger(__name__)

Input = TypeVar("Input")
Output = TypeVar("Output")
Work = Callable[[Solver, Input], Sequence[Output]]


class WorkerLost(Exception):
    """No worker can compute a chunk; its words say why."""


class ChunkEndsWorkers(WorkerLost):
    """Processes died over a chunk again and again."""


@dataclass(frozen=True)
class WorkerConfig:
    """The settings of a worker: the same missions, catalog and cache as its parent."""

    missions: Mapping[str, Mission]
    catalog: Path | None
    catalog_digest: str
    cache_bytes: int

    def solver(self) -> Solver:
        """The worker's solver; raises `BadConfiguration` where the catalog's file has changed."""
        catalog = open_catalog(self.catalog)
        if catalog.digest != self.catalog_digest:
            raise BadConfiguration(f"catalog {self.catalog}: the file has changed since the start")
        return Solver(self.missions, SkyModel(catalog, LruCache(self.cache_bytes)))


@dataclass(eq=False)
class _QueuedTask(Generic[Input, Output]):
    task: Input
    done: "Future[list[Output]]" = field(default_factory=Future)
    deaths: int = 0
    """Processes that died while it was the only chunk at work."""


class LocalWorkers(Generic[Input, Output]):
    """Workers that do one kind of work, from the first `start` to `close`."""

    def __init__(self, config: WorkerConfig, work: "Work[Input, Output]", count: int) -> None:
        """`work` is a function of a module, so that a worker finds it by its name."""
        self._config, self._work, self.count = config, work, count
        self._lock = threading.RLock()
        self._executor: ProcessPoolExecutor | None = None
        self._stop: Connection | None = None
        self._one_by_one: deque[_QueuedTask[Input, Output]] = deque()
        """Chunks that were unfinished when an executor broke, and those that came since."""
        self._pids: set[int] = set()
        self._pause_s = PAUSE_S
        self._not_before_s = 0.0
        self._used_s = 0.0
        self._closing = False

    @property
    def pids(self) -> frozenset[int]:
        """The processes that are ready to work."""
        with self._lock:
            return frozenset(self._pids)

    @property
    def up(self) -> int:
        """How many processes are ready to work."""
        return len(self._pids)

    def start(self) -> None:
        """Have the processes started, unless they are there; returns at once."""
        with self._lock:
            self._used_s = time.monotonic()
            too_soon = self._used_s < self._not_before_s
            if self._executor is None and self.count and not (self._closing or too_soon):
                self._open()

    def submit(self, task: Input) -> "Future[list[Output]]":
        """Queue a task; the future gives what was found, or raises `WorkerLost` or `Stopping`."""
        chunk: _QueuedTask[Input, Output] = _QueuedTask(task)
        with self._lock:
            if self._closing:
                raise Stopping("the service is stopping")
            self._used_s = time.monotonic()
            if self._one_by_one:
                self._one_by_one.append(chunk)
            else:
                self._hand_in(chunk)
        return chunk.done

    def restart(self) -> None:
        """End the processes; the next ones have the settings as they are then.

        Tasks that they were at work on are computed anew.
        """
        with self._lock:
            executor = self._end_processes()
        if executor is not None:
            # Without the lock, which the executor's threads may wait for.
            executor.shutdown(wait=False)

    def close(self) -> None:
        """End the processes at once, whatever they compute."""
        with self._lock:
            self._closing = True
            executor = self._end_processes()
            waiting, self._one_by_one = self._one_by_one, deque()
        if executor is not None:
            # Without the lock, which the executor's threads may wait for.
            executor.shutdown(cancel_futures=True)
        for chunk in waiting:
            _fail(chunk, Stopping("the service is stopping"))

    # ---- with the lock held ------------------------------------------------------------------

    def _open(self) -> ProcessPoolExecutor:
        context = multiprocessing.get_context("spawn")
        there, self._stop = context.Pipe(duplex=False)
        executor = self._executor = ProcessPoolExecutor(
            self.count,
            context,
            _begin,
            (self._config, there, context.Barrier(self.count), logs.configured()),
        )
        resource_tracker.ensure_running()  # it would unblock the signals
        # The processes are started now; each hears no signal until it ignores them.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
        ready = []
        try:
            ready += [executor.submit(_ready) for _ in range(self.count)]
        except BrokenProcessPool:
            # One has died already: whoever submits next finds that out, too.
            pass
        except OSError:
            self._end_processes()
            executor.shutdown(wait=False)
            raise
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._end_all_with_the_first(executor, self._stop)
        self._check_idle_after(IDLE_S)
        # Last, since one that has died already is noted here, and its executor replaced.
        for each in ready:
            each.add_done_callback(partial(self._note_ready, executor))
        return executor

    def _end_processes(self) -> ProcessPoolExecutor | None:
        """Have the processes exit; gives their executor, which is to be shut down."""
        executor, self._executor = self._executor, None
        self._pids.clear()
        if self._stop is not None:
            # The processes see that the pipe is closed.
            self._stop.close()
            self._stop = None
        return executor

    def _end_all_with_the_first(self, executor: ProcessPoolExecutor, stop: Connection) -> None:
        """See to it that the executor notices a process that dies while it sends a result.

        The executor would wait for the rest of the result for as long as any process can write
        to the pipe of results.  So this process gives up its own writing end, and the other
        workers end with the one that died: the executor is broken anyhow.
        """
        executor._result_queue._writer.close()  # type: ignore[attr-defined]
        ends = [os.dup(each.sentinel) for each in executor._processes.values()]

        def wait_for_an_end() -> None:
            multiprocessing.connection.wait(ends)
            for end in ends:
                os.close(end)
            with self._lock:
                if self._stop is stop:
                    stop.close()
                    self._stop = None

        threading.Thread(target=wait_for_an_end, name="worker-ends", daemon=True).start()

    def _hand_in(self, chunk: _QueuedTask[Input, Output]) -> None:
        """Have a chunk computed; without processes that stay up it fails."""
        reason = "processes died as soon as they were started"
        for _ in range(MOST_STARTS):
            try:
                executor = self._executor or self._open()
            except OSError as error:
                reason = f"no process can be started: {error}"
                break
            try:
                future = executor.submit(_compute, self._work, chunk.task)
            except BrokenProcessPool:
                self._replace(executor)
                continue
            future.add_done_callback(partial(self._take_result, chunk, executor))
            return
        _fail(chunk, WorkerLost(reason))
        self._go_on(chunk)

    def _replace(self, broken: ProcessPoolExecutor) -> None:
        if self._executor is broken:
            log.warning("a process that computed chunks has died; others are started")
            self._end_processes()
            broken.shutdown(wait=False)

    # ---- threads of the executor -------------------------------------------------------------

    def _note_ready(self, executor: ProcessPoolExecutor, future: "Future[int]") -> None:
        with self._lock:
            if self._executor is not executor or future.cancelled():
                return
            if future.exception() is None:
                self._pids.add(future.result())
                self._pause_s = PAUSE_S
                return
            # It died before it was ready: the next one may, too.
            self._replace(executor)
            self._not_before_s = time.monotonic() + self._pause_s
            self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    def _take_result(
        self,
        chunk: _QueuedTask[Input, Output],
        executor: ProcessPoolExecutor,
        future: "Future[tuple[int, list[bytes]]]",
    ) -> None:
        error = Stopping("the service is stopping") if future.cancelled() else future.exception()
        if error is None:
            pid, packs = future.result()
            with suppress(Exception):
                chunk.done.set_result([each for some in packs for each in pickle.loads(some)])
            with self._lock:
                if self._executor is executor:
                    self._pids.add(pid)
        elif isinstance(error, BrokenProcessPool) and not self._closing:
            self._try_again(chunk, executor)
            return
        elif self._closing:
            _fail(chunk, Stopping("the service is stopping"))
        else:
            _fail(chunk, WorkerLost(f"a worker failed ({error!r})"))
        self._go_on(chunk)

    def _try_again(self, chunk: _QueuedTask[Input, Output], broken: ProcessPoolExecutor) -> None:
        with self._lock:
            self._replace(broken)
            if not (self._one_by_one and self._one_by_one[0] is chunk):
                self._one_by_one.append(chunk)
                if len(self._one_by_one) == 1:
                    self._hand_in(chunk)
                return
            chunk.deaths += 1
            if chunk.deaths < MOST_DEATHS:
                self._hand_in(chunk)
                return
        _fail(chunk, ChunkEndsWorkers(f"{MOST_DEATHS} processes died over it"))
        self._go_on(chunk)

    def _go_on(self, finished: _QueuedTask[Input, Output]) -> None:
        """Hand in the next of the chunks that are computed one by one."""
        with self._lock:
            if self._one_by_one and self._one_by_one[0] is finished:
                self._one_by_one.popleft()
                if self._one_by_one and not self._closing:
                    self._hand_in(self._one_by_one[0])

    def _check_idle_after(self, seconds: float) -> None:
        timer = threading.Timer(seconds, self._check_idle, (self._executor,))
        timer.daemon = True
        timer.start()

    def _check_idle(self, executor: ProcessPoolExecutor) -> None:
        with self._lock:
            if self._executor is not executor:
                return
            idle_s = time.monotonic() - self._used_s
            if idle_s >= IDLE_S:
                self._end_processes()
                executor.shutdown(wait=False)
            else:
                self._check_idle_after(IDLE_S - idle_s)


def _fail(chunk: _QueuedTask[Any, Any], error: Exception) -> None:
    if not chunk.done.done():
        chunk.done.set_exception(error)


# ---- in a worker -------------------------------------------------------------------------------

_solver: Solver | BadConfiguration
_all_ready: Barrier


def _begin(
    config: WorkerConfig,
    stop: Connection,
    all_ready: Barrier,
    log_settings: logs.LogSettings | None,
) -> None:
    global _solver, _all_ready
    end_with_parent(stop)
    _all_ready = all_ready
    if log_settings is not None:
        logs.configure(log_settings, "worker")
    os.nice(NICENESS)
    try:
        _solver = config.solver()
    except BadConfiguration as error:
        # Raised here it would break the executor.
        log.error("a worker cannot compute: %s", error)
        _solver = error
        return
    prewarm_kernels(_solver.sky, _solver.missions)
    gc.collect()
    gc.freeze()


def _ready() -> int:
    """This process; each waits for the others, so that none answers for two."""
    _all_ready.wait()
    return os.getpid()


def _compute(work: "Work[Any, Any]", task: Any) -> tuple[int, list[bytes]]:
    if isinstance(_solver, BadConfiguration):
        raise _solver
    return os.getpid(), _packed(work(_solver, task))


def _packed(found: Sequence[object]) -> list[bytes]:
    """Some together, which share their names; large ones alone: unpacking holds the lock."""
    packs = []
    for first in range(0, len(found), PACKED_TOGETHER):
        some = found[first : first + PACKED_TOGETHER]
        pack = pickle.dumps(some, pickle.HIGHEST_PROTOCOL)
        if len(pack) <= MOST_BYTES:
            packs.append(pack)
        else:
            packs += [pickle.dumps([each], pickle.HIGHEST_PROTOCOL) for each in some]
    return packs
