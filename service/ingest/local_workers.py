"""Pool of local processes that compute chunks of long work.

Each has missions and a sky of its own and never sees the database.  It has a connection of its
own, over which it computes chunks in the order in which they come: the chunk that a process died
over is known, and costs no other.  One thread hands out chunks, takes results, and replaces the
processes that died.

The processes are forked from the standard library's fork server, which has imported the
modules once and does nothing else: no thread, no database, no kernel.
"""

import atexit
import logging
import multiprocessing
import pickle
import signal
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import forkserver, resource_tracker, util
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from typing import Any, Generic, TypeVar

from service import logs
from service.acquire.kernel_build import SIGNALS
from service.child_processes import safe_path
from service.errors import Stopping
from service.ingest import worker_process
from service.ingest.worker_process import Work, WorkerConfig, serve

PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
"""First and longest pause in seconds after early deaths of processes; it doubles each time."""
IDLE_S = 600.0
"""Seconds without a chunk after which the processes end, to free their memory."""
MOST_STARTS = 3
"""Number of processes in a row that die before they are ready until waiting chunks fail."""
SERVER_RETRY_S, SERVER_GONE_S = 0.1, 10.0
"""Interval and time limit, in seconds, for new starts while the fork server is ending."""
MOST_DEATHS = 3
"""Number of processes that die while they compute one chunk before it is given up."""
AT_HAND = 2
"""Number of chunks sent to a process: the one that it computes, and the next."""

log = logging.getLogger(__name__)

Input = TypeVar("Input")
Output = TypeVar("Output")


class WorkerLost(Exception):
    """Error: no worker can compute a chunk, for the reason in its message."""


class ChunkEndsWorkers(WorkerLost):
    """Error: processes died repeatedly while computing a chunk."""


@dataclass(eq=False)
class _Chunk:
    """Chunk as it is sent, with the future of its results; `deaths` counts processes it ended."""

    content: bytes
    done: "Future[list[Any]]" = field(default_factory=Future)
    deaths: int = 0

    def fail(self, error: Exception) -> None:
        with suppress(InvalidStateError):  # cancelled meanwhile
            self.done.set_exception(error)

    def take(self, answer: bytes) -> None:
        """Set the future from a worker's answer: packs of results, or a reason in words."""
        try:
            packs = pickle.loads(answer)
            if isinstance(packs, str):
                raise WorkerLost(f"a worker failed ({packs})")
            found = [each for pack in packs for each in pickle.loads(pack)]
        except WorkerLost as error:
            self.fail(error)
        except Exception as error:  # whatever the classes of the results raise
            self.fail(WorkerLost(f"a worker's result cannot be read ({error!r})"))
        else:
            with suppress(InvalidStateError):
                self.done.set_result(found)


@dataclass(eq=False)
class _Worker:
    """Worker process with its connection and the chunks it has not answered, oldest first."""

    process: ForkServerProcess
    connection: Connection
    chunks: deque[_Chunk] = field(default_factory=deque)
    is_ready: bool = False

    def end(self) -> None:
        """Kill the process and wait until it has ended."""
        self.process.kill()
        # A process whose server died counts as ended: it exits when its connection closes.
        self.connection.close()
        self.process.join()


