"""Replays on the server: a telemetry file worked through in the background, a batch a line."""

import json
import logging
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from typing import Any

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
from service.observe.wire import Submission, submission_from_json
from service.records.draft import Answered, Row
from service.records.store import Store
from service.records.tables import replays

CHUNK_LINES = 250
"""Few enough that a single post, which waits for one chunk at most, is not kept waiting."""
MAX_ERRORS_KEPT = 1_000
MAX_FAULTS_KEPT = 3
"""Of one line: they are written anew with every chunk that adds to them, and read as a whole."""
MAX_TEXT_KEPT = 300
BUSY_PAUSE_S = 0.5

log = logging.getLogger(__name__)

SubmitMany = Callable[[Sequence[Submission]], list[Answered | AcquisitionError]]
Numbered = tuple[int, bytes]


def read_replay(connection: Connection, id: str) -> Row:
    """A replay and its progress; raises `NotFound`."""
    row = connection.execute(select(replays).where(replays.c.id == id)).mappings().first()
    if row is None:
        raise NotFound(f"there is no replay with the id {shown_value(id)}")
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
        "errors": json.loads(row["errors"]),
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


class Replay:
    """One replay at work; its progress is in the table after every chunk."""

    def __init__(
        self, store: Store, submit_many: SubmitMany, now: Callable[[], str], row: Row
    ) -> None:
        self._store = store
        self._submit_many = submit_many
        self._now = now
        self._row = row
        self._errors: list[Row] = []
        self._errors_changed = False
        self._stopping = threading.Event()
        self._over = threading.Event()

    def start(self, lines: Iterable[bytes]) -> None:
        """Note the replay in the table and begin in a thread; `lines` are closed at the end."""
        try:
            self._note()
            threading.Thread(
                target=self._work, args=(lines,), name=f"replay-{self._row['id']}"
            ).start()
        except BaseException:
            self._over.set()
            raise

    def _note(self) -> None:
        row = self._row | {
            "state": "running",
            "lines_done": 0,
            "lines_refused": 0,
            "errors": "[]",
            "started": self._now(),
        }
        self._row = row
        self._store.writer.change(
            lambda connection: connection.execute(insert(replays), row)
        ).result()

    @property
    def is_over(self) -> bool:
        """Whether nothing more will come of it; one that is about to begin is not over."""
        return self._over.is_set()

    def stop(self) -> None:
        """End after the chunk at hand, and wait for that."""
        self._stopping.set()
        self._over.wait()

    def _work(self, lines: Iterable[bytes]) -> None:
        state = "failed"
        try:
            for chunk in _chunks(enumerate(lines, start=1)):
                if self._stopping.is_set():
                    state = "interrupted"
                    return
                self._take(chunk)
                self._save(state="running", finished=None)
            state = "done"
        except Busy:
            state = "interrupted"
        except Exception as error:
            log.exception("replay %s failed", self._row["id"])
            self._refuse(self._row["lines_done"] + 1, error)
        finally:
            try:
                close: Callable[[], Any] | None = getattr(lines, "close", None)
                if close is not None:
                    close()
                self._save(state=state, finished=self._now())
            finally:
                self._over.set()

    def _take(self, chunk: list[Numbered]) -> None:
        numbers, submissions = [], []
        for number, line in chunk:
            if line.strip():
                try:
                    submissions.append(submission_from_json(line, run=self._row["run"]))
                    numbers.append(number)
                except BadInput as error:
                    self._refuse(number, error)
        for number, outcome in zip(numbers, self._submit(submissions), strict=True):
            if isinstance(outcome, AcquisitionError):
                self._refuse(number, outcome)
        self._row["lines_done"] = chunk[-1][0]

    def _submit(self, submissions: Sequence[Submission]) -> list[Answered | AcquisitionError]:
        while True:
            try:
                return self._submit_many(submissions)
            except Stopping:
                raise
            except Busy:
                # A replay has time; whoever posts single batches goes first.
                if self._stopping.wait(BUSY_PAUSE_S):
                    raise

    def _refuse(self, number: int, error: Exception) -> None:
        self._row["lines_refused"] += 1
        if len(self._errors) < MAX_ERRORS_KEPT:
            self._errors.append({"line": number, "problem": _kept(problem_of(error))})
            self._errors_changed = True

    def _save(self, **changed: Any) -> None:
        names = ("lines_done", "lines_refused")
        values = {n: self._row[n] for n in names} | changed
        if self._errors_changed:
            values["errors"] = json.dumps(self._errors)
        change = update(replays).where(replays.c.id == self._row["id"]).values(values)
        try:
            self._store.writer.change(lambda connection: connection.execute(change)).result()
            self._errors_changed = False
        except Exception as error:
            # The next chunk says how far it is; the batches themselves are recorded.
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


def _chunks(lines: Iterator[Numbered]) -> Iterator[list[Numbered]]:
    while chunk := list(islice(lines, CHUNK_LINES)):
        yield chunk
