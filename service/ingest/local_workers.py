"""Pool of local processes that compute chunks of long work, on the standard executor.

Each process has its own missions and sky and never sees the database.  A dead child breaks a whole
executor: a new one replaces it and gets the unfinished chunks again, one at a time, so that a chunk
that kills its process can be named.

The processes are forked from the standard library's fork server, which has imported the modules
once and does nothing else: no thread, no database, no kernel.
"""

import logging
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import threading
import time
from collections import deque
from concurrent.futures import Future, InvalidStateError, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import forkserver, resource_tracker, util
from multiprocessing.connection import Connection
from typing import Any, Generic, TypeVar

from service import logs
from service.acquire.kernel_build import SIGNALS
from service.child_processes import safe_path
from service.errors import Stopping
from service.ingest import worker_process
from service.ingest.worker_process import Work, WorkerConfig, begin, compute, ready_pid

PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
"""First and longest pause in seconds before dead processes are replaced; it doubles each time."""
IDLE_S = 600.0
"""Seconds without a chunk after which the processes end, to free their memory."""
MOST_STARTS = 3
"""Maximum number of process starts for one chunk, when each process dies before receiving it."""
SERVER_RETRY_S, SERVER_GONE_S = 0.1, 10.0
"""Interval and time limit, in seconds, for new starts while the fork server is ending."""
MOST_DEATHS = 2
"""Number of processes that die with one chunk alone at work before that chunk is given up."""

log = logging.getLogger(__name__)

Input = TypeVar("Input")
Output = TypeVar("Output")


class WorkerLost(Exception):
    """Error: no worker can compute a chunk, for the reason in its message."""


class ChunkEndsWorkers(WorkerLost):
    """Error: processes died repeatedly while computing a chunk."""


@dataclass(eq=False)
class _QueuedTask(Generic[Input, Output]):
    task: Input
    done: "Future[list[Output]]" = field(default_factory=Future)
    deaths: int = 0
    """Number of processes that died while one chunk alone was at work."""
    lost_starts: int = 0
    """Number of processes that died before they were ready, while one chunk alone was at work."""


@dataclass(eq=False)
class _Processes(Generic[Input, Output]):
    """Processes of one executor, with the unfinished tasks submitted to it."""

    executor: ProcessPoolExecutor
    stop: Connection
    tasks: "set[_QueuedTask[Input, Output]]" = field(default_factory=set)
    pids: set[int] = field(default_factory=set)
    """Ids of the processes that are ready; all are, as soon as one is."""
    is_ending: bool = False
    _closing: threading.Lock = field(default_factory=threading.Lock)

    def end(self) -> None:
        """Tell the processes to exit by closing their pipe; may be repeated, from any thread."""
        with self._closing:
            self.stop.close()


