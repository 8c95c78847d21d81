"""The projector: brings the projections up to date with the record, after the answers.

    record ──► projector ──► rollups, alarms, events        one transaction, with its position

It takes results in the order of the record, many at a time, and notes how far it came in the
same transaction: after a crash it goes on from there, and no result is projected twice or not
at all.  Of the services on one database the one that holds the lock projects what all of them
record (`ProjectorLock`).  Commands may project beside it; the row with the position is locked,
so that they take turns.
"""

import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

from sqlalchemy import Connection, select, update

from service.errors import BadConfiguration, Busy
from service.storage.projections import alarms, rollups, seals
from service.storage.projections.rollups import RecordedResult, lock_position, recorded_after
from service.storage.queries.pages import newest_first
from service.storage.recording import events
from service.storage.recording.answer import state_in
from service.storage.recording.unsaved_result import AHEAD_NS, LIVE, STARS
from service.storage.sql.columns import Row, unpack
from service.storage.sql.projector_lock import NotProjecting
from service.storage.sql.statements import execute
from service.storage.sql.tables import projector, results
from service.storage.store import Store

log = logging.getLogger(__name__)


def _add_events(connection: Connection, new: Sequence[RecordedResult]) -> None:
    """Add one event for the new batches of each spacecraft and run, and one for each new state."""
    of_owner: dict[tuple[str, str], list[RecordedResult]] = {}
    for each in new:
        if each.is_first:
            of_owner.setdefault(each.owner, []).append(each)
    for (run, spacecraft), group in of_owner.items():
        latest = max(group, key=lambda each: (each.result["time_ns"], each.seq)).result
        newest: Row = {name: latest[name] for name in ("id", "batch", "time", "status", "reason")}
        newest["counts"] = {name: latest[name] for name in STARS}
        note: Row = {"spacecraft": spacecraft, "run": run, "batches": len(group), "latest": newest}
        events.add_event(connection, "batches", note, run=run, spacecraft=spacecraft)
        _note_states(connection, spacecraft, run, group)


def _note_states(
    connection: Connection, spacecraft: str, run: str, new: Sequence[RecordedResult]
) -> None:
    """Add an event for each new batch of a spacecraft and a run that changes the state.

    The state is that of the latest batch, where that asks for the last attitude.  A late batch
    changes none, and neither does a live one that is dated ahead.
    """
    states = {each.seq: state_in(unpack(each.result["answer"])) for each in new}
    tracked = [each for each in new if states[each.seq] is not None and not each.is_ahead]
    if not tracked:
        return
    query = select(results.c.time_ns, results.c.answer).where(
        results.c.current,
        results.c.spacecraft == spacecraft,
        results.c.run == run,
        results.c.seq < new[0].seq,
    )
    if run == LIVE:
        received_ns = max(each.received_ns for each in tracked)
        query = query.where(results.c.time_ns <= received_ns + AHEAD_NS)
    row = connection.execute(newest_first(query).limit(1)).first()
    before = None if row is None else state_in(row.answer)
    for each in sorted(tracked, key=lambda each: int(each.result["time_ns"])):
        if row is not None and row.time_ns > each.result["time_ns"]:
            continue
        state = states[each.seq]
        if state != before:
            note: Row = {"spacecraft": spacecraft, "run": run}
            note |= {name: each.result[name] for name in ("id", "batch", "time")}
            note |= {"state": state, "before": before}
            events.add_event(connection, "tracking", note, run=run, spacecraft=spacecraft)
        before = state


PROJECTIONS: Sequence[Callable[[Connection, Sequence[RecordedResult]], None]] = (
    seals.apply,
    rollups.apply,
    _add_events,
    alarms.apply,
)
"""Each adds new results, in the order of the record, to tables that it alone fills."""
MOST_AT_ONCE = 500
LONGEST_S = 0.05
"""The duration of one transaction; the next one takes fewer results where this one took longer."""
EVERY_S = 0.1
"""The time between the beginnings of two transactions, unless a reader waits."""
LOOK_S = 1.0
"""The time between two looks for what other processes recorded, and for another projector."""
SHARED_LOOK_S = 0.1
"""The same on PostgreSQL in the process that projects: other services record all the time."""
POLL_S = 0.02
"""The time between two looks of a reader for where another process projects."""
GIVE_WAY_S = 0.01
"""The pause after a commit that woke the projector: the answers to its posts go out first."""
GAP_S = 0.01
"""The pause before a gap in the record is looked at again."""
WAIT_S = 1.0
"""The longest wait of a reader for the projections."""
MOST_BEHIND = 20_000
"""Results; bulk loads, replays and reprocessing wait while there are more."""
HOURS_AT_ONCE = 24
"""The hours of trends that are counted anew in one transaction."""
CLOSE_S = 5.0
"""The longest time that is spent on what is left when the service stops."""

_BEHIND = "SELECT count(*) FROM results WHERE seq > (SELECT seq FROM projector)"
_NEWEST_AND_POSITION = (
    "SELECT (SELECT coalesce(max(seq), 0) FROM results), (SELECT seq FROM projector)"
)


