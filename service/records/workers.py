"""Processes that compute: each has missions and a sky of its own, and never sees the database.

A thread of this process stands beside each worker: hands it a task, waits, and
unpacks what comes back.  A worker that dies costs its task and is replaced; one
that has had nothing to do for long gives its memory back, until it is wanted.
"""

import atexit
import gc
import logging
import multiprocessing
import os
import pickle
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing import connection, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import Any, Generic, TypeVar

from service import logs
from service.errors import BadConfiguration, Stopping
from service.missions.mission import Mission
from service.records.bench import Bench
from service.sky.catalog import open_catalog
from service.sky.shelf import Shelf
from service.sky.view import Sky
from service.warm import warm_up

NICENESS = 10
"""Whoever waits for one answer goes first."""
PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0
"""Before a worker is started in place of one that died before it was ready: twice as long each."""
IDLE_S = 600.0
PACKED_TOGETHER, MOST_BYTES = 8, 65_536
"""Finds of a worker, unless they are larger than so."""

_CONTEXT = multiprocessing.get_context("spawn")
_SIGNALS = (signal.SIGINT, signal.SIGTERM)

log = logging.getLogger(__name__)

Task = TypeVar("Task")
Found = TypeVar("Found")
Work = Callable[[Bench, Task], Sequence[Found]]


class WorkerLost(Exception):
    """The worker died over a task, or there is none: nothing came of it."""


@dataclass(frozen=True)
class Equipment:
    """What a worker's bench is made of: the same as of the process that starts it."""

    missions: Mapping[str, Mission]
    catalog: Path | None
    catalog_digest: str
    shelf_bytes: int

    def bench(self) -> Bench:
        """The bench; raises `BadConfiguration` where the catalog's file is another by now."""
        catalog = open_catalog(self.catalog)
        if catalog.digest != self.catalog_digest:
            raise BadConfiguration(f"catalog {self.catalog}: the file has changed since the start")
        return Bench(self.missions, Sky(catalog, Shelf(self.shelf_bytes)))


@dataclass(eq=False)
class _Order(Generic[Task, Found]):
    task: Task
    done: "Future[list[Found]]" = field(default_factory=Future)


