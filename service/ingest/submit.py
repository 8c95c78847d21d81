"""Submission of a batch up to its stored answer: read, compute, record in one transaction."""

import asyncio
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, TypeVar

import msgspec
from pydantic import Field, TypeAdapter
from pydantic_core import to_json
from sqlalchemy import Connection

from service.access import Caller, Entry
from service.acquire import Acquisition
from service.acquire.choices import refuse_idle_options
from service.acquire.kernel_build import KernelBuild
from service.errors import AcquisitionError, BadBatch, Busy, Fault, shown_value
from service.ingest.missions_in_force import MissionsInForce
from service.ingest.queue import Backlog, IngestQueue, PendingBatch, RecordedCounts
from service.ingest.solver_pool import WAIT_S, Solver, SolverPool, may_take_long, mission_in_input
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.observations.field_faults import checked_by
from service.observations.schema import OptionsIn, Submission, submission_from_json
from service.sky.model import SkyModel
from service.storage.queries.results import batch_with_options, read_parent
from service.storage.recording.answer import answer_of
from service.storage.recording.identity import (
    ExistingResult,
    Identity,
    identity_of,
    look_up,
)
from service.storage.recording.results import record
from service.storage.recording.signatures import naming_result
from service.storage.recording.unsaved_result import Answered, UnsavedResult, unsaved_what_if
from service.storage.recording.writer import WriteOutcomes
from service.storage.store import Store
from service.times import utc_now

log = logging.getLogger(__name__)

YIELD_S = 0.002
"""Longest wait in seconds of each bulk batch for single posts."""
PORTION = 32
"""Number of bulk batches solved together, between checks for single ones."""
MAX_ARRAY = 100
"""Largest number of batches in an array."""
READ_HERE_BYTES, READ_HERE_OBJECTS = 4_096, 64
"""Limits on bytes and objects of a body read in the event loop; thirty stars fit."""
MAX_KEY_LENGTH = 255

_ARRAY: TypeAdapter[list[Any]] = TypeAdapter(
    Annotated[list[Any], Field(min_length=1, max_length=MAX_ARRAY)]
)

Answers = list[Answered | AcquisitionError]
Outcome = Answered | BaseException


AnswerFuture = TypeVar("AnswerFuture", "asyncio.Future[Answered]", "Future[Answered]")


class _WarmedUp(Exception):
    """Exception that rolls the warm-up batch back."""


