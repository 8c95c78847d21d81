"""The queue of submissions: looked up in groups, computed by a pool, recorded by the writer.

    submit ──► inbox ──► ingest thread ──► solver pool ──► writer ──► futures
                         what is recorded already     one transaction
                         is answered from the tables  for all that wait

Each stage takes whatever waits for it, so that look-ups and commits are shared
under load and nothing waits for a timer.  A batch that takes long delays no other.
A repeat of a batch that is being computed waits for it and is then looked up.
"""

import asyncio
import logging
import threading
import time
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from queue import Empty, SimpleQueue

from service.errors import BeingBuilt, Busy, Stopping
from service.ingest.solver_pool import WAIT_S, SolverPool, SolverTask
from service.ingest.turns import Turns
from service.observations.schema import Submission
from service.storage.recording.identity import Identity, OwnKey
from service.storage.recording.unsaved_result import Answered, UnsavedResult
from service.storage.sql.transaction import WriteOutcome, WriteOutcomes
from service.storage.sql.writer import RETRY_AFTER_S, Writer, WriterState
from service.times import Utc, utc_now

MAX_WAITING = 2_000
GROUP = 64
HEARTBEAT_S, STALLED_S = 1.0, 20.0
"""The longest time between heartbeats of the ingest thread, and the silence that counts as failure;
one look-up takes at most five seconds."""
DRAIN_S = 8.0
"""The longest wait for submissions to be answered when the service stops."""

Found = Sequence[Answered | Exception | None]

log = logging.getLogger(__name__)


