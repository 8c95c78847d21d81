"""Reprocessing of recorded batches into a named run, on all cores, and resumable.

Workers compute; this process alone reads and writes, since SQLite has one writer.  Batches that the
run already holds are skipped, so that an interrupted reprocessing continues.
"""

import json
import os
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from sqlalchemy import ColumnElement, Connection, and_, exists, func, select, update

from service.errors import AcquisitionError, BadBatch, Busy, Fault, shown_value
from service.ingest.local_workers import ChunkEndsWorkers, LocalWorkers, WorkerLost
from service.ingest.solver_pool import Solver
from service.ingest.tracking import tracked_again
from service.ingest.worker_process import WorkerConfig
from service.missions.mission import Mission
from service.observations.schema import LIVE, BatchIn, OptionsIn, Submission, submission_from_model
from service.storage.queries.pages import PLACE, ResultFilter
from service.storage.recording.unsaved_result import Answered, UnsavedResult
from service.storage.sql.statements import insert_runs
from service.storage.sql.tables import archived_batches, batches, results, runs
from service.storage.store import Store
from service.times import utc_now

CHUNK = 100
"""Number of batches in a worker's task and in a transaction."""
PENDING_A_WORKER = 2
"""Number of chunks for each worker that wait to be computed or written."""
REFUSALS_KEPT = 20

StoredBatch = tuple[str, str]
"""Stored batch: its input and the options of its result, as JSON texts."""


@dataclass
class ReprocessProgress:
    """Progress of a reprocessing: `total` batches in the period, `before` of them done earlier."""

    run: str
    total: int
    before: int
    recorded: int = 0
    refused: int = 0
    refusals: list[str] = field(default_factory=list)
    """Messages of the first refused batches, each naming its batch."""
    partitions: int = 0
    """Upper bound on the number of archive parts of a reprocessing into an archive."""
    partitions_done: int = 0

    def add_refused(self, refused: Sequence["RefusedBatch"]) -> None:
        """Count refused batches, and keep the messages of the first ones."""
        self.refused += len(refused)
        room = REFUSALS_KEPT - len(self.refusals)
        self.refusals += [f"{each.batch}: {each.why}" for each in refused[:room]]


@dataclass(frozen=True)
class ReprocessPlan:
    """Plan of a reprocessing: the batches to run again, the target run, and the settings."""

    stretch: ResultFilter
    run: str
    missions: Mapping[str, Mission]
    catalog: Path | None
    cache_bytes: int
    processes: int = 0
    """Number of worker processes of a reprocessing; 0: one for each core, 1: only this process."""
    track: bool = False
    """True if stars are searched about the run's last attitude, batch after batch."""


@dataclass(frozen=True)
class RefusedBatch:
    """Batch that cannot be computed with the settings, and the reason."""

    batch: str
    why: str


def reprocess(
    store: Store,
    plan: ReprocessPlan,
    catalog_digest: str,
    own: Solver,
    step: Callable[[ReprocessProgress], object],
) -> ReprocessProgress:
    """Run every batch of the plan's period that its run does not hold yet.

    `own` computes the batches to be tracked, workers all others.  `step` is called at the start and
    after each chunk.  Raises `BadBatch` for a run that is the source itself, or holds results of
    other settings.
    """
    require_same_settings(store, plan, catalog_digest)
    progress = _counted(store, plan)
    if progress.before < progress.total:
        begin_run(store, plan)
    step(progress)
    if plan.track:
        _track(store, plan, own, progress, step)
        return progress
    with closing(_ChunkSolver(plan, catalog_digest)) as solver:
        waiting: deque[Callable[[], list[UnsavedResult | RefusedBatch]]] = deque()
        most = PENDING_A_WORKER * solver.count
        for chunk in _chunks(store, plan):
            waiting.append(solver.take(chunk))
            if len(waiting) >= most:
                _record(store, waiting.popleft()(), progress)
                step(progress)
        while waiting:
            _record(store, waiting.popleft()(), progress)
            step(progress)
    return progress


def require_other_run(run: str, source: str | None) -> None:
    """Raise `BadBatch` if the target run of a reprocessing is its source."""
    if run == source:
        message = "must be another run than the one whose batches are run again"
        raise BadBatch(Fault("run", message, shown_value(run)))


