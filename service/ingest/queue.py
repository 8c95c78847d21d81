"""Queue of submissions, and the thread that processes them up to their answers.

    put ──► take ──► known? ──► compute ──► record ──► answer
                                  │            ▲
                                  └► solver pool, for slow batches

The thread takes all waiting submissions at once, so that look-ups and commits are shared under load
and nothing waits for a timer.  A slow batch goes to a thread of the pool, and delays no other.  A
repeat of a batch in progress waits for it and is then looked up.
"""

import asyncio
import heapq
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Generic, TypeVar

from service.errors import AcquisitionError, BeingBuilt, Busy, Stopping
from service.ingest.missions_in_force import MissionsInForce
from service.ingest.solver_pool import WAIT_S, Solver, SolverPool, SolverTask
from service.ingest.tracking import predicted_from, with_prediction
from service.observations.schema import LIVE, Submission
from service.sky.cache import NotAtHand
from service.storage.recording.identity import (
    ExistingResult,
    Identity,
    OwnKey,
    PredictionOutdated,
    look_up,
    remember_keys,
)
from service.storage.recording.unsaved_result import Answered, PredictedFrom, UnsavedResult
from service.storage.recording.writer import RETRY_AFTER_S, WriteOutcome, WriterState
from service.storage.store import Store
from service.times import Utc, utc_now

OUTCOMES = ("unique", "ambiguous", "unmatched")
MAX_WAITING = 2_000
TOGETHER = 64
"""Largest number of batches in one transaction."""
DRAIN_S = 8.0
"""Longest wait in seconds for pending submissions when the service stops."""
STALLED_S = 20.0
"""Seconds after which the queue counts as stalled; a look-up takes at most five seconds."""

log = logging.getLogger(__name__)


@dataclass(eq=False, slots=True)
class PendingBatch:
    """A submission that waits for its answer, which is set on `future`.

    `make` builds the submission, slowly for a frame; its identity and fingerprint are known
    earlier.  `client` is the client and spacecraft between whose batches the pool shares its
    threads.
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
    """Key of a sequence of batches; each is computed after the previous one is recorded."""
    time_ns: int = 0
    """Time that orders waiting batches of a sequence, in ns of TAI."""
    received: Utc = field(default_factory=utc_now)
    since_s: float = field(default_factory=time.monotonic)
    unsaved: UnsavedResult | None = None
    """Computed result, not yet recorded; None before the computation."""


Answer = Answered | Exception


@dataclass(frozen=True)
class QueueState:
    """Number of submissions waiting for answers, and age of the oldest in seconds."""

    queued: int
    oldest_s: float


@dataclass(frozen=True)
class Backlog:
    """State of the queue of submitted batches, and of the writer's queue."""

    posts: QueueState
    writes: WriterState


