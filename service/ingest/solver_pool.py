"""Solver of batches and its pool of threads; kernels release the interpreter's lock."""

import logging
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, TypeVar

from service.acquire import Acquisition, acquire, acquired
from service.errors import (
    AcquisitionError,
    BadBatch,
    BeingBuilt,
    Busy,
    Fault,
    NotFound,
    Stopping,
    shown_value,
)
from service.missions.mission import Mission, mission_named
from service.observations.batch import ObservationBatch, TrackerStars
from service.observations.schema import Submission
from service.sky.cache import BUILDS_AT_ONCE
from service.sky.model import SkyModel
from service.storage.recording.identity import OwnKey, identity_of
from service.storage.recording.ids import Ulids
from service.storage.recording.unsaved_result import UnsavedResult, unsaved_submission
from service.storage.recording.writer import RETRY_AFTER_S
from service.times import Utc, utc_now

WAIT_S = 5.0
"""Longest wait of a task for a thread, in seconds; a batch takes a millisecond."""
LONG_STARS, LONG_SIGMA_ARCSEC = 60, 60.0
"""Number of stars, and sigma in arcsec, above which a batch may take seconds."""

log = logging.getLogger(__name__)

T = TypeVar("T")


class Solver:
    """Solver of batches with the service's missions and sky, usable from any thread."""

    def __init__(self, missions: Mapping[str, Mission], sky: SkyModel) -> None:
        self.missions = missions
        self.sky = sky
        self.ids = Ulids()

    def acquire(self, batch: ObservationBatch, mission: Mission | None = None) -> Acquisition:
        """Compute the acquisition of a batch, with its mission's settings or those given."""
        mission = mission or mission_in_input(self.missions, batch.spacecraft)
        return acquire(batch, mission, self.sky)

    def acquired(
        self,
        batches: Sequence[ObservationBatch],
        mission: Mission | None = None,
        *,
        at_once: bool = False,
    ) -> list[Acquisition | Exception]:
        """Compute the acquisition of each batch, or the error that prevents it.

        With `mission` all batches belong to that mission, with these settings instead of its own.
        With `at_once` a slow batch gets the error `NotAtHand`.
        """
        if mission is not None:
            return acquired(batches, mission, self.sky, at_once=at_once)
        found: dict[int, Acquisition | Exception] = {}
        together: dict[str, list[int]] = {}
        for place, batch in enumerate(batches):
            together.setdefault(batch.spacecraft, []).append(place)
        for spacecraft, places in together.items():
            try:
                own = mission_in_input(self.missions, spacecraft)
            except BadBatch as error:
                found |= dict.fromkeys(places, error)
                continue
            its_batches = [batches[place] for place in places]
            several = acquired(its_batches, own, self.sky, at_once=at_once)
            found |= dict(zip(places, several, strict=True))
        return [found[place] for place in range(len(batches))]

    def all_acquired(
        self, batches: Sequence[ObservationBatch], mission: Mission | None = None
    ) -> list[Acquisition]:
        """Compute the acquisitions of all batches, waiting if necessary; raises the first error."""
        found = []
        for each in self.acquired(batches, mission):
            if isinstance(each, Exception):
                raise each
            found.append(each)
        return found

    def asks_for_last(self, batch: ObservationBatch) -> bool:
        """True if the attitude of a batch must first be predicted from the record.

        False for an unknown spacecraft, whose batch is refused.
        """
        if batch.tracking is not None:
            return not batch.tracking.resolved
        mission = self.missions.get(batch.spacecraft)
        settings = None if mission is None else mission.tracking
        is_default = settings is not None and settings.default
        return is_default and batch.a_priori is None and batch.measurement is None

    def solve(
        self,
        submission: Submission,
        received: Utc | None = None,
        key: OwnKey | None = None,
    ) -> UnsavedResult:
        """Compute the result of a submission; raises `BadBatch` if it does not fit its mission."""
        received = received or utc_now()
        return self.unsaved(submission, self.acquire(submission.batch), received, key)

    def unsaved(
        self,
        submission: Submission,
        found: Acquisition | Exception,
        received: Utc,
        key: OwnKey | None = None,
    ) -> UnsavedResult:
        """Build the result of a submission from its acquisition, or raise the given error."""
        if isinstance(found, Exception):
            raise found
        return unsaved_submission(submission, found, id=self.ids.new(), received=received, key=key)

    def solve_many(
        self, submissions: Sequence[Submission]
    ) -> list[UnsavedResult | AcquisitionError]:
        """Compute the result of each submission, or its own error."""
        received = utc_now()
        several: Sequence[Acquisition | Exception]
        try:
            several = self.acquired([each.batch for each in submissions])
        except Busy:
            raise
        except Exception as error:
            if len(submissions) > 1:
                # Compute one by one, so that only the faulty batch is refused.
                return [one for each in submissions for one in self.solve_many([each])]
            several = [error]
        return [
            self._one_of_many(submission, found, received)
            for submission, found in zip(submissions, several, strict=True)
        ]

    def _one_of_many(
        self, submission: Submission, found: Acquisition | Exception, received: Utc
    ) -> UnsavedResult | AcquisitionError:
        try:
            return self.unsaved(submission, found, received)
        except Busy:
            # `Busy` decides nothing about the batch: the whole chunk may come again.
            raise
        except AcquisitionError as error:
            return error
        except Exception:
            # A fault of the service in one batch must not prevent the recording of others.
            identity = identity_of(submission.batch)
            run = {"run": submission.batch.run}
            log.exception("%s, run %s, batch %s failed", *identity, extra=run)
            return AcquisitionError("the fault is on the service's side; it is logged")