def require_same_settings(store: Store, plan: ReprocessPlan, catalog_digest: str) -> None:
    """Raise `BadBatch` if the target run is the source, or has results of other settings.

    The settings include tracking, on or off.
    """
    require_other_run(plan.run, plan.stretch.run)
    made_with = select(
        results.c.spacecraft, results.c.mission_digest, results.c.catalog_digest
    ).where(results.c.run == plan.run, results.c.current)
    with store.reading_record() as connection:
        for spacecraft, mission, catalog in connection.execute(made_with.distinct()):
            if spacecraft not in plan.missions:
                continue
            if (mission, catalog) != (plan.missions[spacecraft].digest, catalog_digest):
                what = "mission" if catalog == catalog_digest else "catalog"
                message = f"holds results of {spacecraft} with another {what}: name another run"
                raise BadBatch(Fault("run", message, shown_value(plan.run)))
        was_tracked = connection.scalar(select(runs.c.tracked).where(runs.c.name == plan.run))
        if was_tracked in (None, plan.track) or not _has_results(connection, plan.run):
            return
    message = (
        "was begun with --track: continue it with --track, or name another run"
        if was_tracked
        else "was begun without --track: continue it without, or name another run"
    )
    raise BadBatch(Fault("run", message, shown_value(plan.run)))


def begin_run(store: Store, plan: ReprocessPlan) -> None:
    """Create the run with its tracking mode, before its first result."""

    def change(connection: Connection) -> None:
        insert_runs(connection, {plan.run: utc_now().text})
        noted = update(runs).where(runs.c.name == plan.run)
        connection.execute(noted.values(tracked=plan.track))

    store.writer.change(change)


def _has_results(connection: Connection, run: str) -> bool:
    return any(
        connection.execute(select(table.c.run).where(table.c.run == run).limit(1)).first()
        for table in (results, archived_batches)
    )


def _conditions(plan: ReprocessPlan) -> list[ColumnElement[bool]]:
    return [*plan.stretch.conditions(), results.c.spacecraft.in_(sorted(plan.missions))]


def not_yet(run: str) -> ColumnElement[bool]:
    """SQL condition on `batches`: the batch is not in a run, neither recorded nor archived."""
    done = batches.alias("done")
    return and_(
        *(
            ~exists().where(
                table.c.spacecraft == batches.c.spacecraft,
                table.c.run == run,
                table.c.batch == batches.c.batch,
            )
            for table in (done, archived_batches)
        )
    )


def _counted(store: Store, plan: ReprocessPlan) -> ReprocessProgress:
    joined = (
        select(func.count()).select_from(results).join(batches, results.c.batch_id == batches.c.id)
    )
    with store.reading_record() as connection:
        total = connection.scalar(joined.where(*_conditions(plan))) or 0
        left = connection.scalar(joined.where(*_conditions(plan), not_yet(plan.run))) or 0
    return ReprocessProgress(plan.run, int(total), int(total) - int(left))


def _chunks(store: Store, plan: ReprocessPlan) -> Iterator[list[StoredBatch]]:
    """Batches still to be run, in order of time, in chunks; no read transaction stays open."""
    place: tuple[int, str] | None = None
    query = (
        select(*PLACE, batches.c.input, results.c.options)
        .join_from(results, batches, results.c.batch_id == batches.c.id)
        .where(*_conditions(plan), not_yet(plan.run))
        .order_by(*PLACE)
        .limit(CHUNK)
    )
    while True:
        beyond = query if place is None else query.where(after_place(place))
        with store.reading_record() as connection:
            rows = connection.execute(beyond).all()
        if not rows:
            return
        place = rows[-1][0], rows[-1][1]
        yield [(row[2], row[3]) for row in rows]


def after_place(place: tuple[int, str]) -> ColumnElement[bool]:
    """SQL condition that a result follows a position in the order of time."""
    time_ns, batch_id = PLACE
    return (time_ns > place[0]) | and_(time_ns == place[0], batch_id > place[1])


