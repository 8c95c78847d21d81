"""Where submissions that come one by one are worked through, together with what came meanwhile.

One thread at a time takes what waits: it is read, looked up by one statement,
computed batch by batch, recorded in one transaction, and
answered, all together.  To pass a batch from thread to thread costs more than
to compute it, and so does waking a thread: whoever submits may work through
what it brought by itself.  Another thread looks from time to time, and steps in
where the one has been at a batch for long.  Who submits is called with the
outcome.  A repeat of what is at work waits for it and is then looked up like any
other.
"""

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from service.acquire import Acquisition
from service.errors import AcquisitionError, Busy, Stopping
from service.observe.wire import Submission
from service.records.draft import Answered, Draft
from service.records.identity import Identity, OwnKey, identity_of
from service.records.writer import RETRY_AFTER_S
from service.times import Utc, utc_now

MAX_WAITING = 2_000
TAKEN_AT_ONCE = 64
HANDED_ON_S = 0.01
"""What is computed goes to the writer after so long, however much else waits."""
LONG_S = 0.02
"""What has waited so long is taken by another thread."""
AWAKE_S = 1.0
"""So long after the last batch one thread goes on looking: to be woken is dear."""
WAIT_S = 5.0
"""The longest that an order may wait for its turn."""
LISTEN_S = 0.2
"""So often somebody asks for more while every thread is held up."""

Outcome = Answered | Exception
Found = Sequence[Answered | AcquisitionError | None]
More = Callable[[], Sequence["Order"]]


@dataclass(eq=False, slots=True)
class Order:
    """One submission, what its client calls it, and who is called with what became of it.

    It comes as it was sent, and is read where it is worked on: `read` gives the
    submission, or raises what is wrong with it.  Once it is drafted the submission
    is let go, and its name stays.
    """

    read: Callable[[], Submission]
    key: OwnKey | None
    settle: Callable[[Outcome], object]
    received: Utc = field(default_factory=utc_now)
    since_s: float = field(default_factory=time.monotonic)
    _submission: Submission | None = None
    _identity: Identity | None = None

    @property
    def submission(self) -> Submission:
        """What was sent."""
        if self._submission is None:
            self._submission = self.read()
        return self._submission

    @property
    def identity(self) -> Identity:
        """What is unique among submissions."""
        if self._identity is None:
            self._identity = identity_of(self.submission.batch)
        return self._identity

    def let_go(self) -> None:
        """Need the submission no more, so that the next is made in memory that is at hand."""
        _ = self.identity
        self._submission = None


