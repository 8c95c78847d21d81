"""Recorded batches run again into a named run: over all cores, and resumable.

Workers compute; this process alone reads and writes, since SQLite has one
writer.  What the run holds already is left out of the reading, so that a
reprocessing that was stopped, however hard, goes on where it was.
"""

import dataclasses
import json
import multiprocessing
import os
import signal
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import ColumnElement, and_, exists, func, select

from service.acquire import acquire
from service.errors import AcquisitionError, BadBatch, Busy, Fault, shown_value
from service.missions.mission import Mission
from service.observe.wire import BatchIn, OptionsIn, submission_from_model
from service.records.draft import Answered, Draft, submission_draft
from service.records.ids import Ulids
from service.records.pages import PLACE, Stretch
from service.records.store import Store
from service.records.tables import batches, results
from service.sky.catalog import open_catalog
from service.sky.shelf import Shelf
from service.sky.view import Sky
from service.times import utc_now

CHUNK = 100
"""Batches that a worker takes, and that a transaction records."""
AHEAD = 2
"""Chunks a worker that wait for it, or for being written."""
REFUSALS_KEPT = 20

Stored = tuple[str, str]
"""A batch's input and the options of its result, as the JSON texts that are kept."""


@dataclass
class Progress:
    """How far a reprocessing is: `total` are the batches of the stretch, `before` those done."""

    run: str
    total: int
    before: int
    recorded: int = 0
    refused: int = 0
    refusals: list[str] = field(default_factory=list)
    """The first of them, each naming its batch."""


@dataclass(frozen=True)
class Plan:
    """What is to run again: the stretch, the run that takes it, and with which settings."""

    stretch: Stretch
    run: str
    missions: Mapping[str, Mission]
    catalog: Path | None
    shelf_bytes: int
    processes: int = 0
    """How many workers; 0: one a core, 1: none but this process."""


@dataclass(frozen=True)
class Refused:
    """A batch that the settings cannot take, and why."""

    batch: str
    why: str


def reprocess(
    store: Store, plan: Plan, catalog_digest: str, step: Callable[[Progress], object]
) -> Progress:
    """Run every batch of the plan's stretch that its run does not hold yet.

    `step` is called at the start and after each transaction.  Raises `BadBatch`
    for a run that is the source itself, or holds results of other settings.
    """
    _require_same_settings(store, plan, catalog_digest)
    progress = _counted(store, plan)
    step(progress)
    with _workers(plan) as submit:
        waiting: deque[Future[list[Draft | Refused]]] = deque()
        most = AHEAD * _processes(plan)
        for chunk in _chunks(store, plan):
            waiting.append(submit(chunk))
            if len(waiting) >= most:
                _record(store, waiting.popleft().result(), progress)
                step(progress)
        while waiting:
            _record(store, waiting.popleft().result(), progress)
            step(progress)
    return progress


def _require_same_settings(store: Store, plan: Plan, catalog_digest: str) -> None:
    if plan.run == plan.stretch.run:
        message = "must be another run than the one whose batches are run again"
        raise BadBatch(Fault("run", message, shown_value(plan.run)))
    made_with = select(
        results.c.spacecraft, results.c.mission_digest, results.c.catalog_digest
    ).where(results.c.run == plan.run, results.c.current)
    with store.reading() as connection:
        for spacecraft, mission, catalog in connection.execute(made_with.distinct()):
            if spacecraft not in plan.missions:
                continue
            if (mission, catalog) != (plan.missions[spacecraft].digest, catalog_digest):
                what = "mission" if catalog == catalog_digest else "catalog"
                message = f"holds results of {spacecraft} with another {what}: name another run"
                raise BadBatch(Fault("run", message, shown_value(plan.run)))


def _conditions(plan: Plan) -> list[ColumnElement[bool]]:
    return [*plan.stretch.conditions(), results.c.spacecraft.in_(sorted(plan.missions))]


def _not_yet(plan: Plan) -> ColumnElement[bool]:
    """Whether a batch is not in the plan's run, as SQL beside `batches`."""
    done = batches.alias("done")
    return ~exists().where(
        and_(
            done.c.spacecraft == batches.c.spacecraft,
            done.c.run == plan.run,
            done.c.batch == batches.c.batch,
        )
    )