class Workers(Generic[Task, Found]):
    """Workers that do one kind of work, from the first `start` to `close`."""

    def __init__(self, equipment: Equipment, work: "Work[Task, Found]", count: int) -> None:
        """`work` is a function of a module, so that a worker finds it by its name."""
        self._equipment, self._work, self.count = equipment, work, count
        self._orders: deque[_Order[Task, Found]] = deque()
        self._changed = threading.Condition()
        self._processes: dict[int, SpawnProcess] = {}
        self._up: set[int] = set()
        self._wanted = 0
        """Rises with every call of `start`."""
        self._closing = False
        self._threads: list[threading.Thread] = []

    @property
    def up(self) -> int:
        """How many are ready to work."""
        return len(self._up)

    def start(self) -> None:
        """Have the workers started, unless they are there; returns at once."""
        with self._changed:
            self._wanted += 1
            if self._closing or len(self._up) == self.count:
                return
            self._changed.notify_all()
            if self._threads:
                return
            atexit.register(self.close)
            self._threads = [
                threading.Thread(
                    target=self._stand_beside, args=(place,), name=f"worker-{place}", daemon=True
                )
                for place in range(self.count)
            ]
            for thread in self._threads:
                thread.start()

    def submit(self, task: Task) -> "Future[list[Found]]":
        """Queue a task; the future gives what was found, or raises `WorkerLost` or `Stopping`."""
        order: _Order[Task, Found] = _Order(task)
        with self._changed:
            if self._closing:
                raise Stopping("the service is stopping")
            self._orders.append(order)
            # One alone might be a thread that waits until it may start a worker again.
            self._changed.notify_all()
        return order.done

    def close(self) -> None:
        """End the workers at once, whatever they are at."""
        with self._changed:
            self._closing = True
            for process in self._processes.values():
                process.kill()
            self._changed.notify_all()
        for thread in self._threads:
            thread.join()
        self._fail_waiting(Stopping("the service is stopping"))
        atexit.unregister(self.close)

    def _stand_beside(self, place: int) -> None:
        """Keep one worker at work, and start another where it dies."""
        pause_s = PAUSE_S
        while not self._closing:
            started = time.monotonic()
            try:
                with self._worker(place) as line:
                    pause_s = PAUSE_S
                    calls = self._keep_busy(line)
                self._rest(calls)
                continue
            except BadConfiguration as error:
                log.error("no worker can be started: %s", error)
                pause_s = LONGEST_PAUSE_S
            except Exception as error:
                # Whatever ended it, the next one may do better; who waited for it was told.
                if not self._closing:
                    seconds = time.monotonic() - started
                    log.warning("a worker ended after %.0f s (%r)", seconds, error)
            if not self._up:
                # Whoever waits has other means.
                self._fail_waiting(WorkerLost("there is no worker"))
            with self._changed:
                self._changed.wait_for(lambda: self._closing, pause_s)
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)

    def _rest(self, calls: int) -> None:
        """Wait until a worker is wanted again."""
        with self._changed:
            self._changed.wait_for(lambda: self._closing or self._orders or self._wanted != calls)

    @contextmanager
    def _worker(self, place: int) -> Iterator[Connection]:
        """A worker that is ready; it is gone at the end."""
        here, there = _CONTEXT.Pipe()
        with here:
            process = _CONTEXT.Process(
                target=_serve,
                args=(there, self._equipment, self._work, logs.configured()),
                daemon=True,
            )
            with there, self._changed:
                if self._closing:
                    raise EOFError
                _start(process)
                self._processes[place] = process
            try:
                refusal = here.recv()
                if refusal is not None:
                    raise refusal
                self._up.add(place)
                yield here
            finally:
                self._up.discard(place)
                with self._changed:
                    del self._processes[place]
                process.kill()
                process.join()

    def _keep_busy(self, line: Connection) -> int:
        """Hand tasks on while there are some; how often workers were wanted until then.

        Raises what a line raises that has broken.
        """
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._orders or self._closing, IDLE_S)
                if self._closing or not self._orders:
                    return self._wanted
                order = self._orders.popleft()
            if not order.done.set_running_or_notify_cancel():
                continue
            try:
                line.send(order.task)
                found = [each for some in line.recv() for each in pickle.loads(some)]
            except Exception as error:
                # Whoever waits is told in any case; then the worker is given up.
                order.done.set_exception(WorkerLost(f"a worker died ({error!r})"))
                raise
            order.done.set_result(found)

    def _fail_waiting(self, error: Exception) -> None:
        with self._changed:
            waiting = [*self._orders]
            self._orders.clear()
        for order in waiting:
            if order.done.set_running_or_notify_cancel():
                order.done.set_exception(error)


def _start(process: SpawnProcess) -> None:
    """Start a process that hears no signal until it says how it takes them."""
    resource_tracker.ensure_running()  # which would lift the mask
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        process.start()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


# ---- in the worker -----------------------------------------------------------------------------


def _serve(
    line: Connection,
    equipment: Equipment,
    work: "Work[Any, Any]",
    log_settings: logs.LogSettings | None,
) -> None:
    if log_settings is not None:
        logs.configure(log_settings, "worker")
    # Whoever stops the whole group stops the process that started this one, which ends it.
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.nice(NICENESS)
    try:
        bench = equipment.bench()
    except BadConfiguration as error:
        line.send(error)
        return
    warm_up(bench.sky, bench.missions)
    gc.collect()
    gc.freeze()
    with suppress(EOFError, OSError):
        line.send(None)
        while True:
            task = line.recv()
            line.send(_packed(work(bench, task)))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    connection.wait([parent.sentinel])
    os._exit(1)


def _packed(found: Sequence[object]) -> list[bytes]:
    """A few together, which share their names; large ones alone, for unpacking holds up others."""
    packs = []
    for first in range(0, len(found), PACKED_TOGETHER):
        some = found[first : first + PACKED_TOGETHER]
        pack = pickle.dumps(some, pickle.HIGHEST_PROTOCOL)
        if len(pack) <= MOST_BYTES:
            packs.append(pack)
        else:
            packs += [pickle.dumps([each], pickle.HIGHEST_PROTOCOL) for each in some]
    return packs
