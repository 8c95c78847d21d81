"""Replays on the server: a telemetry file worked through in the background, a batch a line."""

import json
import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, TypeVar

import msgspec
from sqlalchemy import Connection, insert, select, update

from service.errors import (
    AcquisitionError,
    BadBatch,
    BadInput,
    Busy,
    Fault,
    NotFound,
    Stopping,
    WrongState,
    problem_of,
    shown_value,
)
from service.ingest.bulk import Bulk, Check, Chunk
from service.ingest.submit import Answers
from service.storage.recording import events
from service.storage.recording.unsaved_result import Answered, Row
from service.storage.sql.database import Store
from service.storage.sql.tables import replays

MAX_ERRORS_KEPT = 1_000
MAX_LISTED = 100
MAX_FAULTS_KEPT = 3
"""Of one line: they are written anew with every chunk that adds to them, and read as a whole."""
MAX_TEXT_KEPT = 300
BUSY_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
MAX_BLANK_LINES = 1_000_000
"""Of a file.  They hold nothing, and five gigabytes of them pack to five megabytes."""
STOP_WITHIN_S = 0.2
PROGRESS_S = 0.2
"""Between two notes of how far a replay is: each is a transaction, and told to all who listen."""

CANCELLED = "cancelled"
COUNTED = ("new", "repeated", "observed", "unique", "ambiguous", "unmatched", "attitudes")
"""What a replay counts: batches by whether they were recorded before, their stars, attitudes."""

log = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass
class _Begun:
    """A chunk that is being computed or written."""

    lines: "_Lines"
    chunk: Chunk


@dataclass
class _Lines:
    """Some lines of a file: the number of the last one, and those that are not blank."""

    last: int
    numbers: list[int]
    texts: list[bytes]


def read_replay(connection: Connection, id: str) -> Row:
    """A replay and its progress; raises `NotFound`."""
    row = connection.execute(select(replays).where(replays.c.id == id)).mappings().first()
    if row is None:
        raise NotFound(f"there is no replay with the id {shown_value(id)}")
    return _whole(row)


def list_replays(connection: Connection) -> list[Row]:
    """The latest replays and their progress, newest first."""
    query = select(replays).order_by(replays.c.id.desc()).limit(MAX_LISTED)
    return [_whole(row) for row in connection.execute(query).mappings()]


def _whole(row: Any) -> Row:
    return replay_state(row) | {"errors": json.loads(row["errors"])}


def replay_state(row: Any) -> Row:
    """How far a replay is, without its errors."""
    return {
        "id": row["id"],
        "run": row["run"],
        "name": row["name"],
        "state": row["state"],
        "lines": {
            "total": row["lines_total"],
            "done": row["lines_done"],
            "refused": row["lines_refused"],
        },
        "counts": dict.fromkeys(COUNTED, 0) | json.loads(row["counts"] or "{}"),
        "started": row["started"],
        "finished": row["finished"],
    }


def read_replay_row(connection: Connection, id: str) -> Row | None:
    """A replay as the table has it; None where there is none."""
    row = connection.execute(select(replays).where(replays.c.id == id)).mappings().first()
    return None if row is None else dict(row)


def mark_interrupted(connection: Connection, now: str) -> None:
    """Close the replays that a stopped process left unfinished.

    One that another process is still at says `running` again with its next
    lines.
    """
    connection.execute(
        update(replays)
        .where(replays.c.state == "running")
        .values(state="interrupted", finished=now)
    )


def mark_cancelled(connection: Connection, id: str, now: str) -> None:
    """Close a running replay of another process, which ends it when it next notes its progress.

    Raises `NotFound`, and `WrongState` for one that has ended.
    """
    row = read_replay(connection, id)
    require_cancellable(row["state"])
    if row["state"] == "running":
        ended = {"state": CANCELLED, "finished": now}
        connection.execute(update(replays).where(replays.c.id == id).values(ended))
        told = {name: each for name, each in (row | ended).items() if name != "errors"}
        events.note(connection, "replay", told, run=row["run"])