class IngestQueue:
    """Queue that takes submissions from any thread and answers them in its own thread."""

    def __init__(
        self,
        solver: Solver,
        store: Store,
        pool: SolverPool,
        counts: "RecordedCounts",
        in_force: MissionsInForce,
    ) -> None:
        """Prepare the queue; `in_force` is updated before each group on a shared database."""
        self._solver, self._store, self._pool = solver, store, pool
        self._counts = counts
        self._shared_missions = in_force if store.lock is not None else None
        self._changed = threading.Condition()
        self._waiting: deque[PendingBatch] = deque()
        """Batches that wait for the queue's thread: new ones, and ones computed by the pool."""
        self._in_flight: dict[Identity, list[PendingBatch]] = {}
        """Batches being computed or recorded, by identity, each with its waiting repeats."""
        self._sequences: Sequences[PendingBatch] = Sequences()
        self._unanswered: dict[PendingBatch, None] = {}
        self._closing = False
        self._empty = threading.Event()
        self._empty.set()
        self._solving_since_s: float | None = None
        self._thread = threading.Thread(target=self._run, name="ingest", daemon=True)
        self._thread.start()

    def put(self, pending: PendingBatch) -> None:
        """Queue a submission; raises `Busy` if the queue is full, `Stopping` after `close`."""
        with self._changed:
            if self._closing:
                raise Stopping("the service is stopping")
            if len(self._unanswered) >= MAX_WAITING:
                message = f"{MAX_WAITING} batches are waiting to be worked on"
                raise Busy(message, RETRY_AFTER_S)
            self._unanswered[pending] = None
            self._empty.clear()
            self._waiting.append(pending)
            self._changed.notify_all()

    def state(self) -> QueueState:
        """Number and age of the submissions that wait for their answers."""
        with self._changed:
            oldest = next(iter(self._unanswered), None)
            age_s = 0.0 if oldest is None else time.monotonic() - oldest.since_s
            return QueueState(len(self._unanswered), age_s)

    def require(self) -> None:
        """Raise `Stopping` if the queue is closed, stalled or without its thread."""
        since_s = self._solving_since_s
        is_stalled = since_s is not None and time.monotonic() - since_s > STALLED_S
        if self._closing or is_stalled or not self._thread.is_alive():
            raise Stopping("nothing is recorded any more: restart the service")

    def wait_until_empty(self, seconds: float) -> None:
        """Wait until every submission is answered, at most `seconds`."""
        self._empty.wait(seconds)

    def close(self) -> None:
        """Refuse new submissions, answer the waiting ones, and end the thread."""
        with self._changed:
            self._closing = True
        self.wait_until_empty(DRAIN_S)
        with self._changed:
            left = list(self._unanswered)
            self._changed.notify_all()
        self._answer([(pending, Stopping("the service is stopping")) for pending in left])
        self._thread.join(DRAIN_S)

    # ---- the thread --------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while group := self._take():
                self._work_on(group)
        finally:
            # Empty after a regular close; otherwise no thread is left to answer the waiting ones.
            with self._changed:
                self._closing = True
                left = list(self._unanswered)
            self._answer([(pending, Stopping("the queue has ended")) for pending in left])

    def _take(self) -> list[PendingBatch]:
        """Take up to `TOGETHER` waiting batches; returns none after `close` if all are answered."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._waiting or (self._closing and not self._unanswered)
            )
            return [self._waiting.popleft() for _ in range(min(TOGETHER, len(self._waiting)))]

    def _work_on(self, group: Sequence[PendingBatch]) -> None:
        """Answer the batches recorded already; compute and record the others, each once."""
        computed = [pending for pending in group if pending.unsaved is not None]
        fresh = self._in_time([pending for pending in group if pending.unsaved is None])
        if fresh:
            self._solving_since_s = time.monotonic()
            try:
                unknown = [
                    pending for pending in self._not_recorded(fresh) if self._begins(pending)
                ]
                computed += self._computed(unknown)
            finally:
                self._solving_since_s = None
        if computed:
            self._record(computed)

    def _in_time(self, group: Sequence[PendingBatch]) -> list[PendingBatch]:
        """Refuse batches that have waited too long for their turn; returns the others."""
        now_s = time.monotonic()
        late = [pending for pending in group if now_s - pending.since_s > pending.wait_s]
        if not late:
            return list(group)
        self._answer(
            [(p, Busy(f"it has waited {p.wait_s:g} s for its turn", RETRY_AFTER_S)) for p in late]
        )
        return [pending for pending in group if pending not in late]

    def _not_recorded(self, group: Sequence[PendingBatch]) -> list[PendingBatch]:
        """Answer batches that are recorded, or with a taken identity or key; returns the others."""
        try:
            known = self._recorded_before(group)
        except Exception as error:
            # Each client gets the error: nothing is decided about its batch.
            known = dict.fromkeys(group, error)
        if known:
            self._answer(list(known.items()))
        return [pending for pending in group if pending not in known]

    def _recorded_before(self, group: Sequence[PendingBatch]) -> dict[PendingBatch, Answer]:
        """Look up recorded batches: their stored answers, or errors for names with another body."""
        # Look up identities before keys, each at its own moment: a batch recorded in between is
        # found by its key, or seems new until its transaction finds it.
        try:
            with self._store.lookup() as connection:
                registry = look_up(
                    connection,
                    {pending.identity for pending in group},
                    {pending.key for pending in group if pending.key is not None},
                )
                if self._shared_missions is not None:
                    self._shared_missions.follow_in(connection)
        except Busy:
            # Batches that cannot be looked up cannot be written either.
            self._store.writer.note_failure(len(group))
            raise
        known: dict[PendingBatch, Answer] = {}
        repeats: dict[PendingBatch, ExistingResult] = {}
        for pending in group:
            holder = registry.holder(pending.identity, pending.key, pending.fingerprint)
            if isinstance(holder, ExistingResult):
                repeats[pending] = holder
            elif holder is not None:
                known[pending] = holder
        if not repeats:
            return known
        ids = {first.result_id for first in repeats.values()}
        with self._store.reading_record() as connection:
            stored = self._store.archive.answers_or_faults(connection, ids)
        for pending, first in repeats.items():
            answer = stored.get(first.result_id)
            if isinstance(answer, AcquisitionError):
                known[pending] = answer
            elif answer is not None:
                # A batch that was pruned in between counts as new.
                known[pending] = Answered(first.result_id, answer, replayed=True)
        # The keys of archived batches are in the archive.
        new_keys = {
            pending: first
            for pending, first in repeats.items()
            if pending.key is not None
            and pending.key not in registry.keys
            and not first.archived
            and isinstance(known.get(pending), Answered)
        }
        return known | (self._keep_keys(new_keys) if new_keys else {})

    def _keep_keys(
        self, repeats: Mapping[PendingBatch, ExistingResult]
    ) -> dict[PendingBatch, Exception]:
        """Assign the Idempotency-Keys of repeats to their recorded results; returns errors."""
        keys = [
            (pending.identity, pending.key, first)
            for pending, first in repeats.items()
            if pending.key is not None
        ]
        try:
            outcomes = self._store.writer.change(partial(remember_keys, keys=keys), of_posts=True)
        except Exception as error:
            # A client whose key is not stored must send again: it gets the error, not the answer.
            return dict.fromkeys(repeats, error)
        return {
            pending: outcome
            for pending, outcome in zip(repeats, outcomes, strict=True)
            if outcome is not None
        }

    def _begins(self, pending: PendingBatch) -> bool:
        """True for a batch to compute now; others go to the pool, or wait for a batch before."""
        with self._changed:
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

    def _computed(self, group: Sequence[PendingBatch]) -> list[PendingBatch]:
        """Compute batches together; slow ones go to the pool, others are returned with results."""
        submissions: dict[PendingBatch, Submission] = {}
        failed: dict[PendingBatch, Exception] = {}
        for pending in group:
            try:
                submissions[pending] = pending.make()
            except Exception as error:
                failed[pending] = error
        try:
            batches = [submission.batch for submission in submissions.values()]
            acquired = self._solver.acquired(batches, at_once=True) if batches else []
        except Exception as error:
            log.exception("batches that waited together failed")
            acquired = [error] * len(submissions)
        for (pending, submission), found in zip(submissions.items(), acquired, strict=True):
            try:
                pending.unsaved = self._solver.unsaved(
                    submission, found, pending.received, pending.key
                )
            except NotAtHand:
                self._start(pending)
            except Exception as error:
                # The error concerns this batch alone: answer its client with it.
                failed[pending] = error
            else:
                pending.unsaved.handed_over_ns = time.perf_counter_ns()
        if failed:
            self._finish(list(failed.items()))
        return [pending for pending in group if pending.unsaved is not None]

    def _record(self, group: Sequence[PendingBatch]) -> None:
        """Record results in one transaction, and answer their clients."""
        unsaved_results = [pending.unsaved for pending in group if pending.unsaved is not None]
        outcomes: Sequence[WriteOutcome]
        try:
            outcomes = self._store.writer.record(unsaved_results)
        except Exception as error:
            # Nothing of the group is recorded: each of its clients gets the error.
            outcomes = [error] * len(group)
        self._counts.add(unsaved_results, outcomes)
        done: list[tuple[PendingBatch, Answer]] = []
        for pending, outcome in zip(group, outcomes, strict=True):
            if isinstance(outcome, PredictionOutdated):
                # Compute it again from the present last attitude, until its time is over.
                pending.unsaved = None
                self._start(pending)
            else:
                done.append((pending, outcome))
        self._finish(done)

    # ---- a thread of the pool ----------------------------------------------------------------

    def _start(self, pending: PendingBatch) -> None:
        """Queue a slow batch for the pool."""
        task = SolverTask(
            partial(self._solve, pending),
            lambda error: self._finish([(pending, error)]),
            pending.since_s + pending.wait_s,
        )
        try:
            self._pool.put(task, pending.client, is_long=pending.is_long)
        except Stopping as error:
            self._finish([(pending, error)])

    def _solve(self, pending: PendingBatch) -> None:
        """Compute a batch in the pool, and pass its result to the queue's thread."""
        try:
            pending.unsaved = self._solved_alone(pending)
        except BeingBuilt:
            raise  # the pool tries again
        except Exception as error:
            self._finish([(pending, error)])
            return
        with self._changed:
            self._waiting.append(pending)
            self._changed.notify_all()

    def _solved_alone(self, pending: PendingBatch) -> UnsavedResult:
        submission = pending.make()
        last: PredictedFrom | None = None
        if self._solver.asks_for_last(batch := submission.batch):
            mission = self._solver.missions[batch.spacecraft]
            with self._store.reading_record() as connection:
                submission = with_prediction(connection, submission, mission)
                if self._store.lock is not None:
                    # Other services record attitudes of this spacecraft as well.
                    last = predicted_from(connection, batch, mission)
        unsaved = self._solver.solve(submission, pending.received, pending.key)
        unsaved.predicted_from = last
        unsaved.handed_over_ns = time.perf_counter_ns()
        return unsaved

    # ---- answers -----------------------------------------------------------------------------

    def _finish(self, outcomes: Sequence[tuple[PendingBatch, Answer]]) -> None:
        """Answer finished batches, and queue their repeats for a look-up."""
        with self._changed:
            repeats = [each for p, _ in outcomes for each in self._in_flight.pop(p.identity, ())]
            ended = [p.sequence for p, _ in outcomes if p.sequence is not None]
            following = [each for key in ended if (each := self._sequences.leave(key)) is not None]
        self._answer(outcomes)
        if repeats:
            with self._changed:
                self._waiting.extend(repeats)
                self._changed.notify_all()
        for pending in following:
            self._start(pending)

    def _answer(self, outcomes: Sequence[tuple[PendingBatch, Answer]]) -> None:
        by_loop: dict[asyncio.AbstractEventLoop, list[tuple[PendingBatch, Answer]]] = {}
        with self._changed:
            for pending, _ in outcomes:
                self._unanswered.pop(pending, None)
            if not self._unanswered:
                self._empty.set()
                self._changed.notify_all()
        for pending, outcome in outcomes:
            if isinstance(pending.future, Future):
                _set_futures([(pending, outcome)])
            else:
                by_loop.setdefault(pending.future.get_loop(), []).append((pending, outcome))
        for loop, group in by_loop.items():
            # The loop may be closed: then no client waits for these answers.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(_set_futures, group)