class Desk:
    """Takes orders from any thread; `close` ends its own."""

    def __init__(
        self,
        look_up: Callable[[Sequence[Order]], Found],
        acquire: Callable[[Order], Acquisition],
        draft: Callable[[Order, Acquisition], Draft],
        write: Callable[[Sequence[Draft]], Sequence[Outcome]],
        threads: int,
    ) -> None:
        """`look_up` finds what is stored, `acquire` computes, `draft` says what is to be kept.

        `write` records that, and waits until it is.
        """
        self._look_up, self._acquire, self._draft, self._write = look_up, acquire, draft, write
        self._new: deque[Order] = deque()
        self._ready: deque[Order] = deque()
        self._at_work: dict[Identity, list[Order]] = {}
        self._unsettled: dict[Order, None] = {}
        lock = threading.RLock()
        self._changed = threading.Condition(lock)
        self._step_in = threading.Condition(lock)
        self._active = 0
        self._watched = False
        self._moved_s = -math.inf
        self._taken_s = -math.inf
        self._quiet = threading.Event()
        self._quiet.set()
        self._closing = False
        self._more: More | None = None
        self.after_group: list[Callable[[], object]] = []
        """Called when a group is settled: what is told of it may be told together."""
        # The first does everything, as long as it keeps up: what it works with lies in the cache
        # of its processor.
        self._first = threading.Thread(target=self._work, name="desk", daemon=True)
        self._others = [
            threading.Thread(target=self._watch, name=f"desk-{number}", daemon=True)
            for number in range(1, threads)
        ]
        # Whatever the others wait for, calls that come the same way as batches go on.
        self._listener = threading.Thread(target=self._listen, name="desk-listener", daemon=True)
        self._over = threading.Event()
        for thread in (*self._others, self._listener):
            thread.start()

    def take(self, orders: Sequence[Order]) -> None:
        """Queue orders; those that are too many are settled with `Busy`.

        What an order is settled with is the answer, stored, or the error that
        keeps it from being.
        """
        refused = self._put(orders)
        with self._changed:
            if not self._first.ident and not self._closing:
                self._first.start()
            if not self._active:
                self._changed.notify()
        self._refuse(refused)

    def take_here(self, orders: Sequence[Order], more: "More") -> None:
        """Queue orders, and work in this thread until nothing waits any longer.

        Before each group `more` is called for what came meanwhile, by whichever
        thread works then: while this one is at a batch for long, another.
        """
        self._more = more
        self._refuse(self._put(orders))
        while self._begins(self._changed, leave=True):
            self._work_through_group()

    def _put(self, orders: Sequence[Order]) -> Sequence[Order]:
        """Queue orders; gives those for which there is no room."""
        with self._changed:
            self._taken_s = time.monotonic()
            room = MAX_WAITING - len(self._new) - len(self._ready)
            taken = 0 if self._closing else max(0, min(room, len(orders)))
            if taken:
                self._new.extend(orders[:taken])
                self._unsettled.update(dict.fromkeys(orders[:taken]))
                self._quiet.clear()
        return orders[taken:]

    def _refuse(self, orders: Sequence[Order]) -> None:
        for order in orders:
            if self._closing:
                order.settle(Stopping("the service is stopping"))
            else:
                waiting = f"{MAX_WAITING} batches are waiting to be worked on"
                order.settle(Busy(waiting, RETRY_AFTER_S))

    @property
    def idle_s(self) -> float:
        """Seconds since something was last put here."""
        return time.monotonic() - self._taken_s

    def state(self) -> tuple[int, float]:
        """How many orders are not settled yet, and the age of the oldest in seconds."""
        with self._changed:
            oldest = next(iter(self._unsettled), None)
            age_s = 0.0 if oldest is None else time.monotonic() - oldest.since_s
            return len(self._unsettled), age_s

    def let_pass(self, seconds: float) -> None:
        """Wait until nothing lies here, but no longer than so; for whoever has more time."""
        self._quiet.wait(seconds)

    def close(self) -> None:
        """Refuse new orders, work through those that wait, and end the threads."""
        with self._changed:
            self._closing = True
            self._notify_all()
        for thread in (self._first, *self._others):
            if thread.ident:
                thread.join()
        self._over.set()
        self._listener.join()

    def _notify_all(self) -> None:
        self._changed.notify_all()
        self._step_in.notify_all()

    def _work(self) -> None:
        while self._begins(self._changed):
            self._work_through_group()

    def _watch(self) -> None:
        while self._begins(self._step_in):
            self._work_through_group()

    def _listen(self) -> None:
        """Ask for what came while every thread is held up, for batches are not all that comes."""
        while not self._over.wait(LISTEN_S):
            held_up = self._active and time.monotonic() - self._moved_s > LISTEN_S
            if held_up and self._more is not None and (came := self._more()):
                self._refuse(self._put(came))
                with self._changed:
                    # Those that were held up may have found nothing more and gone by now.
                    self._step_in.notify_all()

    def _begins(self, turn: threading.Condition, leave: bool = False) -> bool:
        """Whether there is something to do for this thread, and it has begun; it waits for that.

        False: there will never be, or to `leave`, there is nothing now.
        """
        with turn:
            while True:
                waiting = self._ready or self._new
                # Who is at a batch cannot see what comes meanwhile.
                unseen = self._active and self._more is not None
                if (waiting or unseen) and self._may_begin(turn):
                    self._active += 1
                    self._moved_s = time.monotonic()
                    if not self._watched:
                        # Who may have to step in must be awake to see how long it takes.
                        self._step_in.notify()
                    return True
                if not waiting and (leave or (self._closing and not self._active)):
                    return False
                self._wait(turn)

    def _may_begin(self, turn: threading.Condition) -> bool:
        if turn is self._changed and not self._active:
            return True
        return time.monotonic() - self._moved_s > LONG_S

    def _wait(self, turn: threading.Condition) -> None:
        awake = self._active or time.monotonic() - self._moved_s < AWAKE_S
        if turn is self._changed:
            turn.wait(LONG_S if self._active else None)
        elif awake and not self._watched:
            self._watched = True
            try:
                turn.wait(LONG_S)
            finally:
                self._watched = False
        else:
            turn.wait()

    def _work_through_group(self) -> None:
        try:
            if self._more is not None and (came := self._more()):
                self._refuse(self._put(came))
            self._look(self._taken())
            self._compute()
        finally:
            with self._changed:
                self._active -= 1
                if not self._active:
                    if self._new or self._ready:
                        self._changed.notify()
                    else:
                        self._quiet.set()
                if self._closing:
                    self._notify_all()

    def _taken(self) -> list[Order]:
        with self._changed:
            count = min(len(self._new), TAKEN_AT_ONCE)
            return [self._new.popleft() for _ in range(count)]

    def _look(self, orders: Sequence[Order]) -> None:
        """Answer what is wrong or stored; let the rest be computed, each identity once."""
        orders = self._in_time(orders)
        orders, refused = self._read(orders)
        self._settle(refused)
        if not orders:
            return
        try:
            found: Sequence[Outcome | None] = self._look_up(orders)
        except Exception as error:
            found = [error] * len(orders)
        with self._changed:
            for order, answer in zip(orders, found, strict=True):
                if answer is not None:
                    continue
                followers = self._at_work.get(order.identity)
                if followers is None:
                    self._at_work[order.identity] = []
                    self._ready.append(order)
                else:
                    followers.append(order)
        self._settle([each for each in zip(orders, found, strict=True) if each[1] is not None])

    def _in_time(self, orders: Sequence[Order]) -> Sequence[Order]:
        """The orders that have not waited too long; the others may come again."""
        since_s = time.monotonic() - WAIT_S
        late = [order for order in orders if order.since_s < since_s]
        if not late:
            return orders
        error = Busy(f"it has waited {WAIT_S:g} s for its turn", RETRY_AFTER_S)
        self._settle([(order, error) for order in late])
        return [order for order in orders if order.since_s >= since_s]

    def _read(
        self, orders: Sequence[Order]
    ) -> tuple[list[Order], list[tuple[Order, Outcome | None]]]:
        good: list[Order] = []
        refused: list[tuple[Order, Outcome | None]] = []
        for order in orders:
            self._moved_s = time.monotonic()
            try:
                _ = order.submission
                good.append(order)
            except Exception as error:
                refused.append((order, error))
        return good, refused

    def _compute(self) -> None:
        """Compute what is ready for a while, and have it recorded."""
        began_s = time.monotonic()
        acquired: deque[tuple[Order, Acquisition]] = deque()
        while True:
            with self._changed:
                if not self._ready or time.monotonic() - began_s > HANDED_ON_S:
                    break
                order = self._ready.popleft()
            self._moved_s = time.monotonic()
            try:
                if time.monotonic() - order.since_s > WAIT_S:
                    raise Busy("every processor is at work on other batches", RETRY_AFTER_S)
                acquired.append((order, self._acquire(order)))
            except Exception as error:
                self._finish([order], [error])
        # Whoever does one thing many times finds its code in the processor's cache.
        drafted: list[tuple[Order, Draft]] = []
        while acquired:
            order, acquisition = acquired.popleft()
            self._moved_s = time.monotonic()
            try:
                draft = self._draft(order, acquisition)
            except Exception as error:
                # Whatever is wrong with one, it is told, and the others are recorded.
                self._finish([order], [error])
                continue
            drafted.append((order, draft))
            order.let_go()
        if not drafted:
            return
        self._moved_s = time.monotonic()
        try:
            outcomes: Sequence[Outcome] = self._write([draft for _, draft in drafted])
        except Exception as error:
            outcomes = [error] * len(drafted)
        self._finish([order for order, _ in drafted], outcomes)

    def _finish(self, orders: Sequence[Order], outcomes: Sequence[Outcome]) -> None:
        with self._changed:
            for order in orders:
                # Followers are looked up again: the first may have failed, or had another body.
                self._new.extend(self._at_work.pop(order.identity))
        self._settle(list(zip(orders, outcomes, strict=True)))

    def _settle(self, settled: Sequence[tuple[Order, Outcome | None]]) -> None:
        with self._changed:
            for order, _ in settled:
                self._unsettled.pop(order, None)
        for order, outcome in settled:
            assert outcome is not None
            order.settle(outcome)
        if settled:
            for told in self.after_group:
                told()