def _record(
    store: Store, found: Sequence[UnsavedResult | RefusedBatch], progress: ReprocessProgress
) -> None:
    unsaved_results = [each for each in found if isinstance(each, UnsavedResult)]
    refused = [each for each in found if isinstance(each, RefusedBatch)]
    store.progress.hold_back()
    outcomes = store.writer.record(unsaved_results) if unsaved_results else []
    for unsaved, outcome in zip(unsaved_results, outcomes, strict=True):
        if isinstance(outcome, Answered):
            progress.recorded += 1
        elif isinstance(outcome, AcquisitionError) and not isinstance(outcome, Busy):
            refused.append(RefusedBatch(unsaved.identity[2], str(outcome)))
        else:
            # A fault of the database decides nothing about any of the batches.
            raise outcome
    progress.add_refused(refused)


def _track(
    store: Store,
    plan: ReprocessPlan,
    solver: Solver,
    progress: ReprocessProgress,
    step: Callable[[ReprocessProgress], object],
) -> None:
    """Run batches in sequence, each recorded before the next is predicted from it."""
    for chunk in _chunks(store, plan):
        for input, options in chunk:
            submission = submission_again(input, options, plan.run)
            mission = plan.missions[submission.batch.spacecraft]
            found: UnsavedResult | RefusedBatch
            try:
                with store.reading_record() as connection:
                    submission = tracked_again(
                        connection, submission, mission, plan.stretch.run or LIVE
                    )
                found = solver.solve(submission)
            except Busy:
                raise
            except AcquisitionError as error:
                found = RefusedBatch(submission.batch.batch, str(error))
            _record(store, [found], progress)
        step(progress)


# ---- workers -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class _WorkerTask:
    """Task of a worker: stored batches and their target run."""

    run: str
    stored: Sequence[StoredBatch]


def process_again(solver: Solver, part: _WorkerTask) -> list[UnsavedResult | RefusedBatch]:
    """Compute stored batches again for a run; gives unsaved results and refused batches."""
    submissions = [submission_again(*each, part.run) for each in part.stored]
    received = utc_now()
    found: list[UnsavedResult | RefusedBatch] = []
    several = solver.acquired([each.batch for each in submissions])
    for submission, acquired in zip(submissions, several, strict=True):
        try:
            found.append(solver.unsaved(submission, acquired, received))
        except AcquisitionError as error:
            found.append(RefusedBatch(submission.batch.batch, str(error)))
    return found


def submission_again(input: str, options: str, run: str) -> Submission:
    """Copy a stored batch to another run, with the options of its current result."""
    model = BatchIn.model_validate_json(input).model_copy(
        update={"run": run, "options": OptionsIn.model_validate(json.loads(options))}
    )
    return submission_from_model(model)


class _ChunkSolver:
    """Solver of chunks in workers; in this process if there is one worker, or they are lost."""

    def __init__(self, plan: ReprocessPlan, catalog_digest: str) -> None:
        self._run = plan.run
        self._config = WorkerConfig(plan.missions, plan.catalog, catalog_digest, plan.cache_bytes)
        self.count = plan.processes or os.cpu_count() or 1
        self._workers = LocalWorkers[_WorkerTask, UnsavedResult | RefusedBatch](
            self._config, process_again, self.count
        )
        if self.count > 1:
            self._workers.start()

    @cached_property
    def _solver(self) -> Solver:
        return self._config.solver()

    def take(
        self, stored: Sequence[StoredBatch]
    ) -> Callable[[], list[UnsavedResult | RefusedBatch]]:
        """Start computing batches; returns a function that waits for the results."""
        part = _WorkerTask(self._run, stored)
        if self.count == 1:
            return lambda: process_again(self._solver, part)
        future = self._workers.submit(part)

        def found() -> list[UnsavedResult | RefusedBatch]:
            try:
                return future.result()
            except ChunkEndsWorkers as error:
                batches = [json.loads(input)["batch"] for input, _ in stored]
                return [RefusedBatch(batch, str(error)) for batch in batches]
            except WorkerLost:
                return process_again(self._solver, part)

        return found

    def close(self) -> None:
        """Stop the worker processes."""
        self._workers.close()
