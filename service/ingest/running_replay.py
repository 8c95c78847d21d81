"""Replays on the server: telemetry files processed in the background, a batch a line.

The progress of a replay is counted here, stored in its row, and reported by events.
"""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol, TypeVar, runtime_checkable

import msgspec
from msgspec import UNSET, structs
from sqlalchemy import Connection

from service.contract import runs as records
from service.contract.problems import FieldFault
from service.contract.runs import Replay, ReplayStateName
from service.errors import AcquisitionError, BadBatch, BadInput, Busy, Fault, Stopping, problem_of
from service.ingest.bulk import Bulk, BulkChunk, Check, LineAnswer
from service.observations.decompress import Line
from service.storage.gyro import Recorded
from service.storage.queries import replay_rows
from service.storage.recording import events
from service.storage.recording.unsaved_result import Answered
from service.storage.store import Store

MAX_ERRORS_KEPT = 1_000
MAX_FAULTS_KEPT = 3
"""Largest number of faults kept for a refused line: all are stored again with each change."""
MAX_TEXT_KEPT = 300
SAVE_EVERY_S = 0.2
"""Seconds between stored states of a replay: each is a transaction, and an event to listeners."""
SAVE_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0

log = logging.getLogger(__name__)


class _CountedAnswer(msgspec.Struct):
    """The part of an answer that a replay counts."""

    counts: dict[str, int]
    attitude: msgspec.Raw


_COUNTED = msgspec.json.Decoder(_CountedAnswer)


class ProgressRecorder:
    """Recorder of a replay's progress, which counts the outcomes of its lines and stores them."""

    def __init__(
        self,
        store: Store,
        now: Callable[[], str],
        replay: records.Replay,
        on_cancelled: Callable[[], object],
    ) -> None:
        """Begin to record; the writer's thread calls `on_cancelled` if the row says `cancelled`."""
        self._store = store
        self._now = now
        self._on_cancelled = on_cancelled
        self._started_as = replay.progress()
        self._counts: Counter[str] = Counter(structs.asdict(replay.counts))
        self.lines_done = replay.lines.done
        """Number of the last line whose batch is recorded."""
        self._refused = replay.lines.refused
        self._errors = list(replay.errors)
        self._errors_changed = False
        self.packet_counts: Callable[[], records.ReplayPackets | None] = lambda: None
        """Function that returns the counts of the packets from which the lines are made."""
        self._saving: Future[None] | None = None
        self._is_saved = True
        self._saved_s = 0.0

    @property
    def id(self) -> str:
        """Id of the replay."""
        return self._started_as.id

    @property
    def run(self) -> str:
        """Name of the run that gets the batches."""
        return self._started_as.run

    def insert(self, also: Callable[[Connection], object]) -> None:
        """Store a new replay; `also` is called in the same transaction."""
        progress = self._progress("running", None)
        replay = records.Replay(**structs.asdict(progress), packets=self.packet_counts(), errors=[])

        def store(connection: Connection) -> None:
            replay_rows.insert_replay(connection, replay)
            also(connection)
            events.add_event(connection, "replay", progress, run=self.run)

        self._store.writer.change(store)

    def count(self, answered: Answered | Recorded) -> None:
        """Count the answer to one line."""
        if isinstance(answered, Recorded):
            self._counts["gyro_repeated" if answered.replayed else "gyro_new"] += 1
            return
        answer = _COUNTED.decode(answered.body)
        self._counts["repeated" if answered.replayed else "new"] += 1
        self._counts["attitudes"] += bytes(answer.attitude) != b"null"
        self._counts.update(answer.counts)

    @property
    def has_recorded(self) -> bool:
        """True if a batch or a gyro block of the file is recorded."""
        recorded = ("new", "repeated", "gyro_new", "gyro_repeated")
        return any(self._counts[name] for name in recorded)

    def refuse(self, number: int, error: Exception, *, ends: bool = False) -> None:
        """Count a refused line; its error is kept if there is room, or if it ends the replay."""
        self._refused += 1
        if len(self._errors) < MAX_ERRORS_KEPT or ends:
            self._errors.append(records.RefusedLine(line=number, problem=_shortened_problem(error)))
            self._errors_changed = True

    def save_sometimes(self) -> None:
        """Store the replay's progress, unless that was done a moment ago."""
        if time.monotonic() - self._saved_s > SAVE_EVERY_S:
            self.save("running")
            self._saved_s = time.monotonic()

    def save(self, state: records.ReplayStateName, finished: str | None = None) -> None:
        """Queue the replay's progress for the writer; it is stored while the next chunk is solved.

        A replay cancelled by another process stays cancelled.
        """
        progress = self._progress(state, finished)
        errors = list(self._errors) if self._errors_changed else None
        packets = self.packet_counts()

        def store(connection: Connection) -> None:
            stored = progress
            if replay_rows.is_cancelled(connection, self.id):
                self._on_cancelled()
                ended = finished or self._now()
                stored = structs.replace(progress, state=replay_rows.CANCELLED, finished=ended)
            replay_rows.update_replay(connection, stored, packets, errors)
            events.add_event(connection, "replay", stored, run=self.run)

        self.require_saved()
        self._errors_changed, self._is_saved = False, True
        try:
            self._saving = self._store.writer.later(partial(self._store.writer.change, store))
        except AcquisitionError as error:
            self._not_saved(error)

    def require_saved(self) -> None:
        """Wait until the progress queued last is stored, or its storage has failed."""
        saving, self._saving = self._saving, None
        if saving is None:
            return
        try:
            saving.result()
        except Exception as error:
            self._not_saved(error)

    def conclude(self, state: records.ReplayStateName, closing: threading.Event) -> None:
        """Store the final state of a replay; repeats until that succeeds or the service closes.

        Otherwise the replay would still appear to be running.
        """
        pause_s = SAVE_PAUSE_S
        while True:
            self.save(state, self._now())
            self.require_saved()
            if self._is_saved or closing.wait(pause_s):
                return
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)

    def _progress(
        self, state: records.ReplayStateName, finished: str | None
    ) -> records.ReplayProgress:
        total = self._started_as.lines.total
        return structs.replace(
            self._started_as,
            state=state,
            lines=records.ReplayLines(total=total, done=self.lines_done, refused=self._refused),
            counts=records.ReplayCounts(
                **{name: self._counts[name] for name in records.ReplayCounts.__struct_fields__}
            ),
            finished=finished,
        )

    def _not_saved(self, error: Exception) -> None:
        # The next save has the same counts and more; the batches themselves are recorded.
        self._errors_changed = True
        # While the service stops nothing is stored; the next start marks the replay as interrupted.
        self._is_saved = isinstance(error, Stopping)
        log.warning("progress of replay %s not stored: %s", self.id, error)


