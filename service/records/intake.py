"""From a submission to its stored answer: compute first, then one transaction, then answer."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import partial

import msgspec
from msgspec import Struct
from sqlalchemy import Connection

from service.acquire import Acquisition
from service.errors import AcquisitionError, BadBatch, Busy, Fault, shown_value
from service.missions.mission import Mission, mission_named
from service.observe.batch import ObservationBatch
from service.observe.wire import (
    Checked,
    OptionsIn,
    Submission,
    submission_from_checked,
    submission_from_json,
)
from service.records.again import batch_again
from service.records.answer import answer_of
from service.records.audit import Entry
from service.records.bench import Bench
from service.records.desk import Desk, Order
from service.records.draft import Answered, Draft, Handed, Row, what_if_draft
from service.records.identity import (
    Identity,
    OwnKey,
    Registry,
    Taken,
    identity_of,
    look_up,
    remember_key,
    stored_answers,
)
from service.records.reading import one_result
from service.records.recording import record
from service.records.running import Running
from service.records.store import Store
from service.records.tokens import Caller
from service.records.transaction import Results
from service.sky.view import Sky
from service.times import utc_now

MAX_KEY_LENGTH = 255

LET_PASS_S = 0.002
"""Before each of many batches those that came one by one have so long to be done with."""

log = logging.getLogger(__name__)

Answers = list[Answered | AcquisitionError]


class Recorded(Struct, frozen=True, eq=False):
    """A batch that is newly recorded, as observers are told of it."""

    spacecraft: str
    run: str
    batch: str
    counts: Mapping[str, int]
    """Its stars: observed, and of them unique, ambiguous and unmatched."""
    has_attitude: bool


Observer = Callable[[Recorded], None]


class Asked(Struct, frozen=True, eq=False):
    """A batch as it was sent, in JSON, checked or read already, and who is called with its outcome.

    `caller`, where given, must be allowed to ask about its spacecraft.
    """

    sent: bytes | Checked | Submission
    key: OwnKey | None
    settle: Callable[[Answered | Exception], object]
    caller: Caller | None = None


class _Rehearsed(Exception):
    """Takes a rehearsal back."""


class Intake:
    """Takes batches in: each is identified, solved and recorded once, however often it is sent."""

    def __init__(self, missions: Mapping[str, Mission], sky: Sky, store: Store) -> None:
        self._bench = Bench(missions, sky)
        self._store = store
        self._running = Running()
        self._desk = Desk(
            self._stored_orders,
            self._acquired,
            self._draft,
            partial(self._written, tell=False),
            self._bench.processors,
        )
        self.observers: list[Observer] = []
        """Called with every batch that is new, after its commit."""

    def take(self, asked: Sequence[Asked]) -> None:
        """Record batches and answer each; a repeat gets the stored answer, at once or when it is.

        Returns at once: `settle` of each is called when it is done.
        """
        self._desk.take(_orders(asked))

    def take_here(self, asked: Sequence[Asked], more: "Callable[[], Sequence[Asked]]") -> None:
        """`take`, in this thread, until nothing waits any longer.

        `more` is called from time to time, by whichever thread is at work, for
        what came meanwhile.
        """
        self._desk.take_here(_orders(asked), lambda: _orders(more()))

    def backlog(self) -> Row:
        """What waits: `posts` that are not answered yet, and the state of the `writes`."""
        waiting, oldest_s = self._desk.state()
        posts = {"queued": waiting, "oldest_s": oldest_s}
        return {"posts": posts, "writes": self._store.writer.state()}

    @property
    def after_group(self) -> list[Callable[[], object]]:
        """Called when the outcomes of a group of those that `take` was given are all told."""
        return self._desk.after_group

    def close(self) -> None:
        """Work through what was taken, and take no more."""
        self._desk.close()

    def submit_made(
        self,
        identity: Identity,
        fingerprint: str,
        make: Callable[[], Submission],
        key: OwnKey | None,
    ) -> Answered:
        """The same of a batch that is still to be made, and is not where it is recorded.

        The thread that asks makes it, which may take seconds, and waits.
        """
        if key is not None:
            _check_key(key)
        while True:
            stored = self._stored(identity, fingerprint, key)
            if stored is not None:
                return stored
            with self._running.turn(identity) as mine:
                if mine:
                    return _raised(self._write([self._bench.draft(make(), key)])[0])

    def submit_many(self, submissions: Sequence[Submission]) -> Answers:
        """`submit` of each in one transaction; an error stands in the place of what is refused."""
        with self._store.reading() as connection:
            registry = look_up(connection, {identity_of(each.batch) for each in submissions})
            holders = [
                _holder(registry, identity_of(each.batch), None, each.fingerprint)
                for each in submissions
            ]
            repeats = {each.result_id for each in holders if isinstance(each, Taken)}
            stored = stored_answers(connection, repeats)
        # The connection is given back: a moment of the database that is held on to for as long
        # as five hundred batches take keeps SQLite from ever shortening its log.
        found: list[Draft | Taken | AcquisitionError] = []
        for holder, each in zip(holders, submissions, strict=True):
            found.append(holder or self.draft_of_many(each))
        drafts = [each for each in found if isinstance(each, Draft)]
        written = iter(self.begin_writing(drafts)())
        answers: Answers = []
        for one in found:
            if isinstance(one, Draft):
                answers.append(next(written))
            elif isinstance(one, Taken):
                answers.append(Answered(one.result_id, stored[one.result_id], replayed=True))
            else:
                answers.append(one)
        return answers

    def draft_of_many(self, submission: Submission) -> Draft | AcquisitionError:
        """The draft of one of many, as soon as nobody waits who came with a single one."""
        self.let_pass()
        return self._bench.drafts_or_errors([submission])[0]

    @property
    def idle_s(self) -> float:
        """Seconds since batches last came one by one."""
        return self._desk.idle_s

    def let_pass(self) -> None:
        """Wait a little for what came one by one to be done."""
        self._desk.let_pass(LET_PASS_S)

    def begin_writing(self, drafts: Sequence[Draft]) -> Callable[[], Answers]:
        """Queue many drafts for a transaction; to call what it gives waits for the answers."""
        finish = self._begin_writing(drafts, patient=True)
        return lambda: _decided(finish())

    def what_if(
        self,
        id: str,
        options: OptionsIn,
        *,
        record: bool,
        adopt: bool,
        entry: Entry | None = None,
    ) -> Answered:
        """Run a recorded batch again; `options` replace what they name of the result's own.

        `entry` is stored in the audit list together with a result that is recorded.
        """
        with self._store.reading() as connection:
            parent = one_result(connection, id)
        batch = batch_again(parent["input"], parent["options"], options)
        acquisition = self.run_again(batch)
        if not (record or adopt):
            answer = answer_of(acquisition, id=None, parent=id) | {"recorded": False}
            return Answered(None, msgspec.json.encode(answer), replayed=False)
        draft = what_if_draft(
            acquisition,
            id=self._bench.ids.new(),
            batch_id=parent["batch_id"],
            parent=id,
            adopt=adopt,
            created=utc_now(),
        )
        if entry is not None:
            draft.audit = entry.row()
        return _raised(self._write([draft])[0])

    def rehearse(self, submission: Submission) -> None:
        """Take a batch all the way and take it back: nothing is kept, and nobody is told.

        Connections are opened and statements put together that the first batch
        would wait for.
        """
        self._stored_orders([Order(lambda: submission, None, lambda outcome: None)])
        draft = self._bench.draft(submission)

        def record_and_regret(connection: Connection) -> None:
            record(connection, [draft])
            raise _Rehearsed

        with suppress(_Rehearsed):
            self._store.writer.change(record_and_regret).result()

    def run_again(self, batch: ObservationBatch, mission: Mission | None = None) -> Acquisition:
        """A recorded batch down the staircase once more; nothing is kept.

        Other settings than those of the batch's mission may be given.
        """
        named = mission or mission_named(self._bench.missions, batch.spacecraft)
        return self._bench.acquire(batch, named)

    def _stored_orders(self, orders: Sequence[Order]) -> list[Answered | AcquisitionError | None]:
        """What is stored of each: the answer, the error of whose place is taken, or nothing."""
        # Identities before keys, each as of its moment: what is recorded in between is found by its
        # key, or seems new, and then the transaction finds it.
        with self._noted_failure(len(orders)), self._store.glancing() as connection:
            registry = look_up(
                connection,
                {each.identity for each in orders},
                {each.key for each in orders if each.key is not None},
            )
            holders = [
                _holder(registry, each.identity, each.key, each.submission.fingerprint)
                for each in orders
            ]
        repeats = {each.result_id for each in holders if isinstance(each, Taken)}
        stored: Mapping[str, bytes] = {}
        if repeats:
            with self._store.reading() as connection:
                stored = stored_answers(connection, repeats)
        found: list[Answered | AcquisitionError | None] = []
        for order, holder in zip(orders, holders, strict=True):
            if isinstance(holder, Taken) and holder.result_id not in stored:
                # It was pruned in between: the batch is as new as any other.
                holder = None
            if not isinstance(holder, Taken):
                found.append(holder)
                continue
            try:
                self._remember(order.identity, order.key, holder, registry)
            except AcquisitionError as error:
                found.append(error)
            else:
                found.append(Answered(holder.result_id, stored[holder.result_id], replayed=True))
        return found

    @contextmanager
    def _noted_failure(self, count: int) -> Iterator[None]:
        """Batches that cannot be looked up cannot be written either."""
        try:
            yield
        except Busy:
            self._store.writer.note_failure(count)
            raise

    def _remember(
        self, identity: Identity, key: OwnKey | None, first: Taken, registry: Registry
    ) -> None:
        """Give a repeat's key, where it is a new one, to the body that is recorded."""
        if key is not None and key not in registry.keys:
            self._store.writer.change(
                lambda connection: remember_key(connection, identity, key, first)
            ).result()

    def _stored(self, identity: Identity, fingerprint: str, key: OwnKey | None) -> Answered | None:
        with self._store.reading() as connection:
            registry = look_up(connection, [identity], [] if key is None else [key])
            first = registry.first(identity, key, fingerprint)
            if first is None:
                return None
            body = stored_answers(connection, [first.result_id])[first.result_id]
        self._remember(identity, key, first, registry)
        return Answered(first.result_id, body, replayed=True)

    def _write(self, drafts: Sequence[Draft]) -> Answers:
        return _decided(self._written(drafts))

    def _acquired(self, order: Order) -> Acquisition:
        return self._bench.acquired(order.submission)

    def _draft(self, order: Order, acquisition: Acquisition) -> Draft:
        return self._bench.draft_of(order.submission, acquisition, order.received, order.key)

    def _written(self, drafts: Sequence[Draft], tell: bool = True) -> Results:
        """What became of each draft, when all are recorded."""
        if not drafts:
            return []
        _hand(drafts)
        return self._told(drafts, self._store.writer.record_here(drafts, tell))

    def _begin_writing(
        self, drafts: Sequence[Draft], patient: bool = False
    ) -> Callable[[], Results]:
        """Queue drafts for one transaction; to call what it gives waits for that."""
        if not drafts:
            return list
        _hand(drafts)
        future = self._store.writer.record(drafts, patient)
        return lambda: self._told(drafts, future.result())

    def _told(self, drafts: Sequence[Draft], outcomes: Results) -> Results:
        for draft, outcome in zip(drafts, outcomes, strict=True):
            is_new = isinstance(outcome, Answered) and not outcome.replayed
            # A what-if looks at the same stars again: there is nothing new to observe.
            if is_new and draft.batch is not None:
                self._tell(draft)
        return outcomes

    def _tell(self, draft: Draft) -> None:
        if not self.observers:
            return
        recorded = Recorded(
            *draft.identity,
            counts=draft.counts,
            has_attitude=draft.solution is not None,
        )
        for observer in self.observers:
            try:
                observer(recorded)
            except Exception:
                # The batch is recorded and its answer due, whoever looks on.
                log.exception("an observer failed")


