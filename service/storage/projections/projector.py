"""Projector: brings the projections up to date with the record, after the answers.

    record ──► projector ──► rollups, events, features      one transaction, with its position

It takes results in the order of the record, many at a time, and notes its position in the same
transaction: after a crash it continues from there, and every result is projected exactly once.
Among services on one database, the one that holds the lock projects the results of all
(`ProjectorLock`).  Commands may project beside it; the row with the position is locked, so that
they take turns.
"""

import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

from sqlalchemy import Connection, select, update

from service.errors import BadConfiguration, Busy
from service.feature import feature_modules
from service.observations.schema import LIVE
from service.storage.projections import rollups, seals
from service.storage.projections.heads import NOTHING, HeadMaker
from service.storage.projections.rollups import RecordedResult, lock_position, recorded_after
from service.storage.queries.pages import newest_first
from service.storage.recording import events
from service.storage.recording.answer import state_in
from service.storage.recording.chain import Statement
from service.storage.recording.unsaved_result import AHEAD_NS, STARS
from service.storage.recording.writer import is_of_the_database, is_of_the_statement
from service.storage.sql.columns import Row, unpack
from service.storage.sql.dialects import dialect_of, next_transaction
from service.storage.sql.projector_lock import NotProjecting
from service.storage.sql.statements import execute
from service.storage.sql.tables import projector, results
from service.storage.store import Store

log = logging.getLogger(__name__)

T = TypeVar("T")


def _add_events(connection: Connection, new: Sequence[RecordedResult]) -> None:
    """Add one event for new batches of a spacecraft's run, and one for each change of state."""
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
    """Add an event for each new batch that changes the tracking state of its spacecraft and run.

    The state is that of the latest batch that asks for the last attitude.  A late batch changes
    none, and neither does a live one that is dated ahead.
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
)
"""Functions that add new results, in the record's order, to tables that no other one fills.

Those of features follow.
"""
MOST_AT_ONCE = 500
LONGEST_S = 0.05
"""Target duration of a transaction in seconds; after a longer one the next has fewer results."""
EVERY_S = 0.2
"""Seconds between the starts of two turns of the projector, unless a reader waits."""
GAP_S = 0.01
"""Seconds until the projector checks a gap in the record again."""
RETRY_S = 1.0
"""Seconds until the projector tries again after a failed turn."""
HOURS_AT_ONCE = 24
"""Number of hours of trends recounted in one transaction."""
CLOSE_S = 5.0
"""Longest time in seconds for the remaining results when the service stops."""
MOST_LAST_HEADS = 10
"""Largest number of heads of the record made when the service stops."""


@dataclass(frozen=True)
class _Step:
    """Outcome of one transaction of the projector."""

    position: int
    is_all: bool
    """True if the transaction projected every result that it could see."""
    is_blocked: bool = False
    """True if the next result follows a gap that may still be filled."""


@dataclass(frozen=True)
class _Gap:
    """Gap between two places in the record, with the next transaction's number when found."""

    before: int
    after: int
    next: int