def _shortened_problem(error: Exception) -> records.LineProblem:
    """Problem of a refused line: its first faults, with long texts shortened."""
    problem = problem_of(error)
    if "errors" not in problem:
        return records.LineProblem(detail=_shortened(problem["detail"]), errors=UNSET)
    faults = [
        FieldFault(**{name: text and _shortened(text) for name, text in fault.items()})
        for fault in problem["errors"][:MAX_FAULTS_KEPT]
    ]
    return records.LineProblem(detail=_shortened(problem["detail"]), errors=faults)


def _shortened(text: str) -> str:
    return text if len(text) <= MAX_TEXT_KEPT else text[: MAX_TEXT_KEPT - 1] + "…"


BUSY_PAUSE_S = 0.5


T = TypeVar("T")


@runtime_checkable
class CountedLines(Protocol):
    """Telemetry lines decoded from an upload of packets, with the counts of these packets."""

    spacecraft: str
    """Name of the mission that the lines belong to."""

    def __iter__(self) -> Iterator[Line]:
        """Iterate over the batches and gyro blocks, only once."""

    def counts(self) -> records.ReplayPackets:
        """Counts of the packets from which the lines read so far were made."""

    def close(self) -> None:
        """Close the uploaded file."""


ReplaySource = Iterable[bytes | Line] | CountedLines


# The lines of a telemetry file, in groups that are computed together.
#
# A line is text, or a `Line` with its own number and perhaps a fault instead of text: batches from
# space packets have the numbers of their packets.

MAX_BLANK_LINES = 1_000_000
"""Largest number of blank lines in a file: five gigabytes of them compress to five megabytes."""