class LocalWorkers(Generic[Input, Output]):
    """Pool of worker processes for one kind of work, from the first `start` to `close`."""

    def __init__(self, config: WorkerConfig, work: "Work[Input, Output]", count: int) -> None:
        """Prepare a pool without processes; a worker finds the function `work` by its name."""
        self._config, self._work, self.count = config, work, count
        self._lock = threading.Lock()
        self._workers: list[_Worker] = []
        self._dismissed: list[_Worker] = []
        """Workers whose answers are ignored; the thread ends them."""
        self._waiting: deque[_Chunk] = deque()
        self._thread: threading.Thread | None = None
        self._wake: Connection | None = None
        self._is_woken = False
        self._are_wanted = False
        self._closing = False
        self._early_deaths = 0
        """Number of processes that died early since one last became ready."""
        self._pause_s = PAUSE_S
        self._not_before_s = 0.0
        self._used_s = 0.0

    @property
    def pids(self) -> frozenset[int]:
        """Ids of the processes that are ready to work."""
        with self._lock:
            return frozenset(each.process.pid or 0 for each in self._workers if each.is_ready)

    @property
    def up(self) -> int:
        """Number of processes that are ready to work."""
        return len(self.pids)

    def start(self) -> None:
        """Start the worker processes unless they are running; returns at once."""
        with self._lock:
            self._used_s = time.monotonic()
            if self._used_s >= self._not_before_s and len(self._workers) < self.count:
                self._are_wanted = True
                self._wake_thread()

    def submit(self, task: Input) -> "Future[list[Output]]":
        """Queue a task; the future gives its results, or raises `WorkerLost` or `Stopping`."""
        chunk = _Chunk(pickle.dumps(task, pickle.HIGHEST_PROTOCOL))
        with self._lock:
            if self._closing:
                raise Stopping("the service is stopping")
            self._used_s = time.monotonic()
            self._waiting.append(chunk)
            self._wake_thread()
        return chunk.done

    def restart(self) -> None:
        """End the processes; new ones start with the settings of that time.

        Their unfinished tasks are computed again.
        """
        with self._lock:
            self._dismiss()

    def close(self) -> None:
        """End the processes at once, even during a computation."""
        with self._lock:
            self._closing = True
            self._dismiss()
            left, self._waiting = self._waiting, deque()
        if self._thread is not None:
            self._thread.join()
            atexit.unregister(self.close)
        for chunk in left:
            chunk.fail(Stopping("the service is stopping"))

    # ---- with the lock held ------------------------------------------------------------------

    def _wake_thread(self) -> None:
        """Wake the supervising thread, or start it if there is work for it."""
        if self._wake is not None:
            if not self._is_woken:
                self._is_woken = True
                self._wake.send_bytes(b"")
        elif self.count and not self._closing and (self._waiting or self._are_wanted):
            woken, wake = multiprocessing.Pipe(duplex=False)
            thread = threading.Thread(
                target=self._supervise, args=(woken, wake), name="worker-supervisor", daemon=True
            )
            try:
                thread.start()
            except RuntimeError as error:
                log.warning("no process that computes chunks can be started: %s", error)
                self._fail_waiting(f"no process can be started: {error}")
            else:
                self._thread, self._wake = thread, wake
                # The standard library waits at exit for processes that it cannot stop.
                atexit.register(self.close)

    def _dismiss(self) -> None:
        """Kill the workers and put their chunks back into the queue."""
        for worker in reversed(self._workers):
            worker.process.kill()
            self._waiting.extendleft(reversed(worker.chunks))
        self._dismissed += self._workers
        self._workers.clear()
        self._wake_thread()

    def _fail_waiting(self, reason: str) -> None:
        while self._waiting:
            self._waiting.popleft().fail(WorkerLost(reason))

    def _pause(self) -> None:
        """Delay starts of processes, unless chunks wait and none runs; each delay is doubled."""
        self._not_before_s = time.monotonic() + self._pause_s
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)

    # ---- the thread --------------------------------------------------------------------------

    def _supervise(self, woken: Connection, wake: Connection) -> None:
        while not self._closing:
            if self._need_more:
                self._start_missing()
            self._hand_out()
            with self._lock:
                workers = [*self._workers]
            ends = [woken, *(each.connection for each in workers)]
            sentinels = [each.process.sentinel for each in workers]
            ready = wait([*ends, *sentinels], IDLE_S)
            if woken in ready:
                with self._lock:
                    woken.recv_bytes()
                    self._is_woken = False
            for worker in workers:
                if worker.connection in ready or worker.process.sentinel in ready:
                    self._listen(worker)
            self._dismiss_idle()
            self._end_dismissed()
        self._end_dismissed()
        with self._lock:
            # No other thread can wake this one any more.
            self._is_woken = True
            woken.close()
            wake.close()

    @property
    def _need_more(self) -> bool:
        with self._lock:
            if len(self._workers) >= self.count:
                return False
            if not self._waiting:
                return self._are_wanted
            return not self._workers or time.monotonic() >= self._not_before_s

    def _start_missing(self) -> None:
        with self._lock:
            self._are_wanted = False
            missing = self.count - len(self._workers)
        try:
            for _ in range(missing):
                worker = self._started()
                with self._lock:
                    (self._dismissed if self._closing else self._workers).append(worker)
                    if self._closing:
                        return
        except (OSError, RuntimeError) as error:
            log.warning("no process that computes chunks can be started: %s", error)
            with self._lock:
                self._pause()
                if not self._workers:
                    self._fail_waiting(f"no process can be started: {error}")

    def _started(self) -> _Worker:
        """Start a process; retries while a fork server that died is not known to have ended."""
        until_s = time.monotonic() + SERVER_GONE_S
        while True:
            try:
                return _start(self._config, self._work)
            except (ConnectionError, EOFError) as error:
                # The server has died, and is not known to have done so yet.
                if time.monotonic() > until_s or self._closing:
                    raise OSError(f"the server of the workers has ended: {error}") from error
                time.sleep(SERVER_RETRY_S)

    def _hand_out(self) -> None:
        """Send waiting chunks to the ready processes with the fewest chunks."""
        while True:
            with self._lock:
                ready = [
                    each for each in self._workers if each.is_ready and len(each.chunks) < AT_HAND
                ]
                if not (ready and self._waiting):
                    return
                chunk = self._waiting.popleft()
                if chunk.done.cancelled():
                    continue
                worker = min(ready, key=lambda each: len(each.chunks))
                worker.chunks.append(chunk)
            # Without the lock, for as long as the process takes to read it.
            with suppress(OSError):  # one that has died is heard of by its end
                worker.connection.send_bytes(chunk.content)

    def _listen(self, worker: _Worker) -> None:
        """Read the answers of a worker, and note its end if it has died."""
        try:
            while worker.connection.poll():
                answer = worker.connection.recv_bytes()
                self._take(worker, answer)
        except (EOFError, OSError):
            self._see_to_death(worker)
            return
        if not worker.process.is_alive():
            self._see_to_death(worker)

    def _take(self, worker: _Worker, answer: bytes) -> None:
        with self._lock:
            if worker not in self._workers:
                # It has the settings of before.
                return
            if not worker.is_ready:
                worker.is_ready = True
                self._early_deaths, self._pause_s = 0, PAUSE_S
                return
            chunk = worker.chunks.popleft()
        # It goes on with the next, and gets one after that, while this one is unpacked.
        self._hand_out()
        chunk.take(answer)

    def _see_to_death(self, worker: _Worker) -> None:
        with self._lock:
            if worker not in self._workers:
                return
            self._workers.remove(worker)
            log.warning("a process that computed chunks has died; others are started")
            if worker.is_ready:
                if worker.chunks:
                    worker.chunks[0].deaths += 1
            else:
                self._early_deaths += 1
                self._pause()
            self._waiting.extendleft(reversed(worker.chunks))
            first = self._waiting[0] if worker.chunks else None
            if first is not None and first.deaths >= MOST_DEATHS:
                self._waiting.popleft()
                first.fail(ChunkEndsWorkers(f"{MOST_DEATHS} processes died over it"))
            if self._early_deaths >= MOST_STARTS and not self._workers:
                self._early_deaths = 0
                self._fail_waiting("processes died as soon as they were started")
        worker.end()

    def _dismiss_idle(self) -> None:
        with self._lock:
            if self._waiting or any(each.chunks for each in self._workers):
                self._used_s = time.monotonic()
            if self._workers and time.monotonic() - self._used_s >= IDLE_S:
                self._dismiss()

    def _end_dismissed(self) -> None:
        with self._lock:
            dismissed, self._dismissed = self._dismissed, []
        for worker in dismissed:
            worker.end()


def _start(config: WorkerConfig, work: Callable[..., Any]) -> _Worker:
    """Start a worker process; raises `OSError` or `EOFError` on failure."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([worker_process.__name__])
    # Python 3.11.0 would have the server listen where every local user can connect.
    # The types of the standard library call it final.
    util.abstract_sockets_supported = False  # type: ignore[misc]
    own, other = context.Pipe()
    process = context.Process(
        target=serve, args=(config, work, other, logs.configured()), daemon=True
    )
    try:
        with safe_path():
            resource_tracker.ensure_running()  # it would unblock the signals
            # The server is started too, unless it runs.  It keeps the signals blocked; each
            # process hears none until it ignores them.
            before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
            try:
                forkserver.ensure_running()
                process.start()
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
    except BaseException:
        own.close()
        raise
    finally:
        # The process alone holds this end: its death closes the connection.
        other.close()
    return _Worker(process, own)
