"""Bulk processing of batches, from lines of telemetry to stored answers.

Worker processes compute if there are any; otherwise this process does, a portion at a time while no
single post waits.  Only this process uses the database.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Annotated

import msgspec

from service.errors import AcquisitionError, Busy
from service.gyro.blocks import GyroBlock, block_from_line, is_gyro_line
from service.ingest.local_workers import ChunkEndsWorkers, LocalWorkers, WorkerLost
from service.ingest.solver_pool import Solver
from service.ingest.submit import SubmissionService
from service.ingest.worker_process import WorkerConfig
from service.observations.batch import ObservationBatch
from service.observations.schema import Submission, submission_from_json
from service.storage.gyro import Recorded
from service.storage.recording.identity import Identity, Registry, identity_of, look_up
from service.storage.recording.unsaved_result import Answered, UnsavedResult
from service.storage.store import Store

PENDING_A_WORKER = 2
"""Number of chunks for each worker, those at work and those waiting."""

LineAnswer = Answered | Recorded | AcquisitionError
"""Answer to a line of telemetry: a batch's answer, a gyro block's row, or an error."""


# Lines of telemetry, each a batch or a gyro block, are read and solved many at once, in this
# process or in a worker.


@dataclass(frozen=True)
class TelemetryLines:
    """Lines of telemetry for one run; `known` holds the positions of those that seem recorded."""

    run: str
    texts: Sequence[bytes]
    known: frozenset[int] = frozenset()


@dataclass(frozen=True)
class RecordedLine:
    """Line of telemetry that was read but not computed, since its batch seems recorded."""

    identity: Identity
    fingerprint: str


@dataclass(frozen=True)
class InvalidLine:
    """Error of a line of telemetry, with its spacecraft if readable."""

    spacecraft: str | None
    error: AcquisitionError


@dataclass(frozen=True)
class TrackedLine:
    """Batch that asks for the last attitude, as JSON; it needs the record to be computed."""

    identity: Identity
    text: str


LineResult = UnsavedResult | RecordedLine | InvalidLine | GyroBlock | TrackedLine
ComputeMany = Callable[[Sequence[Submission]], Sequence[UnsavedResult | AcquisitionError]]


def line_results(
    lines: TelemetryLines, compute: ComputeMany, asks_for_last: Callable[[ObservationBatch], bool]
) -> list[LineResult]:
    """Compute the result of each line of telemetry, in order; `compute` gets all new submissions.

    Batches for which `asks_for_last` is true are not passed to it: they need the results recorded
    before them.
    """
    read = [_read(text, lines.run) for text in lines.texts]
    tracked = {
        place
        for place, each in enumerate(read)
        if isinstance(each, Submission) and place not in lines.known and asks_for_last(each.batch)
    }
    fresh = [
        each
        for place, each in enumerate(read)
        if isinstance(each, Submission) and place not in lines.known | tracked
    ]
    computed = iter(compute(fresh))
    found: list[LineResult] = []
    for place, each in enumerate(read):
        if isinstance(each, InvalidLine | GyroBlock):
            found.append(each)
        elif place in lines.known:
            found.append(RecordedLine(identity_of(each.batch), each.fingerprint))
        elif place in tracked:
            found.append(TrackedLine(identity_of(each.batch), each.text))
        else:
            match next(computed):
                case AcquisitionError() as error:
                    found.append(InvalidLine(each.batch.spacecraft, error))
                case made:
                    found.append(made)
    return found


def _read(text: bytes, run: str) -> Submission | GyroBlock | InvalidLine:
    try:
        if is_gyro_line(text):
            return block_from_line(text, run)
        return submission_from_json(text, run=run)
    except AcquisitionError as error:
        return InvalidLine(None, error)


_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=128, pattern=r"^[^\x00-\x1f\x7f]+\Z")]


class _NamedBatch(msgspec.Struct):
    """Part of a batch that identifies it: spacecraft and batch id."""

    spacecraft: _Name
    batch: _Name


_NAMED = msgspec.json.Decoder(_NamedBatch)


def identity_in(text: bytes, run: str) -> Identity | None:
    """Identity of the batch in a line, without checking the rest; None if unreadable."""
    try:
        named = _NAMED.decode(text)
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return None
    return named.spacecraft, run, named.batch


Decided = UnsavedResult | GyroBlock | TrackedLine | Answered | AcquisitionError
"""State of a line of telemetry before it is recorded."""

Check = Callable[[str], None]
"""Function that raises an `AcquisitionError` where batches of a spacecraft are refused."""

RecordBlocks = Callable[[Sequence[GyroBlock]], list[Recorded | AcquisitionError]]
"""Function that records gyro blocks in one transaction."""

Require = Callable[[], object]
"""Function that raises an `AcquisitionError` where the computation must stop."""


def solve_lines(solver: Solver, lines: TelemetryLines) -> list[LineResult]:
    """Compute the results of lines of telemetry in a worker."""
    return line_results(lines, solver.solve_many, solver.asks_for_last)


INTERACTIVE_WINDOW_S = 0.5
"""Seconds that bulk work pauses after a single batch, because another may follow."""
LINES, FEW_LINES = 64, 8
"""Number of lines in a chunk, and a smaller one while single posts arrive, which wait for it."""


class Bulk:
    """Bulk processor of line chunks, by the submission service and by workers of its own."""

    def __init__(
        self,
        submissions: SubmissionService,
        record_blocks: RecordBlocks,
        store: Store,
        config: WorkerConfig,
        workers: int,
    ) -> None:
        """Prepare bulk processing; `record_blocks` records gyro blocks, see `Gyro.record_many`."""
        self.submissions = submissions
        self.record_blocks = record_blocks
        self._store = store
        self.later = store.writer.later
        self.workers: LocalWorkers[TelemetryLines, LineResult] = LocalWorkers(
            config, solve_lines, workers
        )

    def close(self) -> None:
        """Stop the workers; their unfinished work is lost."""
        self.workers.close()

    @property
    def max_pending(self) -> int:
        """Number of chunks to begin before the first of them is recorded.

        While single batches arrive as well, one worker less is used, so that a processor is free
        for them.
        """
        up = self.workers.up
        return up - 2 if up > 1 and self._gives_way else PENDING_A_WORKER * up

    @property
    def lines(self) -> int:
        """Number of lines that a chunk should have."""
        return FEW_LINES if self._gives_way else LINES

    @property
    def _gives_way(self) -> bool:
        """True while single batches arrive as well."""
        return self.submissions.idle_s < INTERACTIVE_WINDOW_S

    def begin(
        self, texts: Sequence[bytes], run: str, check: Check, require: Require = lambda: None
    ) -> "BulkChunk":
        """Start the computation of a chunk of lines; raises `Busy` if it cannot start yet.

        `require` is called before each portion that this process computes itself, and stops the
        chunk where it raises.
        """
        # Without kernels each worker would compile those it lacks.
        self.submissions.require_kernels()
        self.workers.start()
        self.submissions.yield_to_interactive()
        named = [identity_in(text, run) for text in texts]
        with self._store.reading_record() as connection:
            registry = look_up(connection, {each for each in named if each is not None})
            ids = {each.result_id for each in registry.identities.values()}
            stored = self._store.archive.answers_or_faults(connection, ids)
        known = frozenset(k for k, each in enumerate(named) if each in registry.identities)
        return BulkChunk(self, TelemetryLines(run, texts, known), check, require, registry, stored)

    def compute(self, lines: TelemetryLines, require: Require) -> "Future[list[LineResult]]":
        """Compute the results of lines in a worker, or in this process if there is none."""
        if self.workers.up:
            return self.workers.submit(lines)
        done: Future[list[LineResult]] = Future()
        done.set_result(self.compute_here(lines, require))
        return done

    def compute_here(self, lines: TelemetryLines, require: Require) -> list[LineResult]:
        """Compute the results of lines in this process; single posts go first."""
        solve = partial(self.submissions.solve_many, require=require)
        return line_results(lines, solve, self.submissions.solver.asks_for_last)

    def submit_tracked(self, line: TrackedLine) -> Answered | AcquisitionError:
        """Record a batch that asks for the last attitude, after all earlier lines."""
        self.submissions.yield_to_interactive()
        return self.submissions.submit_tracked(submission_from_json(line.text))


class BulkChunk:
    """Chunk of telemetry lines in progress: computed first, then recorded."""

    def __init__(
        self,
        bulk: Bulk,
        lines: TelemetryLines,
        check: Check,
        require: Require,
        registry: Registry,
        stored: Mapping[str, bytes | AcquisitionError],
    ) -> None:
        self._bulk, self._lines, self._check = bulk, lines, check
        self._require = require
        self._registry, self._stored = registry, stored
        self._blocks: Future[list[Recorded | AcquisitionError]] | None = None
        """Future outcomes of the gyro blocks, recorded or refused, in the order of their lines."""
        self._computed = bulk.compute(lines, require)

    def is_computed(self, within_s: float) -> bool:
        """Wait up to `within_s` seconds for the chunk's computation; True if it is done."""
        return bool(wait([self._computed], within_s).done)

    def queue_write(self) -> None:
        """Queue the computed results for the writer; after `Busy` it must be called again."""
        blocks = [each for each in self._decided if isinstance(each, GyroBlock)]
        if blocks and self._blocks is None:
            self._blocks = self._bulk.later(partial(self._bulk.record_blocks, blocks))
        unsaved_results = [each for each in self._decided if isinstance(each, UnsavedResult)]
        self._finish = self._bulk.submissions.begin_writing(unsaved_results)

    def cancel(self) -> None:
        """Cancel the chunk's computation, if it has not begun."""
        self._computed.cancel()

    def answers(self) -> list[LineAnswer]:
        """Wait until the chunk is recorded; the answer or error of each line."""
        written = iter(self._finish())
        blocks = iter(self._recorded_blocks())
        return [
            next(written)
            if isinstance(each, UnsavedResult)
            else next(blocks)
            if isinstance(each, GyroBlock)
            else self._tracked(each)
            if isinstance(each, TrackedLine)
            else each
            for each in self._decided
        ]

    def _tracked(self, line: TrackedLine) -> LineAnswer:
        self._require()
        return self._bulk.submit_tracked(line)

    def _recorded_blocks(self) -> list[Recorded | AcquisitionError]:
        if self._blocks is None:
            return []
        found = self._blocks.result()
        for each in found:
            if isinstance(each, Busy):
                # `Busy` decides nothing about the block.
                raise each
        return found

    @cached_property
    def _decided(self) -> list[Decided]:
        try:
            found = self._computed.result()
        except ChunkEndsWorkers as error:
            # Computed in this process, the line might end this process as well.
            names = identity_in(self._lines.texts[0], self._lines.run)
            refusal = AcquisitionError(f"computing the lines from {names} on failed: {error}")
            return [refusal] * len(self._lines.texts)
        except WorkerLost:
            found = self._bulk.compute_here(self._lines, self._require)
        return [
            self._decision(text, each) for text, each in zip(self._lines.texts, found, strict=True)
        ]

    def _decision(self, text: bytes, found: LineResult) -> Decided:
        try:
            if isinstance(found, GyroBlock):
                self._check(found.spacecraft)
                return found
            if isinstance(found, InvalidLine):
                if found.spacecraft is not None:
                    self._check(found.spacecraft)
                return found.error
            if isinstance(found, UnsavedResult | TrackedLine):
                self._check(found.identity[0])
                return found
            self._check(found.identity[0])
            return self._repeat(text, found)
        except Busy:
            # `Busy` decides nothing about the line.
            raise
        except AcquisitionError as error:
            return error

    def _repeat(
        self, text: bytes, seen: RecordedLine
    ) -> UnsavedResult | TrackedLine | Answered | AcquisitionError:
        first = self._registry.holder(seen.identity, None, seen.fingerprint)
        if isinstance(first, AcquisitionError):
            return first
        if first is None:
            # The quick look-up misread the line's identity: process the line as new.
            submission = submission_from_json(text, run=self._lines.run)
            if self._bulk.submissions.solver.asks_for_last(submission.batch):
                return TrackedLine(seen.identity, submission.text)
            (made,) = self._bulk.submissions.solve_many([submission])
            if isinstance(made, AcquisitionError):
                raise made
            return made
        answer = self._stored[first.result_id]
        if isinstance(answer, AcquisitionError):
            # The archive may be out of reach for long: do not delay the other lines.
            return answer
        return Answered(first.result_id, answer, replayed=True)