@dataclass
class LineGroup:
    """Group of a file's lines that are not blank, with their numbers from 1.

    `last` is the number of the last line read, blank or not.
    """

    last: int = 0
    numbers: list[int] = field(default_factory=list)
    texts: list[bytes] = field(default_factory=list)
    faults: list[tuple[int, Fault]] = field(default_factory=list)
    """Faults of lines that were refused on reading, with line numbers."""

    def __len__(self) -> int:
        return len(self.texts) + len(self.faults)

    def add(self, line: Line) -> None:
        """Add a line to the group, or its fault."""
        if line.body is None:
            assert line.fault is not None
            self.faults.append((line.number, line.fault))
        else:
            self.numbers.append(line.number)
            self.texts.append(line.body)


def line_groups(
    lines: Iterable[bytes | Line],
    skipped: int,
    size: Callable[[], int],
    require: Callable[[], object],
) -> Iterator[LineGroup]:
    """Group the lines after the first `skipped` ones, `size` lines in each group.

    `require` is called before each line, and stops the reading where it raises.  Raises `BadBatch`
    for too many blank lines.
    """
    group, read, handed, blank = LineGroup(), 0, 0, 0
    try:
        for line in lines:
            require()
            read += 1
            if read <= skipped:
                handed = read
                continue
            if isinstance(line, Line):
                group.add(line)
            elif line.strip():
                group.add(Line(read, line.rstrip(b"\r\n")))
            else:
                blank += 1
                if blank > MAX_BLANK_LINES:
                    raise BadBatch(Fault("body", f"has more than {MAX_BLANK_LINES} blank lines"))
            group.last = read
            if len(group) >= size():
                yield group
                group, handed = LineGroup(), read
    except BadInput:
        # A damaged or too long file ends here; the lines before the fault are valid.
        if group.last > handed:
            yield group
        raise
    if group.last > handed:
        yield group


@dataclass
class _PendingChunk:
    """Group of a replay's lines with its chunk, which is being computed or written."""

    lines: LineGroup
    chunk: BulkChunk