class LocalWorkers(Generic[Input, Output]):
    """Pool of worker processes for one kind of work, from the first `start` to `close`."""

    def __init__(self, config: WorkerConfig, work: "Work[Input, Output]", count: int) -> None:
        """`work` must be a function of a module, so that a worker finds it by its name."""
        self._config, self._work, self.count = config, work, count
        self._lock = threading.RLock()
        self._processes: _Processes[Input, Output] | None = None
        self._one_by_one: deque[_QueuedTask[Input, Output]] = deque()
        """Chunks left unfinished by a broken executor, and those submitted since."""
        self._pause_s = PAUSE_S
        self._not_before_s = 0.0
        self._used_s = 0.0
        self._idle_check: threading.Timer | None = None
        self._closing = False

    @property
    def pids(self) -> frozenset[int]:
        """Ids of the processes that are ready to work."""
        with self._lock:
            return frozenset(self._processes.pids if self._processes else ())

    @property
    def up(self) -> int:
        """Number of processes that are ready to work."""
        processes = self._processes
        return len(processes.pids) if processes else 0

    def start(self) -> None:
        """Start the worker processes unless they are running; returns at once."""
        with self._lock:
            self._used_s = time.monotonic()
            too_soon = self._used_s < self._not_before_s
            if self._processes is None and self.count and not (self._closing or too_soon):
                try:
                    self._open()
                except OSError as error:
                    log.warning("no process that computes chunks can be started: %s", error)
                    self._pause()

    def submit(self, task: Input) -> "Future[list[Output]]":
        """Queue a task; the future gives its results, or raises `WorkerLost` or `Stopping`."""
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
        """End the processes; new ones start with the settings of that time.

        Their unfinished tasks are computed again.
        """
        with self._lock:
            processes = self._end_processes()
        if processes is not None:
            # Release the lock first: the executor's threads may wait for it.
            processes.executor.shutdown(wait=False)

    def close(self) -> None:
        """End the processes at once, even during a computation."""
        with self._lock:
            self._closing = True
            processes = self._end_processes()
            left, self._one_by_one = list(self._one_by_one), deque()
        if processes is not None:
            # Release the lock first: the executor's threads may wait for it.
            processes.executor.shutdown(cancel_futures=True)
            with self._lock:
                left += processes.tasks
        for chunk in left:
            _fail(chunk, Stopping("the service is stopping"))

    # ---- with the lock held ------------------------------------------------------------------

    def _open(self) -> "_Processes[Input, Output]":
        """Start the processes with a safe import path; raises `OSError` on failure."""
        with safe_path():
            return self._start()

    def _start(self) -> "_Processes[Input, Output]":
        context = multiprocessing.get_context("forkserver")
        context.set_forkserver_preload([worker_process.__name__])
        # Python 3.11.0 would let every local user connect to the server.
        util.abstract_sockets_supported = False  # type: ignore[misc]
        receiver, stop = context.Pipe(duplex=False)
        executor = ProcessPoolExecutor(
            self.count,
            context,
            begin,
            (self._config, receiver, context.Barrier(self.count), logs.configured()),
        )
        processes = self._processes = _Processes(executor, stop)
        ready: list[Future[int]] = []
        try:
            resource_tracker.ensure_running()  # it would unblock the signals
            # Start the processes now, and their server, unless it runs.  The server keeps the
            # signals blocked; each process unblocks them only after it ignores them.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
            try:
                forkserver.ensure_running()
                ready.extend(executor.submit(ready_pid) for _ in range(self.count))
            except BrokenProcessPool:
                # A process has died already; `_see_the_end` will notice as well.
                pass
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
            self._watch(processes)
        except (OSError, RuntimeError) as error:
            # A thread that cannot be started raises RuntimeError.
            self._end_processes()
            executor.shutdown(wait=False)
            raise OSError(f"{error}") from error
        self._check_idle_after(IDLE_S)
        for each in ready:
            each.add_done_callback(partial(self._note_ready, processes))
        return processes

    def _end_processes(self) -> "_Processes[Input, Output] | None":
        """Tell the processes to exit; returns them, since their executor must be shut down."""
        processes, self._processes = self._processes, None
        if self._idle_check is not None:
            # The timer's thread would keep this pool in memory.
            self._idle_check.cancel()
        if processes is not None:
            processes.is_ending = True
            processes.end()
        return processes

    def _watch(self, processes: "_Processes[Input, Output]") -> None:
        """Start a thread that submits unfinished tasks again after a worker process has died.

        The executor would wait for the rest of a result for as long as any process can write to the
        pipe of results.  So this process closes its own writing end, and the other workers end with
        the dead one: the executor is broken in any case.
        """
        executor = processes.executor
        executor._result_queue._writer.close()  # type: ignore[attr-defined]
        ends = [os.dup(each.sentinel) for each in executor._processes.values()]
        arguments = (processes, ends, executor._executor_manager_thread)
        threading.Thread(
            target=self._see_the_end, args=arguments, name="worker-ends", daemon=True
        ).start()

    def _hand_in(self, chunk: _QueuedTask[Input, Output]) -> None:
        """Submit a chunk to the executor; it fails if no process stays up."""
        reason = "processes died as soon as they were started"
        for _ in range(MOST_STARTS):
            try:
                processes = self._processes or self._opened()
            except OSError as error:
                reason = f"no process can be started: {error}"
                break
            try:
                future = processes.executor.submit(compute, self._work, chunk.task)
            except BrokenProcessPool:
                self._replace(processes)
                continue
            processes.tasks.add(chunk)
            future.add_done_callback(partial(self._take_result, chunk, processes))
            return
        _fail(chunk, WorkerLost(reason))
        self._go_on(chunk)

    def _opened(self) -> "_Processes[Input, Output]":
        """Start the processes, waiting until a dying fork server is gone."""
        until_s = time.monotonic() + SERVER_GONE_S
        while True:
            try:
                return self._open()
            except ConnectionError:
                # The server has died, but is not known to be dead yet.
                if time.monotonic() > until_s:
                    raise
                time.sleep(SERVER_RETRY_S)

    def _replace(self, broken: "_Processes[Input, Output]") -> None:
        if self._processes is broken:
            log.warning("a process that computed chunks has died; others are started")
            self._processes = None
            broken.end()
            broken.executor.shutdown(wait=False)

    def _pause(self) -> None:
        """Delay the next start of processes, unless a chunk needs them."""
        self._not_before_s = time.monotonic() + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    # ---- threads of the executor -------------------------------------------------------------

    def _note_ready(self, processes: "_Processes[Input, Output]", future: "Future[int]") -> None:
        if future.cancelled() or future.exception() is not None:
            return
        with self._lock:
            processes.pids.add(future.result())
            self._pause_s = PAUSE_S

    def _take_result(
        self,
        chunk: _QueuedTask[Input, Output],
        processes: "_Processes[Input, Output]",
        future: "Future[list[bytes]]",
    ) -> None:
        error = Stopping("the service is stopping") if future.cancelled() else future.exception()
        if isinstance(error, BrokenProcessPool):
            # The executor may hold a lock for which a thread that holds ours waits: leave the
            # unfinished tasks to `_see_the_end`.
            processes.end()
            return
        with self._lock:
            if processes.is_ending and not self._closing:
                # The result has outdated settings: `_see_the_end` has the chunk computed again.
                return
        if error is None:
            try:
                found = [each for pack in future.result() for each in pickle.loads(pack)]
            except Exception as unreadable:  # whatever the classes of the results raise
                error = unreadable
            else:
                with suppress(InvalidStateError):  # cancelled meanwhile
                    chunk.done.set_result(found)
        with self._lock:
            processes.tasks.discard(chunk)
        if isinstance(error, Stopping) or (error is not None and self._closing):
            _fail(chunk, Stopping("the service is stopping"))
        elif error is not None:
            _fail(chunk, WorkerLost(f"a worker failed ({error!r})"))
        self._go_on(chunk)

    # ---- a thread for each executor ----------------------------------------------------------

    def _see_the_end(
        self, processes: "_Processes[Input, Output]", ends: list[int], manager: threading.Thread
    ) -> None:
        multiprocessing.connection.wait(ends)
        for end in ends:
            os.close(end)
        processes.end()
        # The manager thread fails the unfinished tasks, and waits for the processes.
        manager.join()
        with self._lock:
            if not (processes.pids or processes.is_ending):
                # The processes died before they were ready: the next ones may die too.
                self._pause()
            self._replace(processes)
            left = [] if self._closing else list(processes.tasks)
            processes.tasks.difference_update(left)
        for chunk in left:
            self._try_again(chunk, processes)

    def _try_again(
        self, chunk: _QueuedTask[Input, Output], ended: "_Processes[Input, Output]"
    ) -> None:
        with self._lock:
            if self._closing:
                _fail(chunk, Stopping("the service is stopping"))
                return
            if not (self._one_by_one and self._one_by_one[0] is chunk):
                self._one_by_one.append(chunk)
                if len(self._one_by_one) == 1:
                    self._hand_in(chunk)
                return
            if not ended.is_ending:
                chunk.deaths += bool(ended.pids)
                chunk.lost_starts += not ended.pids
            if chunk.deaths < MOST_DEATHS and chunk.lost_starts < MOST_STARTS:
                self._hand_in(chunk)
                return
        if chunk.deaths >= MOST_DEATHS:
            _fail(chunk, ChunkEndsWorkers(f"{MOST_DEATHS} processes died over it"))
        else:
            _fail(chunk, WorkerLost("processes died as soon as they were started"))
        self._go_on(chunk)

    def _go_on(self, finished: _QueuedTask[Input, Output]) -> None:
        """Submit the next of the chunks that are computed one by one."""
        with self._lock:
            if self._one_by_one and self._one_by_one[0] is finished:
                self._one_by_one.popleft()
                if self._one_by_one and not self._closing:
                    self._hand_in(self._one_by_one[0])

    def _check_idle_after(self, seconds: float) -> None:
        self._idle_check = threading.Timer(seconds, self._check_idle, (self._processes,))
        self._idle_check.daemon = True
        self._idle_check.start()

    def _check_idle(self, processes: "_Processes[Input, Output]") -> None:
        with self._lock:
            if self._processes is not processes:
                return
            if processes.tasks:
                self._used_s = time.monotonic()
            idle_s = time.monotonic() - self._used_s
            if idle_s >= IDLE_S:
                self._end_processes()
                processes.executor.shutdown(wait=False)
            else:
                self._check_idle_after(IDLE_S - idle_s)


def _fail(chunk: _QueuedTask[Any, Any], error: Exception) -> None:
    with suppress(InvalidStateError):  # Done or cancelled before.
        chunk.done.set_exception(error)