@dataclass(frozen=True)
class _Step:
    """The outcome of a transaction of the projector."""

    position: int
    is_all: bool
    """True if the transaction projected every result that it could see."""
    is_blocked: bool = False
    """True if the next result is one after a gap that may still be filled."""


@dataclass(frozen=True)
class _Gap:
    """Results that were missing between two places, and the number of the next transaction then."""

    before: int
    after: int
    next: int


@dataclass(frozen=True)
class Lag:
    """How far the projections are behind the record: results, and seconds since they were not."""

    results: int
    seconds: float


class Projector:
    """A thread that projects what the writer records."""

    def __init__(self, store: Store) -> None:
        """Readers of the store wait for the projections once the thread is started."""
        self._store, self._writer = store, store.writer
        self._is_shared = store.file is None
        """Other processes record and project, too."""
        self._is_closing = False
        self._changed = threading.Condition()
        self._position = 0
        self._readers = 0
        self._most = MOST_AT_ONCE
        self._projected = -1
        """The writer's count of transactions up to which all is projected."""
        self._up_to_date_s = time.monotonic()
        self._gap: _Gap | None = None
        self._is_projecting, self._is_idle = True, False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Keep the projections up from now on."""
        self._thread = threading.Thread(target=self._run, name="projector", daemon=True)
        self._thread.start()
        self._writer.after_jobs.append(self._wake)
        self._store.before_reading = self.wait
        self._store.hold_back = partial(self.catch_up, MOST_BEHIND)

    def wait(self) -> float:
        """Return when all that is recorded now is projected, or after `WAIT_S`.

        The seconds that the projections are behind then; zero where they are not.
        """
        if not self._is_shared and (
            self._projected >= self._writer.commits or not self._is_projecting
        ):
            return 0.0
        try:
            return self._waited()
        except Busy:
            # The database does not give the record now; the projections may still be readable.
            return time.monotonic() - self._up_to_date_s

    def _waited(self) -> float:
        commits = self._writer.commits
        newest, position = self._places()
        if position >= newest:
            return 0.0
        if not self._is_projecting:
            # Another process projects.
            end_s = time.monotonic() + WAIT_S
            while time.monotonic() < end_s and not self._is_closing:
                time.sleep(POLL_S)
                if self._places()[1] >= newest:
                    return 0.0
            return time.monotonic() - self._up_to_date_s

        def has_passed() -> bool:
            # Of others' results the writer's count says nothing.
            is_own = not self._is_shared and self._projected >= commits
            return self._position >= newest or is_own or self._is_closing

        with self._changed:
            self._readers += 1
            self._changed.notify_all()
            is_passed = self._changed.wait_for(has_passed, WAIT_S)
            self._readers -= 1
            return 0.0 if is_passed else time.monotonic() - self._up_to_date_s

    def catch_up(self, most: int = 0) -> None:
        """Wait while more than so many results are to be projected."""
        while not self._is_closing and (self._is_projecting or self._is_shared):
            if self._count_behind(most) <= most:
                return
            self.wait()

    def lag(self) -> Lag:
        """How far behind the projections are."""
        behind = self._count_behind(0)
        return Lag(behind, time.monotonic() - self._up_to_date_s if behind else 0.0)

    def close(self) -> None:
        """Project what is recorded, and end the thread."""
        with self._changed:
            self._is_closing = True
            self._changed.notify_all()
        if self._thread is not None:
            self._thread.join()

    def _count_behind(self, most: int) -> int:
        """How many results are to be projected; counted only if there may be more than so many."""
        if not self._is_shared and self._projected >= self._writer.commits:
            return 0
        newest, position = self._places()
        if newest - position <= most:
            return max(0, newest - position)
        with self._store.lookup() as connection:
            ((behind,),) = execute(connection, _BEHIND)
        return int(behind)

    def _places(self) -> tuple[int, int]:
        """The places of the newest result and of the projector in the record."""
        asked_s = time.monotonic()
        with self._store.lookup() as connection:
            ((newest, position),) = execute(connection, _NEWEST_AND_POSITION)
        if position >= newest:
            self._up_to_date_s = max(self._up_to_date_s, asked_s)
        return newest, position

    # ---- the projector's thread --------------------------------------------------------------

    def _wake(self) -> None:
        # To wake a thread that then waits on is expensive.
        if self._is_idle:
            with self._changed:
                self._changed.notify_all()

    def _run(self) -> None:
        closing_s = float("inf")
        while True:
            begun_s = time.monotonic()
            commits = self._writer.commits
            step = self._try_step() if self._may_step() else None
            with self._changed:
                if step is not None:
                    self._position = step.position
                    if step.is_all:
                        self._projected, self._up_to_date_s = commits, time.monotonic()
                self._changed.notify_all()
                if self._is_closing:
                    closing_s = min(closing_s, begun_s + CLOSE_S)
                    if step is None or step.is_all or time.monotonic() > closing_s:
                        return
                    continue
                if step is None or step.is_all:
                    self._is_idle = True
                    is_alert = self._is_shared and self._is_projecting
                    self._changed.wait_for(self._has_work, SHARED_LOOK_S if is_alert else LOOK_S)
                    self._is_idle = False
                    self._changed.wait_for(lambda: self._readers or self._is_closing, GIVE_WAY_S)
                elif step.is_blocked:
                    self._changed.wait(GAP_S)
                pause_s = begun_s + EVERY_S - time.monotonic()
                if pause_s > 0.0 and (step is None or step.is_all):
                    self._changed.wait_for(lambda: self._readers or self._is_closing, pause_s)

    def _has_work(self) -> bool:
        is_behind = self._projected < self._writer.commits
        is_asked = self._is_shared and self._readers > 0
        return self._is_closing or (self._is_projecting and (is_behind or is_asked))

    def _may_step(self) -> bool:
        """False if nothing is to be projected, or by another process; asked only on PostgreSQL.

        A transaction of the projector locks its row, even where it finds nothing.
        """
        if not self._is_shared:
            return True
        commits = self._writer.commits
        self._is_projecting = self._store.is_projecting
        try:
            newest, self._position = self._places()
        except Busy:
            return False
        if self._position < newest:
            return self._is_projecting
        self._projected = commits
        return False

    def _try_step(self) -> _Step | None:
        """Project some results; None where nothing can be written now."""
        try:
            return self._write(self._step)
        except Exception:
            # One faulty result must not hold up the others: it is looked for one by one.
            if self._most > 1:
                self._most = 1
                return _Step(self._position, is_all=False)
            log.exception("a result could not be projected, and is passed over")
        return self._write(self._pass_over)

    def _write(self, step: Callable[[Connection], _Step]) -> _Step | None:
        try:
            done = self._writer.project(step).result()
        except (NotProjecting, BadConfiguration):
            # Another process projects.
            self._is_projecting = False
            return None
        except Busy:
            # The writer has logged it.
            return None
        self._is_projecting = True
        return done

    def _step(self, connection: Connection) -> _Step:
        """Project some results in the writer's transaction."""
        begun_s, most = time.monotonic(), self._most
        position = lock_position(connection)
        # Before the results are read: those of older transactions are among them.
        is_shared = connection.dialect.name == "postgresql"
        oldest = _transaction(connection, "xmin") if is_shared else None
        new = recorded_after(connection, position, most)
        is_all = len(new) < most
        if oldest is not None:
            whole = self._without_gaps(connection, position, new, oldest)
            is_all, new = is_all and len(whole) == len(new), whole
        is_blocked = not new and not is_all
        if new:
            position = new[-1].seq
            connection.execute(update(projector).values(seq=position))
            for apply in PROJECTIONS:
                apply(connection, new)
            took_s = time.monotonic() - begun_s
            self._most = max(1, min(MOST_AT_ONCE, int(2 * len(new) * LONGEST_S / took_s)))
        return _Step(position, is_all, is_blocked)

    def _without_gaps(
        self, connection: Connection, position: int, new: list[RecordedResult], oldest: int
    ) -> list[RecordedResult]:
        """The first of the results before which none is missing that may still be committed.

        A transaction has its number before it takes places in the record.  Where none of the
        transactions that there were when a later place was seen is left, the missing ones were
        rolled back, or deleted.
        """
        for k, each in enumerate(new):
            if each.seq != position + 1 and not self._is_final(
                connection, position, each.seq, oldest
            ):
                return new[:k]
            position = each.seq
        return new

    def _is_final(self, connection: Connection, before: int, after: int, oldest: int) -> bool:
        """True if no result between two places will come any more."""
        gap = self._gap
        if gap is None or gap.before != before or gap.after < after:
            self._gap = _Gap(before, after, _transaction(connection, "xmax"))
            return False
        return oldest >= gap.next

    def _pass_over(self, connection: Connection) -> _Step:
        """Move on by one result without projecting it."""
        position = lock_position(connection)
        for each in recorded_after(connection, position, 1):
            position = each.seq
            connection.execute(update(projector).values(seq=position))
            seals.apply(connection, [each])
        return _Step(position, is_all=False)


@contextmanager
def projected(store: Store) -> Iterator[None]:
    """Project all that is recorded, and what the block records or deletes: for commands."""
    projector = Projector(store)
    projector.start()
    try:
        projector.catch_up()
        yield
    finally:
        projector.close()


def rebuild_trends(store: Store, step: Callable[[int, int], object]) -> int:
    """Count all trends anew, some hours at a time; how many hours there are.

    `step` is called with the hours done and all hours.  Interrupted, it has left right trends.
    """
    with store.reading_record() as connection:
        hours = sorted(rollups.hours_of_all(connection))
    for first in range(0, len(hours), HOURS_AT_ONCE):
        chunk = hours[first : first + HOURS_AT_ONCE]
        store.writer.change(partial(rollups.renew, hours=chunk)).result()
        step(first + len(chunk), len(hours))
    return len(hours)


def _transaction(connection: Connection, which: str) -> int:
    """A number of PostgreSQL's snapshot: `xmin`, the oldest left, or `xmax`, the next to come."""
    ((number,),) = execute(connection, f"SELECT pg_snapshot_{which}(pg_current_snapshot())::text")
    return int(number)