class SubmissionService:
    """Service that identifies, solves and records each submission once, also if sent repeatedly."""

    def __init__(
        self,
        in_force: MissionsInForce,
        sky: SkyModel,
        store: Store,
        kernels: KernelBuild | None = None,
    ) -> None:
        """Prepare to take batches; `kernels` refuses a batch until its kernels are compiled."""
        self.pool = SolverPool()
        self.solver = Solver(in_force.missions, replace(sky, builder=self.pool.builder))
        self._store = store
        self._kernels = kernels
        self._reader = ThreadPoolExecutor(1, "read")
        self.counts = RecordedCounts()
        self._queue = IngestQueue(self.solver, store, self.pool, self.counts, in_force)
        self._single_s = -float("inf")

    def require_kernels(self, *, of_zones: bool = False) -> None:
        """Raise `Busy` while kernels are compiled, so that no answer depends on which ones exist.

        With `of_zones` the kernels of batches with a zone suffice.  A batch that needs others,
        without a priori attitude or with a wrong one, is refused where it needs them: by
        `SkyModel.require_whole_sky`.
        """
        if self._kernels is not None and (self._kernels.zones_needed or not of_zones):
            self._kernels.require_built()

    # ---- one batch, or an array --------------------------------------------------------------

    async def answered(
        self, sent: bytes, idempotency_key: str | None = None, caller: Caller | None = None
    ) -> Answered:
        """Submit a batch as JSON from an event loop, and wait for its answer.

        A small batch is read in the event loop.  A larger one is not, since it would delay every
        other request.
        """
        self.require_kernels(of_zones=True)
        loop = asyncio.get_running_loop()
        if len(sent) <= READ_HERE_BYTES and sent.count(b"{") <= READ_HERE_OBJECTS:
            submission = submission_from_json(sent)
        else:
            submission = await loop.run_in_executor(self._reader, submission_from_json, sent)
        future: asyncio.Future[Answered] = loop.create_future()
        return await self.queued(submission, idempotency_key, caller, future)

    async def read_array(self, sent: bytes) -> list[Submission | BadBatch]:
        """Decode a JSON array of batches; a refused element gives its error.

        Raises `BadBatch` unless the body is an array of one to `MAX_ARRAY` elements.
        """
        self.require_kernels(of_zones=True)
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._reader, _submissions_of_array, sent)

    async def answered_each(
        self, read: Sequence[Submission | BadBatch], caller: Caller | None = None
    ) -> list[Outcome]:
        """Submit each batch of an array; returns the answers and errors in order."""
        loop = asyncio.get_running_loop()
        futures: list[asyncio.Future[Answered]] = []
        for each in read:
            future: asyncio.Future[Answered] = loop.create_future()
            futures.append(future)
            try:
                if isinstance(each, BadBatch):
                    raise each
                self.queued(each, None, caller, future)
            except AcquisitionError as error:
                future.set_exception(error)
        return list(await asyncio.gather(*futures, return_exceptions=True))

    def submit(
        self,
        submission: Submission,
        idempotency_key: str | None = None,
        caller: Caller | None = None,
    ) -> Answered:
        """Record a batch and return its answer; a repeated batch gets the stored answer.

        Raises the errors of `queued` and of its future: `KeyReused` and `Conflict` for another body
        under a key or a batch that is taken, `BadBatch` also for an unknown spacecraft and for a
        batch that does not fit its mission.
        """
        return self.queued(submission, idempotency_key, caller, Future()).result()

    def queued(
        self,
        submission: Submission,
        idempotency_key: str | None,
        caller: Caller | None,
        future: AnswerFuture,
    ) -> AnswerFuture:
        """Queue a batch; the future, of an event loop or of threads, gives the stored answer.

        Raises `Forbidden` where the caller has no access to the spacecraft, `BadBatch` for an
        invalid key, and `Busy` where the queue is full.  The future raises any other error that
        keeps the batch from being recorded.
        """
        batch = submission.batch
        if caller is not None:
            caller.require(batch.spacecraft)
        return self.queue_made(
            identity_of(batch),
            submission.fingerprint,
            lambda: submission,
            idempotency_key,
            caller,
            future,
            is_long=may_take_long(batch),
            tracked_ns=batch.time.tai_ns if self.solver.asks_for_last(batch) else None,
        )

    def queue_made(
        self,
        identity: Identity,
        fingerprint: str,
        make: Callable[[], Submission],
        idempotency_key: str | None,
        caller: Caller | None,
        future: AnswerFuture,
        *,
        is_long: bool,
        wait_s: float = WAIT_S,
        tracked_ns: int | None = None,
    ) -> AnswerFuture:
        """Queue a batch that `make` builds in the pool when it is computed, if not yet recorded.

        `tracked_ns` is the time of a batch that asks for the last attitude.  Otherwise as `queued`.
        """
        token_id = None if caller is None else caller.token_id
        key = None
        if idempotency_key is not None:
            is_plain = idempotency_key.isascii() and idempotency_key.isprintable()
            if not (is_plain and 0 < len(idempotency_key) <= MAX_KEY_LENGTH):
                message = f"must be 1 to {MAX_KEY_LENGTH} printable ASCII characters"
                raise BadBatch(Fault("Idempotency-Key", message, shown_value(idempotency_key)))
            key = (token_id or "", idempotency_key)
        turn = (token_id, identity[0])
        pending = PendingBatch(identity, fingerprint, key, make, turn, is_long, future, wait_s)
        if tracked_ns is not None:
            pending.sequence, pending.time_ns = identity[:2], tracked_ns
        self._single_s = pending.since_s
        self._queue.put(pending)
        return future

    # ---- many together -----------------------------------------------------------------------

    def submit_many(self, submissions: Sequence[Submission]) -> Answers:
        """Record many batches in one transaction; a refused one has its error in the list.

        Those that ask for the last attitude follow one by one.
        """
        places = [k for k, each in enumerate(submissions) if self.solver.asks_for_last(each.batch)]
        others = [each for k, each in enumerate(submissions) if k not in places]
        answers = iter(self._submit_together(others) if others else ())
        tracked = {k: self.submit_tracked(submissions[k]) for k in places}
        return [tracked[k] if k in tracked else next(answers) for k in range(len(submissions))]

    def submit_tracked(self, submission: Submission) -> Answered | AcquisitionError:
        """Record a bulk batch that asks for the last attitude; raises `Busy`."""
        batch = submission.batch
        pending = PendingBatch(
            identity := identity_of(batch),
            submission.fingerprint,
            None,
            lambda: submission,
            "bulk",
            is_long=True,
            sequence=identity[:2],
            time_ns=batch.time.tai_ns,
        )
        self._queue.put(pending)
        assert isinstance(pending.future, Future)
        outcome: Answered | Exception
        try:
            outcome = pending.future.result()
        except Exception as error:
            outcome = error
        (one,) = decided([outcome])
        return one

    def _submit_together(self, submissions: Sequence[Submission]) -> Answers:
        with self._store.reading_record() as connection:
            registry = look_up(connection, {identity_of(each.batch) for each in submissions})
            holders = [
                registry.holder(identity_of(each.batch), None, each.fingerprint)
                for each in submissions
            ]
            repeats = {each.result_id for each in holders if isinstance(each, ExistingResult)}
            stored = self._store.archive.stored_answers(connection, repeats)
        # Close the connection: a snapshot held during the computation of five hundred batches keeps
        # SQLite from shortening its log.
        fresh = [each for holder, each in zip(holders, submissions, strict=True) if not holder]
        solved = iter(self.solve_many(fresh))
        found = [holder or next(solved) for holder in holders]
        unsaved_results = [each for each in found if isinstance(each, UnsavedResult)]
        written = iter(self.begin_writing(unsaved_results)())
        answers: Answers = []
        for one in found:
            if isinstance(one, UnsavedResult):
                answers.append(next(written))
            elif isinstance(one, ExistingResult):
                answers.append(Answered(one.result_id, stored[one.result_id], replayed=True))
            else:
                answers.append(one)
        return answers

    def what_if(
        self,
        id: str,
        options: OptionsIn,
        *,
        record: bool,
        adopt: bool,
        entry: Entry | None = None,
    ) -> Answered:
        """Run a recorded batch again; `options` override those of its result.

        `entry` is stored in the audit list together with a recorded result.
        """
        with self._store.reading_batch(id) as (connection, archived):
            parent = read_parent(connection, id, archived=archived, kept=record or adopt)
        batch = batch_with_options(parent["input"], parent["options"], options)
        mission = mission_in_input(self.solver.missions, batch.spacecraft)
        refuse_idle_options(options, [batch], mission, "options")
        acquisition = self.run_again(batch)
        if not (record or adopt):
            answer = answer_of(acquisition, id=None, parent=id, recorded=False)
            return Answered(None, msgspec.json.encode(answer), replayed=False)
        result_id = self.solver.ids.new()
        unsaved = unsaved_what_if(
            acquisition,
            id=result_id,
            batch_id=parent["batch_id"],
            parent=id,
            adopt=adopt,
            created=utc_now(),
        )
        if entry is not None:
            named = replace(entry, body=naming_result(entry.body, result_id))
            unsaved.audit = named.row()
        unsaved.handed_over_ns = time.perf_counter_ns()
        (outcome,) = decided(self._store.writer.record([unsaved]))
        if isinstance(outcome, AcquisitionError):
            raise outcome
        return outcome

    def run_again(self, batch: ObservationBatch, mission: Mission | None = None) -> Acquisition:
        """Compute a recorded batch again, with other settings if given; nothing is stored.

        Raises `Busy` while all threads have long tasks.
        """
        return self.run_again_many([batch], mission, is_long=may_take_long(batch))[0]

    def run_again_many(
        self,
        batches: Sequence[ObservationBatch],
        mission: Mission | None = None,
        is_long: bool = True,
    ) -> list[Acquisition]:
        """Compute recorded batches of one spacecraft again; raises the first error."""
        return self.pool.call(
            lambda: self.solver.all_acquired(batches, mission),
            ("again", batches[0].spacecraft),
            is_long=is_long,
        )

    def warm_up(self, submission: Submission) -> None:
        """Look up, solve and record a batch, then roll back: nothing is stored or reported.

        Opens connections and prepares statements, which would delay the first batch.
        """
        with self._store.lookup() as connection:
            look_up(connection, {identity_of(submission.batch)})
        unsaved = self.solver.solve(submission)

        def record_and_roll_back(connection: Connection) -> None:
            record(connection, [unsaved])
            raise _WarmedUp

        with suppress(_WarmedUp):
            self._store.writer.change(record_and_roll_back)

    # ---- bulk --------------------------------------------------------------------------------

    def solve_many(
        self, submissions: Sequence[Submission], require: Callable[[], object] = lambda: None
    ) -> list[UnsavedResult | AcquisitionError]:
        """Compute many submissions, each to a result or its own error; single submissions go first.

        `require` is called before each portion, and stops the work where it raises.
        """
        found: list[UnsavedResult | AcquisitionError] = []
        for portion in _portions(submissions):
            require()
            self.yield_to_interactive()
            found += self.pool.call(partial(self.solver.solve_many, portion), "bulk", is_long=True)
        return found

    def begin_writing(self, unsaved_results: Sequence[UnsavedResult]) -> Callable[[], Answers]:
        """Queue results for one transaction; returns a function that waits for the answers."""
        if not unsaved_results:
            return list
        self._store.progress.hold_back()
        moment_ns = time.perf_counter_ns()
        for unsaved in unsaved_results:
            unsaved.handed_over_ns = moment_ns
        writer = self._store.writer
        future = writer.later(partial(writer.record, unsaved_results, low_priority=True))

        def finish() -> Answers:
            outcomes = future.result()
            self.counts.add(unsaved_results, outcomes)
            return decided(outcomes)

        return finish

    @property
    def idle_s(self) -> float:
        """Seconds since a single batch was last submitted."""
        return time.monotonic() - self._single_s

    def yield_to_interactive(self) -> None:
        """Wait a little until single batches are answered."""
        self._queue.wait_until_empty(YIELD_S)

    # ---- state -------------------------------------------------------------------------------

    def backlog(self) -> Backlog:
        """Number of unanswered submissions, and the state of the writer."""
        return Backlog(self._queue.state(), self._store.writer.state())

    def require_alive(self) -> None:
        """Raise `Stopping` if the queue or the writer is closed or stalled."""
        self._queue.require()
        self._store.writer.require()

    def close(self) -> None:
        """Answer the submitted batches, and refuse further ones."""
        self._reader.shutdown(cancel_futures=True)
        self._queue.close()
        self.pool.close()


def _portions(submissions: Sequence[Submission]) -> Iterator[list[Submission]]:
    """Group fast submissions; keep each long one alone, so that it can be stopped."""
    portion: list[Submission] = []
    for each in submissions:
        is_long = may_take_long(each.batch)
        if portion and (is_long or len(portion) == PORTION):
            yield portion
            portion = []
        if is_long:
            yield [each]
        else:
            portion.append(each)
    if portion:
        yield portion


def decided(outcomes: WriteOutcomes) -> Answers:
    """Answers and errors that concern single batches; raises any other error."""
    answers: Answers = []
    for outcome in outcomes:
        # Neither kind of error decides anything about the batch.
        if isinstance(outcome, Busy) or not isinstance(outcome, Answered | AcquisitionError):
            raise outcome
        answers.append(outcome)
    return answers


def _submissions_of_array(sent: bytes) -> list[Submission | BadBatch]:
    return [_submission_of(each) for each in checked_by(_ARRAY.validate_json, sent)]


def _submission_of(element: Any) -> Submission | BadBatch:
    try:
        # Convert to text again: all batches go through the same reader, including NaN.
        return submission_from_json(to_json(element, inf_nan_mode="constants"))
    except BadBatch as error:
        return error