def _orders(asked: Sequence[Asked]) -> list[Order]:
    received = utc_now()
    return [Order(partial(_read, each), each.key, each.settle, received) for each in asked]


def _hand(drafts: Sequence[Draft]) -> None:
    handed = Handed(time.perf_counter_ns(), len(drafts))
    for draft in drafts:
        draft.handed = handed


def _decided(outcomes: Results) -> Answers:
    answers: Answers = []
    for outcome in outcomes:
        # Neither is an answer to the batch: both say that nothing was decided about it.
        if isinstance(outcome, Busy) or not isinstance(outcome, Answered | AcquisitionError):
            raise outcome
        answers.append(outcome)
    return answers


def _read(asked: Asked) -> Submission:
    match asked.sent:
        case Submission() as submission:
            pass
        case Checked() as checked:
            submission = submission_from_checked(checked)
        case sent:
            submission = submission_from_json(sent)
    if asked.caller is not None:
        asked.caller.require(submission.batch.spacecraft)
    if asked.key is not None:
        _check_key(asked.key)
    return submission


def _holder(
    registry: Registry, identity: Identity, key: OwnKey | None, fingerprint: str
) -> Taken | AcquisitionError | None:
    try:
        return registry.first(identity, key, fingerprint)
    except AcquisitionError as error:
        return error


def _check_key(own: OwnKey) -> None:
    _, key = own
    if not (0 < len(key) <= MAX_KEY_LENGTH and key.isascii() and key.isprintable()):
        message = f"must be 1 to {MAX_KEY_LENGTH} printable ASCII characters"
        raise BadBatch(Fault("Idempotency-Key", message, shown_value(key)))


def _raised(answer: Answered | AcquisitionError) -> Answered:
    if isinstance(answer, AcquisitionError):
        raise answer
    return answer