@dataclass(eq=False, slots=True)
class PendingBatch:
    """A submission that waits for its answer, which is set on `future`.

    `make` gives the submission, which of a frame takes long; what it is called and the
    fingerprint of its body are known before that.  `turn` is whose turn it is counted as.
    """

    identity: Identity
    fingerprint: str
    key: OwnKey | None
    make: Callable[[], Submission]
    turn: Hashable
    is_long: bool
    future: "asyncio.Future[Answered] | Future[Answered]" = field(default_factory=Future)
    wait_s: float = WAIT_S
    sequence: Hashable | None = None
    """Batches of one sequence are computed one after another, each when the last is recorded."""
    time_ns: int = 0
    """The order of those of a sequence that wait together."""
    received: Utc = field(default_factory=utc_now)
    since_s: float = field(default_factory=time.monotonic)


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
        look_up: Callable[[Sequence[PendingBatch]], Found],
        solve: Callable[[PendingBatch], UnsavedResult],
        recorded: Callable[[UnsavedResult, WriteOutcome], object],
        writer: Writer,
        pool: SolverPool,
    ) -> None:
        """`look_up` answers what is recorded; `recorded` is told of each outcome of a write."""
        self._look_up, self._solve, self._told = look_up, solve, recorded
        self._writer, self._pool = writer, pool
        self._inbox: SimpleQueue[PendingBatch | None] = SimpleQueue()
        self._lock = threading.Lock()
        self._in_flight: dict[Identity, list[PendingBatch]] = {}
        """Those that are being computed or recorded, each with its repeats."""
        self._turns: Turns[PendingBatch] = Turns()
        self._unsettled: dict[PendingBatch, None] = {}
        self._written: list[tuple[PendingBatch, WriteOutcome]] = []
        self._closing = False
        self._empty = threading.Event()
        self._empty.set()
        self._beat_s = time.monotonic()
        writer.after_commit.append(self._answer_written)
        self._thread = threading.Thread(target=self._run, name="ingest", daemon=True)
        self._thread.start()

    def put(self, pending: PendingBatch) -> None:
        """Queue a submission; raises `Busy` where too many wait, `Stopping` after `close`."""
        with self._lock:
            if self._closing:
                raise Stopping("the service is stopping")
            if len(self._unsettled) >= MAX_WAITING:
                message = f"{MAX_WAITING} batches are waiting to be worked on"
                raise Busy(message, RETRY_AFTER_S)
            self._unsettled[pending] = None
            self._empty.clear()
        self._inbox.put(pending)

    def state(self) -> QueueState:
        """The submissions that wait for their answers."""
        with self._lock:
            oldest = next(iter(self._unsettled), None)
            age_s = 0.0 if oldest is None else time.monotonic() - oldest.since_s
            return QueueState(len(self._unsettled), age_s)

    def wait_until_empty(self, seconds: float) -> None:
        """Wait until every submission is answered, at most `seconds`."""
        self._empty.wait(seconds)

    def require_alive(self) -> None:
        """Raise `Stopping` where the ingest thread has ended or does not go on."""
        if not self._thread.is_alive() or time.monotonic() - self._beat_s > STALLED_S:
            raise Stopping("submissions are not worked on any more: restart the service")

    def close(self) -> None:
        """Refuse new submissions, answer those that wait, and end the thread."""
        with self._lock:
            self._closing = True
        self._empty.wait(DRAIN_S)
        self._inbox.put(None)
        self._thread.join()

    # ---- the ingest thread -------------------------------------------------------------------

    def _run(self) -> None:
        try:
            while (group := self._next_group()) is not None:
                try:
                    self._begin(group)
                except Exception as error:
                    log.exception("a group of submissions failed")
                    self._settle([(pending, error) for pending in group])
        finally:
            # Empty after an orderly close; otherwise the waiting clients get an error.
            with self._lock:
                self._closing = True
                left = list(self._unsettled)
            self._settle([(each, Stopping("the service is stopping")) for each in left])

    def _next_group(self) -> list[PendingBatch] | None:
        """The submissions that wait, at least one; None after `close`."""
        group: list[PendingBatch] = []
        while not group:
            self._beat_s = time.monotonic()
            with suppress(Empty):
                waiting = self._inbox.get(timeout=HEARTBEAT_S)
                while waiting is not None and len(group) < GROUP:
                    group.append(waiting)
                    waiting = self._inbox.get_nowait()
                if waiting is None:
                    return None
                group.append(waiting)
        return group

    def _begin(self, group: Sequence[PendingBatch]) -> None:
        """Answer recorded and expired submissions; start computing the others, each once."""
        now_s = time.monotonic()
        late = [each for each in group if now_s - each.since_s > each.wait_s]
        group = [each for each in group if now_s - each.since_s <= each.wait_s]
        for pending in late:
            error = Busy(f"it has waited {pending.wait_s:g} s for its turn", RETRY_AFTER_S)
            self._settle([(pending, error)])
        if not group:
            return
        try:
            found = self._look_up(group)
        except Exception as error:
            found = [error] * len(group)
        self._settle([(p, each) for p, each in zip(group, found, strict=True) if each is not None])
        for pending, each in zip(group, found, strict=True):
            if each is None:
                self._compute(pending)

    def _compute(self, pending: PendingBatch) -> None:
        with self._lock:
            repeats = self._in_flight.get(pending.identity)
            if repeats is not None:
                repeats.append(pending)
                return
            self._in_flight[pending.identity] = []
            sequence = pending.sequence
            if sequence is not None and not self._turns.enter(sequence, pending.time_ns, pending):
                return
        error = self._start(pending)
        if error is not None:
            self._finish([(pending, error)])

    def _start(self, pending: PendingBatch) -> Stopping | None:
        """Queue a batch for the pool; the error where that takes no more."""
        task = SolverTask(
            partial(self._solve_and_record, pending),
            lambda error: self._finish([(pending, error)]),
            pending.since_s + pending.wait_s,
        )
        try:
            self._pool.put(task, pending.turn, is_long=pending.is_long)
        except Stopping as error:
            return error
        return None

    # ---- a thread of the pool ----------------------------------------------------------------

    def _solve_and_record(self, pending: PendingBatch) -> None:
        try:
            unsaved = self._solve(pending)
            self._writer.queue([unsaved], partial(self._note_written, pending, unsaved))
        except BeingBuilt:
            raise  # the pool tries again
        except Exception as error:
            self._finish([(pending, error)])

    # ---- the writer's thread -----------------------------------------------------------------

    def _note_written(
        self, pending: PendingBatch, unsaved: UnsavedResult, outcome: WriteOutcomes | Exception
    ) -> None:
        one = outcome if isinstance(outcome, Exception) else outcome[0]
        self._told(unsaved, one)
        self._written.append((pending, one))

    def _answer_written(self) -> None:
        written, self._written = self._written, []
        if written:
            self._finish(written)

    # ---- answers -----------------------------------------------------------------------------

    def _finish(self, outcomes: Sequence[tuple[PendingBatch, WriteOutcome]]) -> None:
        """Answer what was computed; its repeats are looked up, for it may have failed."""
        done = list(outcomes)
        # The next of a sequence may fail to start: then it is done as well.
        for pending, _ in done:
            if pending.sequence is not None:
                with self._lock:
                    following = self._turns.leave(pending.sequence)
                error = None if following is None else self._start(following)
                if following is not None and error is not None:
                    done.append((following, error))
        with self._lock:
            repeats = [each for p, _ in done for each in self._in_flight.pop(p.identity, ())]
        for each in repeats:
            self._inbox.put(each)
        self._settle(done)

    def _settle(self, outcomes: Sequence[tuple[PendingBatch, WriteOutcome]]) -> None:
        by_loop: dict[asyncio.AbstractEventLoop, list[tuple[PendingBatch, WriteOutcome]]] = {}
        with self._lock:
            for pending, _ in outcomes:
                self._unsettled.pop(pending, None)
            if not self._unsettled:
                self._empty.set()
        for pending, outcome in outcomes:
            if isinstance(pending.future, Future):
                _answer([(pending, outcome)])
            else:
                by_loop.setdefault(pending.future.get_loop(), []).append((pending, outcome))
        for loop, some in by_loop.items():
            # The loop may be closed: then no client waits for these answers.
            with suppress(RuntimeError):
                loop.call_soon_threadsafe(_answer, some)


def _answer(outcomes: Sequence[tuple[PendingBatch, WriteOutcome]]) -> None:
    for pending, outcome in outcomes:
        if pending.future.done():
            continue  # the client has gone
        if isinstance(outcome, Exception):
            pending.future.set_exception(outcome)
        else:
            pending.future.set_result(outcome)
