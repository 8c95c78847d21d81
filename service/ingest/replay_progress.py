"""The progress of a running replay: counted here, stored in its row, reported by events."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future

import msgspec
from msgspec import UNSET, structs
from sqlalchemy import Connection

from service.errors import AcquisitionError, Stopping, problem_of
from service.packets.reader import PacketTotals
from service.storage.gyro import Recorded
from service.storage.models import runs as records
from service.storage.models.base import FieldFault
from service.storage.queries.replays import (
    CANCELLED,
    insert_replay,
    is_cancelled,
    update_replay,
)
from service.storage.recording import events
from service.storage.recording.unsaved_result import Answered
from service.storage.store import Store

MAX_ERRORS_KEPT = 1_000
MAX_FAULTS_KEPT = 3
"""The most faults of one line: each chunk that adds some stores all again, read as a whole."""
MAX_TEXT_KEPT = 300
MAX_APIDS_KEPT = 100
"""The application ids with the most packets are kept; the sums are of all."""
SAVE_EVERY_S = 0.2
"""The time between two stored states: each is a transaction, and an event for all listeners."""
SAVE_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0

log = logging.getLogger(__name__)


class _CountedAnswer(msgspec.Struct):
    """The part of an answer that is counted."""

    counts: dict[str, int]
    attitude: msgspec.Raw


_COUNTED = msgspec.json.Decoder(_CountedAnswer)


class ProgressRecorder:
    """Counts what came of the lines of one replay, and stores it."""

    def __init__(
        self,
        store: Store,
        now: Callable[[], str],
        replay: records.Replay,
        on_cancelled: Callable[[], object],
    ) -> None:
        """`on_cancelled` is called in the writer's thread where the row says `cancelled`."""
        self._store = store
        self._now = now
        self._on_cancelled = on_cancelled
        self._started_as = replay.progress()
        self._counts: Counter[str] = Counter(structs.asdict(replay.counts))
        self.lines_done = replay.lines.done
        """The number of the last line whose batch is recorded."""
        self._refused = replay.lines.refused
        self._errors = list(replay.errors)
        self._errors_changed = False
        self.packets: Callable[[], PacketTotals | None] = lambda: None
        """The counts of the packets that the lines are made of."""
        self._saving: Future[None] | None = None
        self._is_saved = True
        self._saved_s = 0.0

    @property
    def id(self) -> str:
        """The id of the replay."""
        return self._started_as.id

    @property
    def run(self) -> str:
        """The run that the batches go to."""
        return self._started_as.run

    def insert(self, also: Callable[[Connection], object]) -> None:
        """Store the replay as new; `also` is called in the same transaction."""
        progress = self._progress("running", None)
        replay = records.Replay(
            **structs.asdict(progress), packets=self._packet_counts(), errors=[]
        )

        def store(connection: Connection) -> None:
            insert_replay(connection, replay)
            also(connection)
            events.add_event(connection, "replay", progress, run=self.run)

        self._store.writer.change(store).result()

    def count(self, answered: Answered | Recorded) -> None:
        """Count the answer to one line."""
        if isinstance(answered, Recorded):
            self._counts["gyro_repeated" if answered.replayed else "gyro_new"] += 1
            return
        answer = _COUNTED.decode(answered.body)
        self._counts["repeated" if answered.replayed else "new"] += 1
        self._counts["attitudes"] += bytes(answer.attitude) != b"null"
        self._counts.update(answer.counts)

    def refuse(self, number: int, error: Exception, *, ends: bool = False) -> None:
        """Count a refused line; an error that `ends` the replay is kept in any case."""
        self._refused += 1
        if len(self._errors) < MAX_ERRORS_KEPT or ends:
            self._errors.append(records.RefusedLine(line=number, problem=_shortened_problem(error)))
            self._errors_changed = True

    def save_sometimes(self) -> None:
        """Store how far the replay is, unless that was done a moment ago."""
        if time.monotonic() - self._saved_s > SAVE_EVERY_S:
            self.save("running")
            self._saved_s = time.monotonic()

    def save(self, state: records.ReplayStateName, finished: str | None = None) -> None:
        """Queue the present progress for the writer; it is stored while the next chunk is solved.

        A replay that another process has cancelled stays cancelled.
        """
        progress = self._progress(state, finished)
        errors = list(self._errors) if self._errors_changed else None
        packets = self._packet_counts()

        def store(connection: Connection) -> None:
            stored = progress
            if is_cancelled(connection, self.id):
                self._on_cancelled()
                ended = finished or self._now()
                stored = structs.replace(progress, state=CANCELLED, finished=ended)
            update_replay(connection, stored, packets, errors)
            events.add_event(connection, "replay", stored, run=self.run)

        self.require_saved()
        self._errors_changed, self._is_saved = False, True
        try:
            self._saving = self._store.writer.change(store)
        except AcquisitionError as error:
            self._not_saved(error)

    def require_saved(self) -> None:
        """Wait until the progress that was last queued is stored, or has failed to be."""
        saving, self._saving = self._saving, None
        if saving is None:
            return
        try:
            saving.result()
        except Exception as error:
            self._not_saved(error)

    def conclude(self, state: records.ReplayStateName, closing: threading.Event) -> None:
        """Store the state at the end; try again until that succeeds or the service closes.

        Nothing else would say that the replay is over.
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

    def _packet_counts(self) -> records.ReplayPackets | None:
        totals = self.packets()
        if totals is None:
            return None
        most = sorted(totals.apids, key=lambda each: -each.packets)[:MAX_APIDS_KEPT]
        kept = structs.replace(totals, apids=sorted(most, key=lambda each: each.apid))
        return msgspec.convert(msgspec.to_builtins(kept), records.ReplayPackets)

    def _not_saved(self, error: Exception) -> None:
        # The next save has the same and more; the batches themselves are recorded.
        self._errors_changed = True
        # While the service stops nothing is stored; the next start marks it as interrupted.
        self._is_saved = isinstance(error, Stopping)
        log.warning("progress of replay %s not stored: %s", self.id, error)


def _shortened_problem(error: Exception) -> records.LineProblem:
    """The problem of a line: its first faults, long texts shortened."""
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