def mission_in_input(missions: Mapping[str, Mission], name: str) -> Mission:
    """Mission that an input names; raises `BadBatch` naming the field for an unknown one."""
    try:
        return mission_named(missions, name)
    except NotFound:
        there_are = f"there is no such spacecraft; there are {', '.join(sorted(missions))}"
        raise BadBatch(Fault("spacecraft", there_are, shown_value(name))) from None


def may_take_long(batch: ObservationBatch) -> bool:
    """True if a batch may take seconds rather than a millisecond, judged by its form."""
    return (
        (batch.a_priori is None and batch.measurement is None)
        or bool(batch.options.tolerances)
        or batch.options.identifier in ("lost_in_space", "ptp")
        or sum(_most_stars(each) for each in batch.observations) > LONG_STARS
        # NaN, for a star with the mission's sigma, is not greater.
        or any((each.sigma_arcsec > LONG_SIGMA_ARCSEC).any() for each in batch.observations)
    )


def _most_stars(stars: TrackerStars) -> int:
    """Number of stars of a tracker; for a raster, an upper bound from its lines."""
    if not stars.readings:
        return stars.count
    lines = [each for each in stars.readings if each is not None and each.kind == "lines"]
    # A star is a line brighter than its neighbours, in both directions.
    return stars.count + sum(min(len(each.h), len(each.v)) // 2 for each in lines)


class SolverTask(NamedTuple):
    """Task for a thread of the pool, with a function to call if it does not start in time."""

    work: Callable[[], object]
    refuse: Callable[[Exception], object]
    give_up_s: float
    """Deadline for the start, on the clock of `time.monotonic`."""


class FairQueue:
    """Queue of tasks that alternates between clients and spacecraft."""

    def __init__(self) -> None:
        self._tasks: OrderedDict[Hashable, deque[SolverTask]] = OrderedDict()

    def __bool__(self) -> bool:
        return bool(self._tasks)

    def put(self, client: Hashable, task: SolverTask) -> None:
        """Add a task of a client to the queue."""
        self._tasks.setdefault(client, deque()).append(task)

    def get(self) -> SolverTask:
        """Take the next task; its client comes again after all others."""
        client, tasks = self._tasks.popitem(last=False)
        task = tasks.popleft()
        if tasks:
            self._tasks[client] = tasks
        return task


class SolverPool:
    """Pool of threads that compute; long tasks leave one thread to short ones.

    A task that raises `BeingBuilt` frees its thread, and starts again when the table is built.
    """

    def __init__(self, threads: int | None = None) -> None:
        """Start at least two threads, by default one for each processor."""
        count = max(2, threads or os.cpu_count() or 1)
        self._short, self._long = FairQueue(), FairQueue()
        self._long_slots = count - 1
        self._changed = threading.Condition()
        self._closing = False
        self.builder = ThreadPoolExecutor(BUILDS_AT_ONCE, "sky")
        """Pool of threads that build the tables for which tasks wait."""
        self._threads = [
            threading.Thread(target=self._run, name=f"solver-{number}", daemon=True)
            for number in range(count)
        ]
        for thread in self._threads:
            thread.start()

    def put(self, task: SolverTask, client: Hashable, *, is_long: bool) -> None:
        """Queue a task for the pool; raises `Stopping` after `close`."""
        with self._changed:
            if self._closing:
                raise Stopping("the service is stopping")
            (self._long if is_long else self._short).put(client, task)
            self._changed.notify()

    def call(self, work: Callable[[], T], client: Hashable, *, is_long: bool) -> T:
        """Run a function in a thread of the pool and wait for its result or error."""
        done: Future[T] = Future()

        def run() -> None:
            try:
                done.set_result(work())
            except BeingBuilt:
                raise
            except BaseException as error:
                done.set_exception(error)

        task = SolverTask(run, done.set_exception, time.monotonic() + WAIT_S)
        self.put(task, client, is_long=is_long)
        return done.result()

    def close(self) -> None:
        """Finish short tasks and those begun, refuse the others, and end the threads."""
        with self._changed:
            self._closing = True
            refused = []
            while self._long:
                refused.append(self._long.get())
            self._changed.notify_all()
        for task in refused:
            task.refuse(Stopping("the service is stopping"))
        for thread in self._threads:
            thread.join()
        self.builder.shutdown(wait=False, cancel_futures=True)

    def _run(self) -> None:
        while (taken := self._next()) is not None:
            task, is_long = taken
            try:
                if time.monotonic() > task.give_up_s:
                    task.refuse(Busy("every processor is at work on other batches", RETRY_AFTER_S))
                else:
                    task.work()
            except BeingBuilt as waits:
                waits.done.add_done_callback(partial(self._put_again, task, is_long))
            except Exception:
                log.exception("a task failed")
            finally:
                if is_long:
                    with self._changed:
                        self._long_slots += 1

    def _put_again(self, task: SolverTask, is_long: bool, built: "Future[Any]") -> None:
        """Queue a task again after its table is built, or fail it if the build failed."""
        error = built.exception()
        if isinstance(error, Exception):
            task.refuse(error)
            return
        task = task._replace(give_up_s=time.monotonic() + WAIT_S)
        try:
            self.put(task, "built", is_long=is_long)
        except Stopping as stopping:
            task.refuse(stopping)

    def _next(self) -> tuple[SolverTask, bool] | None:
        """Next task, and True if it is long; None when no more will come."""
        with self._changed:
            while True:
                if self._short:
                    return self._short.get(), False
                if self._long and self._long_slots:
                    self._long_slots -= 1
                    return self._long.get(), True
                if self._closing:
                    return None
                self._changed.wait()