def require_cancellable(state: str) -> None:
    """Raise `WrongState` for the state of a replay that has ended otherwise."""
    if state not in ("running", CANCELLED):
        raise WrongState(f"the replay has ended already, its state is {state}")


class _Counted(msgspec.Struct):
    """The part of an answer that is counted."""

    counts: dict[str, int]
    attitude: msgspec.Raw


_COUNTED = msgspec.json.Decoder(_Counted)


class Replay:
    """One replay at work; its progress is in the table, a moment late."""

    def __init__(
        self,
        store: Store,
        bulk: Bulk,
        now: Callable[[], str],
        row: Row,
        check: Check,
        owner: str | None,
        longest_s: float,
        ended: Callable[[str], object] = lambda state: None,
    ) -> None:
        """`owner` is the token that it was started with; it may take `longest_s` at most.

        `ended` is called with its state in the end.
        """
        self._ended = ended
        self._skipped = 0
        self._store = store
        self._bulk = bulk
        self._now = now
        self._row = row
        self._check = check
        self.owner = owner
        self._longest_s = longest_s
        self._until_s = time.monotonic() + longest_s
        self._counts: Counter[str] = Counter()
        self._errors: list[Row] = []
        self._errors_changed = False
        self._noting: Future[None] | None = None
        self._noted = True
        self._ahead: deque[_Begun] = deque()
        self._written: _Begun | None = None
        self._saved_s = 0.0
        self._stopping = threading.Event()
        self._closing = threading.Event()
        self._cancelled = False
        self._over = threading.Event()

    @property
    def id(self) -> str:
        """Its id."""
        return str(self._row["id"])

    def start(self, lines: Iterable[bytes], also: Callable[[Connection], object]) -> None:
        """Note the replay in the table and begin in a thread; `lines` are closed at the end.

        `also` is called in the transaction that notes it.
        """
        try:
            self._note(also)
            self._begin_work(lines)
        except BaseException:
            self._over.set()
            raise

    def give_up(self) -> None:
        """Free its slot: it could not be started."""
        self._over.set()

    def resume(self, lines: Iterable[bytes]) -> None:
        """Go on after the last line that an earlier process noted; its row was given."""
        self._counts.update(json.loads(self._row["counts"] or "{}"))
        self._errors = json.loads(self._row["errors"])
        self._skipped = self._row["lines_done"]
        self._save(state="running", finished=None)
        self._require_noted()
        self._begin_work(lines)

    def _begin_work(self, lines: Iterable[bytes]) -> None:
        name = f"replay-{self._row['id']}"
        threading.Thread(target=self._work, args=(lines,), name=name).start()

    def _note(self, also: Callable[[Connection], object]) -> None:
        row = self._row | {
            "state": "running",
            "lines_done": 0,
            "lines_refused": 0,
            "errors": "[]",
            "counts": "{}",
            "started": self._now(),
        }
        self._row = row

        def begin(connection: Connection) -> None:
            connection.execute(insert(replays), row)
            also(connection)
            events.note(connection, "replay", self._state(), run=row["run"])

        self._store.writer.change(begin).result()

    @property
    def is_over(self) -> bool:
        """Whether nothing more will come of it; one that is about to begin is not over."""
        return self._over.is_set()

    def stop(self) -> None:
        """Let it end after the chunk that is being written: the service closes."""
        self._closing.set()
        self._stopping.set()

    def cancel(self) -> None:
        """Let it end after the chunk that is being written: a client asked for that."""
        self._cancelled = True
        self._stopping.set()

    def wait(self, longest_s: float | None = None) -> None:
        """Return when it is over, or after so many seconds."""
        self._over.wait(longest_s)

    def require_going_on(self) -> None:
        """Raise `Busy` where the replay is to stop, `BadBatch` where its time is over."""
        if self._stopping.is_set():
            raise Busy("the replay is to stop", round(BUSY_PAUSE_S) or 1)
        if time.monotonic() > self._until_s:
            message = (
                f"took longer than {self._longest_s:g} s (ACQUIRE_REPLAY_SECONDS); send it again "
                "to go on: nothing is recorded twice"
            )
            raise BadBatch(Fault("body", message))

    def _work(self, lines: Iterable[bytes]) -> None:
        state = "failed"
        try:
            state = self._worked_through(lines)
        except Busy:
            state = "interrupted"
        except BadInput as error:
            # The file itself, from here on: its lines before are recorded.
            self._refuse(self._row["lines_done"] + 1, error, ends=True)
        except Exception as error:
            log.exception("replay %s failed", self._row["id"])
            self._refuse(self._row["lines_done"] + 1, error, ends=True)
        finally:
            try:
                close: Callable[[], Any] | None = getattr(lines, "close", None)
                if close is not None:
                    close()
                state = CANCELLED if self._cancelled and state == "interrupted" else state
                self._conclude(state)
                self._ended(state)
            finally:
                self._over.set()

    def _conclude(self, state: str) -> None:
        """Note how it ended, as often as it takes: nothing else would say that it is over."""
        pause_s = BUSY_PAUSE_S
        while True:
            self._save(state=state, finished=self._now())
            self._require_noted()
            if self._noted or self._closing.wait(pause_s):
                return
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)

    def _worked_through(self, lines: Iterable[bytes]) -> str:
        """The state in the end; while a chunk is written, those after it are computed."""
        try:
            try:
                for some in self._chunks(lines):
                    if self._stopping.is_set():
                        return "interrupted"
                    self._ahead.append(self._begin(some))
                    self._hand_on(self._bulk.ahead)
            finally:
                # Where the lines break off, those before are recorded all the same.
                if not self._stopping.is_set():
                    self._hand_on(0)
            return "interrupted" if self._ahead else "done"
        finally:
            for begun in self._ahead:
                begun.chunk.give_up()
            self._finish(self._written)

    def _chunks(self, lines: Iterable[bytes]) -> Iterator[_Lines]:
        """The lines, so many at a time as are computed together.

        Raises `BadBatch` where there are too many blank ones.
        """
        some, read, handed, blank = _Lines(0, [], []), 0, 0, 0
        try:
            for line in lines:
                self.require_going_on()
                read += 1
                if read <= self._skipped:
                    handed = read
                    continue
                if line.strip():
                    some.numbers.append(read)
                    some.texts.append(line.rstrip(b"\r\n"))
                else:
                    blank += 1
                    if blank > MAX_BLANK_LINES:
                        message = f"has more than {MAX_BLANK_LINES} blank lines"
                        raise BadBatch(Fault("body", message))
                some.last = read
                if len(some.texts) >= self._bulk.lines:
                    yield some
                    some, handed = _Lines(0, [], []), read
        except BadInput:
            # Damage and bounds end the file; the lines before it are whole.
            if some.last > handed:
                yield some
            raise
        if some.last > handed:
            yield some

    def _begin(self, lines: _Lines) -> _Begun:
        return _Begun(lines, self._patiently(self._chunk, lines.texts))

    def _chunk(self, texts: list[bytes]) -> Chunk:
        return self._bulk.begin(texts, self._row["run"], self._check, self.require_going_on)

    def _hand_on(self, left: int) -> None:
        """Queue chunks for the writer, one after the other, until so many are left."""
        while len(self._ahead) > left:
            # Others' chunks may come before: a replay that is to stop does not wait for them.
            while not self._ahead[0].chunk.is_computed(STOP_WITHIN_S):
                self.require_going_on()
            self._patiently(self._ahead[0].chunk.hand_on)
            before, self._written = self._written, self._ahead.popleft()
            self._finish(before)

    def _finish(self, begun: _Begun | None) -> None:
        """Count what came of a chunk, once it is recorded."""
        if begun is None:
            return
        try:
            answers = begun.chunk.answers()
        except Stopping:
            raise
        except Busy:
            answers = self._again(begun.lines.texts)
        for number, answer in zip(begun.lines.numbers, answers, strict=True):
            if isinstance(answer, AcquisitionError):
                self._refuse(number, answer)
            else:
                self._count(answer)
        self._row["lines_done"] = begun.lines.last
        if time.monotonic() - self._saved_s > PROGRESS_S:
            self._save(state="running", finished=None)
            self._saved_s = time.monotonic()

    def _patiently(self, call: Callable[..., T], *given: Any) -> T:
        while True:
            try:
                return call(*given)
            except Stopping:
                raise
            except Busy:
                self._pause()

    def _again(self, texts: list[bytes]) -> Answers:
        while True:
            self._pause()
            chunk = self._patiently(self._chunk, texts)
            self._patiently(chunk.hand_on)
            try:
                return chunk.answers()
            except Stopping:
                raise
            except Busy:
                continue

    def _pause(self) -> None:
        """Wait: a replay has time, and whoever posts single batches goes first."""
        self._stopping.wait(BUSY_PAUSE_S)
        self.require_going_on()

    def _count(self, outcome: Answered) -> None:
        answer = _COUNTED.decode(outcome.body)
        self._counts["repeated" if outcome.replayed else "new"] += 1
        self._counts["attitudes"] += bytes(answer.attitude) != b"null"
        self._counts.update(answer.counts)

    def _state(self) -> Row:
        return replay_state({"finished": None} | self._row)

    def _refuse(self, number: int, error: Exception, *, ends: bool = False) -> None:
        """Note what is wrong with a line; what `ends` the replay is kept in any case."""
        self._row["lines_refused"] += 1
        if len(self._errors) < MAX_ERRORS_KEPT or ends:
            self._errors.append({"line": number, "problem": _kept(problem_of(error))})
            self._errors_changed = True

    def _save(self, **changed: Any) -> None:
        names = ("lines_done", "lines_refused")
        values = {n: self._row[n] for n in names} | changed
        values["counts"] = json.dumps(self._counts)
        if self._errors_changed:
            values["errors"] = json.dumps(self._errors)
        self._row |= values
        # As it is now: it is written while the next chunk is at work.
        state = self._state()

        this = replays.c.id == self.id

        def save(connection: Connection) -> None:
            if connection.scalar(select(replays.c.state).where(this)) == CANCELLED:
                # By another process, or by this one in its last note.
                self.cancel()
                values["state"] = state["state"] = CANCELLED
                values["finished"] = state["finished"] = changed["finished"] or self._now()
            connection.execute(update(replays).where(this).values(values))
            events.note(connection, "replay", state, run=state["run"])

        self._require_noted()
        self._errors_changed, self._noted = False, True
        try:
            self._noting = self._store.writer.change(save)
        except AcquisitionError as error:
            self._not_noted(error)

    def _require_noted(self) -> None:
        """Wait until the progress that was last told is stored."""
        noting, self._noting = self._noting, None
        if noting is None:
            return
        try:
            noting.result()
        except Exception as error:
            self._not_noted(error)

    def _not_noted(self, error: Exception) -> None:
        # The next chunk says how far it is; the batches themselves are recorded.
        self._errors_changed = True
        # Where nothing is written any more, the next start says that it was interrupted.
        self._noted = isinstance(error, Stopping)
        log.warning("progress of replay %s not noted: %s", self._row["id"], error)


def _kept(problem: Row) -> Row:
    """A problem as it is kept: the first faults, and no text longer than anybody reads."""
    kept: Row = {"detail": _cut(problem["detail"])}
    if "errors" in problem:
        kept["errors"] = [
            {name: text if text is None else _cut(text) for name, text in fault.items()}
            for fault in problem["errors"][:MAX_FAULTS_KEPT]
        ]
    return kept


def _cut(text: str) -> str:
    return text if len(text) <= MAX_TEXT_KEPT else text[: MAX_TEXT_KEPT - 1] + "…"