class RunningReplay:
    """A replay in progress; the database's table shows its progress with a short delay."""

    def __init__(
        self,
        store: Store,
        bulk: Bulk,
        now: Callable[[], str],
        replay: Replay,
        check: Check,
        owner: str | None,
        longest_s: float,
        ended: Callable[[str], object] = lambda state: None,
    ) -> None:
        """Prepare a replay; `owner` is the token that started it, `longest_s` its time limit.

        `ended` is called with the final state.
        """
        self._ended = ended
        self._skipped = replay.lines.done
        self._progress = ProgressRecorder(store, now, replay, self.cancel)
        self._bulk = bulk
        self._check = check
        self.owner = owner
        self._longest_s = longest_s
        self._until_s = time.monotonic() + longest_s
        self._computing: deque[_PendingChunk] = deque()
        self._writing: _PendingChunk | None = None
        self._stopping = threading.Event()
        self._closing = threading.Event()
        self._cancelled = False
        self._over = threading.Event()

    @property
    def id(self) -> str:
        """Id of the replay."""
        return self._progress.id

    def start(self, lines: ReplaySource, also: Callable[[Connection], object]) -> None:
        """Store the replay as new and start its thread; `lines` are closed at the end.

        `also` is called in the transaction that stores it.
        """
        try:
            self._progress.insert(also)
            self._start_thread(lines)
        except BaseException:
            self._over.set()
            raise

    def release_slot(self) -> None:
        """Mark the replay as over, since it could not be started."""
        self._over.set()

    def resume(self, lines: ReplaySource) -> None:
        """Start the replay again, after the last line that an earlier process stored as done."""
        self._progress.save("running")
        self._progress.require_saved()
        self._start_thread(lines)

    def _start_thread(self, lines: ReplaySource) -> None:
        if isinstance(lines, CountedLines):
            self._progress.packet_counts = lines.counts
        threading.Thread(target=self._work, args=(lines,), name=f"replay-{self.id}").start()

    @property
    def is_over(self) -> bool:
        """True if the replay has ended; False before its start."""
        return self._over.is_set()

    def stop(self) -> None:
        """Stop the replay after the chunk being written, because the service closes."""
        self._closing.set()
        self._stopping.set()

    def cancel(self) -> None:
        """Stop the replay after the chunk being written, because a client cancelled it."""
        self._cancelled = True
        self._stopping.set()

    def wait(self, longest_s: float | None = None) -> None:
        """Wait until the replay is over, at most `longest_s` seconds."""
        self._over.wait(longest_s)

    def require_going_on(self) -> None:
        """Raise `Busy` if the replay is to stop, `BadBatch` if its time is over."""
        if self._stopping.is_set():
            raise Busy("the replay is stopping", round(BUSY_PAUSE_S) or 1)
        if time.monotonic() > self._until_s:
            message = (
                f"took longer than {self._longest_s:g} s (ACQUIRE_REPLAY_SECONDS); send it again "
                "to go on: nothing is recorded twice"
            )
            raise BadBatch(Fault("body", message))

    def _work(self, lines: ReplaySource) -> None:
        state: ReplayStateName = "failed"
        try:
            state = self._process(lines)
        except Busy:
            state = "interrupted"
        except BadInput as error:
            # The file itself has a fault; the lines before it are recorded.
            self._progress.refuse(self._progress.lines_done + 1, error, ends=True)
        except Exception as error:
            log.exception("replay %s failed", self.id)
            self._progress.refuse(self._progress.lines_done + 1, error, ends=True)
        finally:
            try:
                close: Callable[[], Any] | None = getattr(lines, "close", None)
                if close is not None:
                    close()
                if self._cancelled and state == "interrupted":
                    state = replay_rows.CANCELLED
                self._progress.conclude(state, self._closing)
                self._ended(state)
            finally:
                self._over.set()

    def _process(self, lines: ReplaySource) -> ReplayStateName:
        """Process all lines and return the final state; computing and writing overlap."""
        groups = line_groups(lines, self._skipped, lambda: self._bulk.lines, self.require_going_on)
        try:
            try:
                for group in groups:
                    if self._stopping.is_set():
                        return "interrupted"
                    chunk = self._retry_while_busy(self._begin, group.texts)
                    self._computing.append(_PendingChunk(group, chunk))
                    self._write_until(self._bulk.max_pending)
            finally:
                # After a damaged line the chunks before it are still written.
                if not self._stopping.is_set():
                    self._write_until(0)
            if self._computing:
                return "interrupted"
            return "done" if self._finished_all() else "failed"
        finally:
            for pending in self._computing:
                pending.chunk.cancel()
            self._finish(self._writing)

    def _finished_all(self) -> bool:
        """Wait for the last chunk; True if any data of the file are recorded."""
        self._finish(self._writing)
        self._writing = None
        return self._progress.has_recorded

    def _begin(self, texts: list[bytes]) -> BulkChunk:
        return self._bulk.begin(texts, self._progress.run, self._check, self.require_going_on)

    def _write_until(self, left: int) -> None:
        """Queue chunks for the writer, oldest first, until `left` chunks remain."""
        while len(self._computing) > left:
            # Chunks of other replays may be computed first: a stopping replay does not wait for
            # them.
            while not self._computing[0].chunk.is_computed(0.2):
                self.require_going_on()
            self._retry_while_busy(self._computing[0].chunk.queue_write)
            before, self._writing = self._writing, self._computing.popleft()
            self._finish(before)

    def _finish(self, pending: _PendingChunk | None) -> None:
        """Wait until a chunk is recorded, and count its answers."""
        if pending is None:
            return
        try:
            answers = pending.chunk.answers()
        except Stopping:
            raise
        except Busy:
            answers = self._compute_again(pending.lines.texts)
        for number, fault in pending.lines.faults:
            self._progress.refuse(number, BadBatch(fault))
        for number, answer in zip(pending.lines.numbers, answers, strict=True):
            if isinstance(answer, AcquisitionError):
                self._progress.refuse(number, answer)
            else:
                self._progress.count(answer)
        self._progress.lines_done = pending.lines.last
        self._progress.save_sometimes()

    def _retry_while_busy(self, call: Callable[..., T], *arguments: Any) -> T:
        while True:
            try:
                return call(*arguments)
            except Stopping:
                raise
            except Busy:
                self._pause()

    def _compute_again(self, texts: list[bytes]) -> list[LineAnswer]:
        while True:
            self._pause()
            chunk = self._retry_while_busy(self._begin, texts)
            self._retry_while_busy(chunk.queue_write)
            try:
                return chunk.answers()
            except Stopping:
                raise
            except Busy:
                continue

    def _pause(self) -> None:
        """Pause, since single batches take precedence over a replay."""
        self._stopping.wait(BUSY_PAUSE_S)
        self.require_going_on()