def _counted(store: Store, plan: Plan) -> Progress:
    joined = (
        select(func.count()).select_from(results).join(batches, results.c.batch_id == batches.c.id)
    )
    with store.reading() as connection:
        total = connection.scalar(joined.where(*_conditions(plan))) or 0
        left = connection.scalar(joined.where(*_conditions(plan), _not_yet(plan))) or 0
    return Progress(plan.run, int(total), int(total) - int(left))


def _chunks(store: Store, plan: Plan) -> Iterator[list[Stored]]:
    """What is still to be done, in order of time; no moment of the database is held on to."""
    place: tuple[int, str] | None = None
    query = (
        select(*PLACE, batches.c.input, results.c.options)
        .join_from(results, batches, results.c.batch_id == batches.c.id)
        .where(*_conditions(plan), _not_yet(plan))
        .order_by(*PLACE)
        .limit(CHUNK)
    )
    while True:
        beyond = query if place is None else query.where(_after(place))
        with store.reading() as connection:
            rows = connection.execute(beyond).all()
        if not rows:
            return
        place = rows[-1][0], rows[-1][1]
        yield [(row[2], row[3]) for row in rows]


def _after(place: tuple[int, str]) -> ColumnElement[bool]:
    time_ns, batch_id = PLACE
    return (time_ns > place[0]) | and_(time_ns == place[0], batch_id > place[1])


def _record(store: Store, found: Sequence[Draft | Refused], progress: Progress) -> None:
    drafts = [each for each in found if isinstance(each, Draft)]
    refused = [each for each in found if isinstance(each, Refused)]
    outcomes = store.writer.record(drafts).result() if drafts else []
    for draft, outcome in zip(drafts, outcomes, strict=True):
        if isinstance(outcome, Answered):
            progress.recorded += 1
        elif isinstance(outcome, AcquisitionError) and not isinstance(outcome, Busy):
            refused.append(Refused(draft.identity[2], str(outcome)))
        else:
            # Trouble of the database: nothing was decided about any of them.
            raise outcome
    progress.refused += len(refused)
    room = REFUSALS_KEPT - len(progress.refusals)
    progress.refusals += [f"{each.batch}: {each.why}" for each in refused[:room]]


# ---- workers -----------------------------------------------------------------------------------


class Again:
    """Computes batches again: what a worker holds."""

    def __init__(self, plan: Plan) -> None:
        self._plan = plan
        self._sky = Sky(open_catalog(plan.catalog), Shelf(plan.shelf_bytes))
        self._ids = Ulids()

    def drafts(self, chunk: Sequence[Stored]) -> list[Draft | Refused]:
        """The drafts of stored batches in the plan's run, with what cannot be taken."""
        return [self._draft(*each) for each in chunk]

    def _draft(self, input: str, options: str) -> Draft | Refused:
        model = BatchIn.model_validate_json(input).model_copy(
            update={
                "run": self._plan.run,
                "options": OptionsIn.model_validate(json.loads(options)),
            }
        )
        try:
            submission = submission_from_model(model)
            batch = submission.batch
            acquisition = acquire(batch, self._plan.missions[batch.spacecraft], self._sky)
        except AcquisitionError as error:
            return Refused(model.batch, str(error))
        draft = submission_draft(submission, acquisition, id=self._ids.new(), received=utc_now())
        # Zones and run catalogs stay where they are.
        return dataclasses.replace(draft, acquisition=None)


_held: Again


def _open(plan: Plan) -> None:
    # Whoever interrupts the command interrupts its process, which ends its workers.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    global _held
    _held = Again(plan)


def _worked(chunk: Sequence[Stored]) -> list[Draft | Refused]:
    return _held.drafts(chunk)


def _processes(plan: Plan) -> int:
    return plan.processes or os.cpu_count() or 1


@contextmanager
def _workers(
    plan: Plan,
) -> "Iterator[Callable[[Sequence[Stored]], Future[list[Draft | Refused]]]]":
    """A function that hands a chunk to a worker; the workers end with the block."""
    count = _processes(plan)
    if count == 1:
        again = Again(plan)

        def here(chunk: Sequence[Stored]) -> "Future[list[Draft | Refused]]":
            done: Future[Any] = Future()
            done.set_result(again.drafts(chunk))
            return done

        yield here
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(count, mp_context=context, initializer=_open, initargs=(plan,))
    try:
        yield lambda chunk: pool.submit(_worked, chunk)
    finally:
        pool.shutdown(cancel_futures=True)