def _set_futures(outcomes: Sequence[tuple[PendingBatch, Answer]]) -> None:
    for pending, outcome in outcomes:
        if pending.future.done():
            continue  # the client has gone
        if isinstance(outcome, Exception):
            pending.future.set_exception(outcome)
        else:
            pending.future.set_result(outcome)


class RecordedCounts:
    """Number of new batches and stars recorded since the start, for the metrics."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.batches: Counter[tuple[str, bool, bool]] = Counter()
        """Number of batches by spacecraft, live or not, and with attitude or without."""
        self.stars: Counter[tuple[str, bool, str]] = Counter()
        """Number of stars of the batches by spacecraft, live or not, and outcome."""

    def add(
        self, unsaved_results: Sequence[UnsavedResult], outcomes: Sequence[WriteOutcome]
    ) -> None:
        """Count newly recorded batches and their stars; what-ifs are left out."""
        with self._lock:
            for unsaved, outcome in zip(unsaved_results, outcomes, strict=True):
                is_new = isinstance(outcome, Answered) and not outcome.replayed
                if not is_new or unsaved.batch is None:
                    continue
                spacecraft, run, _ = unsaved.identity
                owner = spacecraft, run == LIVE
                self.batches[*owner, unsaved.solution is not None] += 1
                for name in OUTCOMES:
                    self.stars[*owner, name] += unsaved.counts[name]

    def copy(self) -> "RecordedCounts":
        """Copy of the present counts of recorded batches and stars."""
        copied = RecordedCounts()
        with self._lock:
            copied.batches, copied.stars = self.batches.copy(), self.stars.copy()
        return copied


T = TypeVar("T")


class Sequences(Generic[T]):
    """Waiting batches by sequence, one of which is computed at a time; callers hold a lock."""

    def __init__(self) -> None:
        self._waiting: dict[Hashable, list[tuple[int, int, T]]] = {}
        """Heap of waiting batches (time, number, batch) by the key of each active sequence."""
        self._numbers = count()

    def enter(self, key: Hashable, time_ns: int, item: T) -> bool:
        """True if the item may start, as none of its sequence does; otherwise it is queued."""
        waiting = self._waiting.get(key)
        if waiting is None:
            self._waiting[key] = []
            return True
        heapq.heappush(waiting, (time_ns, next(self._numbers), item))
        return False

    def leave(self, key: Hashable) -> T | None:
        """End the active item of a sequence; returns the next waiting item, or None."""
        waiting = self._waiting[key]
        if waiting:
            return heapq.heappop(waiting)[2]
        del self._waiting[key]
        return None
