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
    BadInput,
    Busy,
    NotFound,
    Stopping,
    problem_of,
    shown_value,
)
from service.records import events
from service.records.bulk import Bulk, Check, Chunk
from service.records.draft import Answered, Row
from service.records.intake import Answers
from service.records.store import Store
from service.records.tables import replays

MAX_ERRORS_KEPT = 1_000
MAX_LISTED = 100
MAX_FAULTS_KEPT = 3
"""Of one line: they are written anew with every chunk that adds to them, and read as a whole."""
MAX_TEXT_KEPT = 300
BUSY_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
PROGRESS_S = 0.2
"""Between two notes of how far a replay is: each is a transaction, and told to all who listen."""

COUNTED = ("new", "repeated", "observed", "unique", "ambiguous", "unmatched", "attitudes")
"""What a replay counts: batches by whether they were recorded before, their stars, attitudes."""

log = logging.getLogger(__name__)

Numbered = tuple[int, bytes]
T = TypeVar("T")


@dataclass
class _Begun:
    """A chunk on its way: its last line, and those that hold something, with their numbers."""

    last: int
    numbers: list[int]
    texts: list[bytes]
    chunk: Chunk


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
    ) -> None:
        self._store = store
        self._bulk = bulk
        self._now = now
        self._row = row
        self._check = check
        self._counts: Counter[str] = Counter()
        self._errors: list[Row] = []
        self._errors_changed = False
        self._noting: Future[None] | None = None
        self._noted = True
        self._ahead: deque[_Begun] = deque()
        self._written: _Begun | None = None
        self._saved_s = 0.0
        self._stopping = threading.Event()
        self._over = threading.Event()

    def start(self, lines: Iterable[bytes], also: Callable[[Connection], object]) -> None:
        """Note the replay in the table and begin in a thread; `lines` are closed at the end.

        `also` is called in the transaction that notes it.
        """
        try:
            self._note(also)
            threading.Thread(
                target=self._work, args=(lines,), name=f"replay-{self._row['id']}"
            ).start()
        except BaseException:
            self._over.set()
            raise

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
        """Let it end after the chunk at hand."""
        self._stopping.set()

    def wait(self) -> None:
        """Return when it is over."""
        self._over.wait()

    def _work(self, lines: Iterable[bytes]) -> None:
        state = "failed"
        try:
            state = self._worked_through(lines)
        except Busy:
            state = "interrupted"
        except BadInput as error:
            # The file itself, from here on: its lines before are recorded.
            self._refuse(self._row["lines_done"] + 1, error)
        except Exception as error:
            log.exception("replay %s failed", self._row["id"])
            self._refuse(self._row["lines_done"] + 1, error)
        finally:
            try:
                close: Callable[[], Any] | None = getattr(lines, "close", None)
                if close is not None:
                    close()
                self._conclude(state)
            finally:
                self._over.set()

    def _conclude(self, state: str) -> None:
        """Note how it ended, as often as it takes: nothing else would say that it is over."""
        pause_s = BUSY_PAUSE_S
        while True:
            self._save(state=state, finished=self._now())
            self._require_noted()
            if self._noted or self._stopping.wait(pause_s):
                return
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)

    def _worked_through(self, lines: Iterable[bytes]) -> str:
        """The state in the end; while a chunk is written, those after it are computed."""
        try:
            try:
                for chunk in _chunks(enumerate(lines, start=1), lambda: self._bulk.lines):
                    if self._stopping.is_set():
                        return "interrupted"
                    self._ahead.append(self._begin(chunk))
                    self._hand_on(self._bulk.ahead)
            finally:
                # Where the lines break off, those before are recorded all the same.
                if not self._stopping.is_set():
                    self._hand_on(0)
            return "done"
        finally:
            self._finish(self._written)

    def _begin(self, numbered: list[Numbered]) -> _Begun:
        some = [(number, line.rstrip(b"\r\n")) for number, line in numbered if line.strip()]
        numbers, texts = [number for number, _ in some], [text for _, text in some]
        return _Begun(numbered[-1][0], numbers, texts, self._patiently(self._chunk, texts))

    def _chunk(self, texts: list[bytes]) -> Chunk:
        return self._bulk.begin(texts, self._row["run"], self._check)

    def _hand_on(self, left: int) -> None:
        """Queue chunks for the writer, one after the other, until so many are left."""
        while len(self._ahead) > left:
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
            answers = self._again(begun.texts)
        for number, answer in zip(begun.numbers, answers, strict=True):
            if isinstance(answer, AcquisitionError):
                self._refuse(number, answer)
            else:
                self._count(answer)
        self._row["lines_done"] = begun.last
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
        if self._stopping.wait(BUSY_PAUSE_S):
            raise Busy("the replay is to stop", round(BUSY_PAUSE_S) or 1)

    def _count(self, outcome: Answered) -> None:
        answer = _COUNTED.decode(outcome.body)
        self._counts["repeated" if outcome.replayed else "new"] += 1
        self._counts["attitudes"] += bytes(answer.attitude) != b"null"
        self._counts.update(answer.counts)

    def _state(self) -> Row:
        return replay_state({"finished": None} | self._row)

    def _refuse(self, number: int, error: Exception) -> None:
        self._row["lines_refused"] += 1
        if len(self._errors) < MAX_ERRORS_KEPT:
            self._errors.append({"line": number, "problem": _kept(problem_of(error))})
            self._errors_changed = True

    def _save(self, **changed: Any) -> None:
        names = ("lines_done", "lines_refused")
        values = {n: self._row[n] for n in names} | changed
        values["counts"] = json.dumps(self._counts)
        if self._errors_changed:
            values["errors"] = json.dumps(self._errors)
        change = update(replays).where(replays.c.id == self._row["id"]).values(values)
        self._row |= values
        # As it is now: it is written while the next chunk is at work.
        state = self._state()

        def save(connection: Connection) -> None:
            connection.execute(change)
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


def _chunks(lines: Iterator[Numbered], most: Callable[[], int]) -> Iterator[list[Numbered]]:
    chunk: list[Numbered] = []
    try:
        for each in lines:
            chunk.append(each)
            if len(chunk) >= most():
                yield chunk
                chunk = []
    except BadInput:
        # Damage ends the file; the lines before it are whole.
        if chunk:
            yield chunk
        raise
    if chunk:
        yield chunk
