"""The queue of submissions: looked up, solved and recorded in groups by one thread.

    submit ──► writer's thread: look up, solve, record in one transaction ──► futures
                      │ those that take long ──► solver pool ──┘

The thread takes whatever waits, so that look-ups and commits are shared under load and
nothing waits for a timer.  A batch that takes long goes to a thread of the pool, and delays
no other.  A repeat of a batch that is being computed waits for it and is then looked up.
"""

import asyncio
import heapq
import logging
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Generic, TypeVar

from sqlalchemy import Connection

from service.errors import BeingBuilt, Busy, Stopping
from service.ingest.solver_pool import WAIT_S, SolverPool, SolverTask
from service.observations.schema import Submission
from service.sky.cache import NotAtHand
from service.storage.recording.identity import Identity, OwnKey, PredictionOutdated
from service.storage.recording.unsaved_result import Answered, UnsavedResult
from service.storage.recording.writer import (
    RETRY_AFTER_S,
    QueuedJob,
    WriteOutcome,
    WriteOutcomes,
    Writer,
    WriterState,
)
from service.times import Utc, utc_now

MAX_WAITING = 2_000
DRAIN_S = 8.0
"""The longest wait for submissions to be answered when the service stops."""

Found = Answered | Exception | Callable[[Connection], Answered] | None
"""The outcome of a look-up: answer, error, a change that gives the answer, or nothing."""

log = logging.getLogger(__name__)


@dataclass(eq=False, slots=True)
class PendingBatch:
    """A submission that waits for its answer, which is set on `future`.

    `make` gives the submission, which of a frame takes long; what it is called and the
    fingerprint of its body are known before that.  `client` is the client and spacecraft between
    whose batches the pool shares its threads.
    """

    identity: Identity
    fingerprint: str
    key: OwnKey | None
    make: Callable[[], Submission]
    client: Hashable
    is_long: bool
    future: "asyncio.Future[Answered] | Future[Answered]" = field(default_factory=Future)
    wait_s: float = WAIT_S
    sequence: Hashable | None = None
    """Batches of one sequence are computed one after another, each when the last is recorded."""
    time_ns: int = 0
    """The order of those of a sequence that wait together."""
    received: Utc = field(default_factory=utc_now)
    since_s: float = field(default_factory=time.monotonic)
    unsaved: UnsavedResult | None = None
    """The result, once a thread has computed it."""


@dataclass(frozen=True)
class QueueState:
    """How many submissions wait for their answers, and the age of the oldest."""

    queued: int
    oldest_s: float


@dataclass(frozen=True)
class Backlog:
    """The queue of submitted batches, and that of the writer."""

    posts: QueueState
    writes: WriterState