class Projector:
    """Thread that projects recorded results, some in each turn."""

    def __init__(self, store: Store, head_maker: HeadMaker | None = None) -> None:
        """Prepare the projector; once it is started, readers of the store wait for the projections.

        Without `head_maker` no heads of the record are made.
        """
        self._store, self._progress = store, store.progress
        self._head_maker = head_maker
        modules = feature_modules("projection", store.features_off)
        self._of_features = [module.apply for module in modules]
        self._closing = threading.Event()
        self._most = MOST_AT_ONCE
        self._position = 0
        self._gap: _Gap | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the projector's thread."""
        self._progress.begin()
        self._thread = threading.Thread(target=self._run, name="projector", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Project the remaining results, and end the projector's thread."""
        self._closing.set()
        self._progress.end()
        if self._thread is not None:
            self._thread.join()

    # ---- the projector's thread --------------------------------------------------------------

    def _run(self) -> None:
        while not self._closing.is_set():
            begun_s = time.monotonic()
            try:
                step = self._turn()
            except Exception:
                # Without this thread nothing would be projected until the service ends.
                log.exception("the record could not be projected")
                self._closing.wait(RETRY_S)
                continue
            if self._is_head_due():
                self._try_to_make_heads(1)
            if step is None or step.is_all:
                self._progress.wait_for_reader(begun_s + EVERY_S - time.monotonic())
            elif step.is_blocked:
                time.sleep(GAP_S)
        end_s = time.monotonic() + CLOSE_S
        while (step := self._turn()) is not None and not step.is_all:
            if time.monotonic() > end_s:
                return
        self._try_to_make_heads(MOST_LAST_HEADS)

    def _is_head_due(self) -> bool:
        maker = self._head_maker
        is_due = maker is not None and maker.is_due(self._position)
        return is_due and self._progress.is_projecting

    def make_heads(self, most: int = sys.maxsize) -> None:
        """Make up to `most` heads of the record from the projected results, now."""
        made: Statement | None = NOTHING
        while self._head_maker is not None and made is not None and most:
            made = self._write(partial(_make_head, self._head_maker))
            most -= 1

    def _try_to_make_heads(self, most: int) -> None:
        try:
            self.make_heads(most)
        except Exception:
            # The next head covers the rows that this one lacks.
            log.exception("no head of the record could be made")

    def _turn(self) -> _Step | None:
        """Project some results, if any are left, and report the position to readers."""
        commits = self._store.writer.commits
        step = self._try_step() if self._may_step(commits) else None
        if step is not None:
            self._position = step.position
            self._progress.report(step.position, commits if step.is_all else None)
        return step

    def _may_step(self, commits: int) -> bool:
        """True if this process may have results to project.

        The check avoids a transaction, which locks the projector's row even if it finds nothing.
        """
        progress = self._progress
        if not progress.is_shared:
            return progress.is_behind()
        progress.is_projecting = self._store.is_projecting
        try:
            newest, position = progress.places()
        except Busy:
            return False
        if position < newest:
            return progress.is_projecting
        self._position = position
        progress.report(position, commits)
        return False

    def _try_step(self) -> _Step | None:
        """Project some results; None if the database cannot be written now."""
        try:
            return self._write(self._step)
        except Exception:
            # One faulty result must not hold up the others: find it one by one.
            if self._most > 1:
                self._most = 1
                return _Step(self._position, is_all=False)
            log.exception("a result could not be projected")
        return self._write(self._step_around)

    def _write(self, step: Callable[[Connection], T]) -> T | None:
        try:
            with self._store.writer.projection() as connection:
                done = step(connection)
        except (NotProjecting, BadConfiguration):
            # Another process projects.
            self._progress.is_projecting = False
            return None
        except Busy:
            # The writer has logged the error.
            return None
        self._progress.is_projecting = True
        return done

    def _step(self, connection: Connection) -> _Step:
        """Project some results in a transaction of the writer."""
        begun_s, most = time.monotonic(), self._most
        position = lock_position(connection)
        # Ask before the results are read: they then include those of older transactions.
        oldest = dialect_of(connection).oldest_transaction(connection)
        new = recorded_after(connection, position, most)
        is_all = len(new) < most
        if oldest is not None:
            whole = self._without_gaps(connection, position, new, oldest)
            is_all, new = is_all and len(whole) == len(new), whole
        is_blocked = not new and not is_all
        if new:
            position = new[-1].seq
            connection.execute(update(projector).values(seq=position))
            for apply in (*PROJECTIONS, *self._of_features):
                apply(connection, new)
            took_s = time.monotonic() - begun_s
            self._most = max(1, min(MOST_AT_ONCE, int(2 * len(new) * LONGEST_S / took_s)))
        return _Step(position, is_all, is_blocked)

    def _without_gaps(
        self, connection: Connection, position: int, new: list[RecordedResult], oldest: int
    ) -> list[RecordedResult]:
        """Results before the first gap in the record that may still be filled by a commit.

        A transaction has its number before it takes places in the record.  Once all transactions
        have ended that ran when a later place was seen, the missing results were rolled back or
        deleted.
        """
        for k, each in enumerate(new):
            if each.seq != position + 1 and not self._is_final(
                connection, position, each.seq, oldest
            ):
                return new[:k]
            position = each.seq
        return new

    def _is_final(self, connection: Connection, before: int, after: int, oldest: int) -> bool:
        """True if no result can appear between two places of the record any more."""
        gap = self._gap
        if gap is None or gap.before != before or gap.after < after:
            self._gap = _Gap(before, after, next_transaction(connection))
            return False
        return oldest >= gap.next

    def _step_around(self, connection: Connection) -> _Step:
        """Project one result with those projections that accept it, and advance the position."""
        position = lock_position(connection)
        for each in recorded_after(connection, position, 1):
            position = each.seq
            connection.execute(update(projector).values(seq=position))
            for apply in (*PROJECTIONS, *self._of_features):
                _applied_or_left_out(connection, apply, each)
        return _Step(position, is_all=False)


def _applied_or_left_out(
    connection: Connection, apply: Callable[..., None], result: RecordedResult
) -> None:
    """Apply a projection to a result, undone if it fails; raises faults of the database itself."""
    noted = events.noted(connection)
    execute(connection, "SAVEPOINT projection")
    try:
        apply(connection, [result])
    except Exception as error:
        events.undone(connection, noted)
        if is_of_the_database(error) and not is_of_the_statement(error):
            raise
        execute(connection, "ROLLBACK TO SAVEPOINT projection")
        log.exception("%s leaves out a result", apply.__module__)
    execute(connection, "RELEASE SAVEPOINT projection")


def _make_head(maker: HeadMaker, connection: Connection) -> Statement | None:
    return maker.make(connection, lock_position(connection))


@contextmanager
def projected(store: Store) -> Iterator[None]:
    """Project everything recorded before and within a `with` block; for commands."""
    projector = Projector(store)
    projector.start()
    try:
        store.progress.catch_up()
        yield
    finally:
        projector.close()


def rebuild_trends(store: Store, step: Callable[[int, int], object]) -> int:
    """Recount all trends, some hours at a time; returns the number of hours.

    `step` is called with the hours done and all hours.  Interrupted, it leaves correct trends.
    """
    with store.reading_record() as connection:
        hours = sorted(rollups.hours_of_all(connection))
    for first in range(0, len(hours), HOURS_AT_ONCE):
        chunk = hours[first : first + HOURS_AT_ONCE]
        store.writer.change(partial(rollups.renew, hours=chunk))
        step(first + len(chunk), len(hours))
    return len(hours)