class IngestQueue:
    """Takes submissions from any thread."""

    def __init__(
        self,
        look_up: Callable[[Sequence[PendingBatch]], Sequence[Found]],
        solve: Callable[[PendingBatch], UnsavedResult],
        solve_together: Callable[[Sequence[PendingBatch]], Sequence[UnsavedResult | Exception]],
        recorded: Callable[[UnsavedResult, WriteOutcome], object],
        writer: Writer,
        pool: SolverPool,
    ) -> None:
        """`look_up` answers what is recorded; `recorded` is called with each outcome of a write.

        `solve_together` gives the error where a batch has no result, `NotAtHand` of one that takes
        long.
        """
        self._look_up, self._note_outcome = look_up, recorded
        self._solve, self._solve_together = solve, solve_together
        self._writer, self._pool = writer, pool
        self._lock = threading.Lock()
        self._in_flight: dict[Identity, list[PendingBatch]] = {}
        """The batches that are being computed or recorded, each with its repeats."""
        self._sequences: Sequences[PendingBatch] = Sequences()
        self._unanswered: dict[PendingBatch, None] = {}
        self._written: list[tuple[PendingBatch, WriteOutcome]] = []
        self._closing = False
        self._empty = threading.Event()
        self._empty.set()
        writer.solve_posts = self._begin
        writer.after_jobs.append(self._answer_written)

    def put(self, pending: PendingBatch) -> None:
        """Queue a submission; raises `Busy` where too many wait, `Stopping` after `close`."""
        with self._lock:
            if self._closing:
                raise Stopping("the service is stopping")
            if len(self._unanswered) >= MAX_WAITING:
                message = f"{MAX_WAITING} batches are waiting to be worked on"
                raise Busy(message, RETRY_AFTER_S)
            self._unanswered[pending] = None
            self._empty.clear()
        self._queue(pending)

    def state(self) -> QueueState:
        """The submissions that wait for their answers."""
        with self._lock:
            oldest = next(iter(self._unanswered), None)
            age_s = 0.0 if oldest is None else time.monotonic() - oldest.since_s
            return QueueState(len(self._unanswered), age_s)

    def wait_until_empty(self, seconds: float) -> None:
        """Wait until every submission is answered, at most `seconds`."""
        self._empty.wait(seconds)

    def close(self) -> None:
        """Refuse new submissions, and answer those that wait."""
        with self._lock:
            self._closing = True
        self._empty.wait(DRAIN_S)
        with self._lock:
            left = list(self._unanswered)
        self._answer([(each, Stopping("the service is stopping")) for each in left])

    def _queue(self, pending: PendingBatch) -> None:
        try:
            self._writer.put(QueuedJob(partial(self._note_written, pending), pending=pending))
        except Busy as error:
            self._answer([(pending, error)])

    # ---- the writer's thread, before a transaction --------------------------------------------

    def _begin(self, jobs: Sequence[QueuedJob]) -> list[QueuedJob]:
        """Answer recorded and expired submissions; compute the others, each once."""
        now_s = time.monotonic()
        late = [job.pending for job in jobs if now_s - job.pending.since_s > job.pending.wait_s]
        for pending in late:
            error = Busy(f"it has waited {pending.wait_s:g} s for its turn", RETRY_AFTER_S)
            self._answer([(pending, error)])
        jobs = [job for job in jobs if job.pending not in late]
        if not jobs:
            return []
        found: Sequence[Found]
        try:
            found = self._look_up([job.pending for job in jobs])
        except Exception as error:
            # Each client gets the error: nothing is decided about its batch.
            found = [error] * len(jobs)
        known, to_write = [], []
        for job, each in zip(jobs, found, strict=True):
            if isinstance(each, Answered | Exception):
                known.append((job.pending, each))
            else:
                job.change = each
                to_write.append(job)
        self._answer(known)
        self._compute([job for job in to_write if job.change is None and self._is_for_now(job)])
        return [job for job in to_write if job.change is not None or job.unsaved_results]

    def _is_for_now(self, job: QueuedJob) -> bool:
        """True if a batch is to be computed now; False if later, or if one like it is already."""
        pending: PendingBatch = job.pending
        with self._lock:
            repeats = self._in_flight.get(pending.identity)
            if repeats is not None:
                repeats.append(pending)
                return False
            self._in_flight[pending.identity] = []
            sequence = pending.sequence
            if sequence is not None and not self._sequences.enter(
                sequence, pending.time_ns, pending
            ):
                return False
        if pending.is_long or sequence is not None:
            self._start(pending)
            return False
        return True

    def _compute(self, jobs: Sequence[QueuedJob]) -> None:
        """Compute batches together; those that take long go to the pool."""
        several: Sequence[UnsavedResult | Exception]
        try:
            several = self._solve_together([job.pending for job in jobs])
        except Exception as error:
            log.exception("batches that waited together failed")
            several = [error] * len(jobs)
        for job, found in zip(jobs, several, strict=True):
            pending: PendingBatch = job.pending
            if isinstance(found, NotAtHand):
                self._start(pending)
            elif isinstance(found, Exception):
                # It concerns this batch alone, and its client gets it.
                self._finish([(pending, found)])
            else:
                pending.unsaved = found
                job.unsaved_results = [found]
                # Only from now on does it wait to be written.
                job.since_s = time.monotonic()

    def _start(self, pending: PendingBatch) -> None:
        """Queue a batch for the pool."""
        task = SolverTask(
            partial(self._solve_and_record, pending),
            lambda error: self._finish([(pending, error)]),
            pending.since_s + pending.wait_s,
        )
        try:
            self._pool.put(task, pending.client, is_long=pending.is_long)
        except Stopping as error:
            self._finish([(pending, error)])

    # ---- a thread of the pool ----------------------------------------------------------------

    def _solve_and_record(self, pending: PendingBatch) -> None:
        try:
            pending.unsaved = self._solve(pending)
            settle = partial(self._note_written, pending)
            self._writer.put(QueuedJob(settle, [pending.unsaved]))
        except BeingBuilt:
            raise  # the pool tries again
        except Exception as error:
            self._finish([(pending, error)])

    # ---- the writer's thread, after a transaction ---------------------------------------------

    def _note_written(
        self, pending: PendingBatch, outcome: WriteOutcomes | Answered | Exception
    ) -> None:
        one = outcome[0] if isinstance(outcome, list) else outcome
        if pending.unsaved is not None:
            self._note_outcome(pending.unsaved, one)
        self._written.append((pending, one))

    def _answer_written(self) -> None:
        written, self._written = self._written, []
        for pending, outcome in written:
            if isinstance(outcome, PredictionOutdated):
                # Until its time is over it is computed from the attitude that is the last one now.
                self._start(pending)
        done = [each for each in written if not isinstance(each[1], PredictionOutdated)]
        if done:
            self._finish(done)

    # ---- answers -----------------------------------------------------------------------------

    def _finish(self, outcomes: Sequence[tuple[PendingBatch, WriteOutcome]]) -> None:
        """Answer what was computed; its repeats are looked up, for it may have failed."""
        with self._lock:
            repeats = [each for p, _ in outcomes for each in self._in_flight.pop(p.identity, ())]
            ended = [p.sequence for p, _ in outcomes if p.sequence is not None]
            following = [each for key in ended if (each := self._sequences.leave(key)) is not None]
        self._answer(outcomes)
        for each in repeats:
            self._queue(each)
        for each in following:
            self._start(each)

    def _answer(self, outcomes: Sequence[tuple[PendingBatch, WriteOutcome]]) -> None:
        by_loop: dict[asyncio.AbstractEventLoop, list[tuple[PendingBatch, WriteOutcome]]] = {}
        with self._lock:
            for pending, _ in outcomes:
                self._unanswered.pop(pending, None)
            if not self._unanswered:
                self._empty.set()
        for pending, outcome in outcomes:
            if isinstance(pending.future, Future):
                _set_futures([(pending, outcome)])
            else:
                by_loop.setdefault(pending.future.get_loop(), []).append((pending, outcome))
        for loop, group in by_loop.items():
            # The loop may be closed: then no client waits for these answers.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(_set_futures, group)


def _set_futures(outcomes: Sequence[tuple[PendingBatch, WriteOutcome]]) -> None:
    for pending, outcome in outcomes:
        if pending.future.done():
            continue  # the client has gone
        if isinstance(outcome, Exception):
            pending.future.set_exception(outcome)
        else:
            pending.future.set_result(outcome)


T = TypeVar("T")


class Sequences(Generic[T]):
    """The batches of one key that wait while another of it is at work.  The caller holds a lock."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, list[tuple[int, int, T]]] = {}
        """By key that has one at work: the time of a waiting batch, a number, the batch."""
        self._numbers = count()

    def enter(self, key: Hashable, time_ns: int, item: T) -> bool:
        """True if it may begin; if not, `leave` gives it when its turn has come."""
        waiting = self._waiting.get(key)
        if waiting is None:
            self._waiting[key] = []
            return True
        heapq.heappush(waiting, (time_ns, next(self._numbers), item))
        return False

    def leave(self, key: Hashable) -> T | None:
        """The next of a key, whose last one is done; None where none waits."""
        waiting = self._waiting[key]
        if waiting:
            return heapq.heappop(waiting)[2]
        del self._waiting[key]
        return None
