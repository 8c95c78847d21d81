"""Reprocessing into an archive: hands out the tasks, names what they wrote, keeps the trends.

A part is written by a worker, then named in the manifest of its day, then noted in the database
with its rollups in one transaction.  Whatever ends the command in between leaves a file that the
next one takes, or a part that it notes.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

from service.ingest.partitions.plan import Planner
from service.ingest.partitions.tasks import (
    PartitionResult,
    PartitionTask,
    Wait,
    Workers,
    remove_unfinished,
)
from service.ingest.reprocess import (
    ReprocessPlan,
    ReprocessProgress,
    begin_run,
    require_same_settings,
)
from service.storage.archive.folder import UNFINISHED, claim, locked
from service.storage.store import Store
from service.storage.upkeep.archiving import keep_settings
from service.storage.upkeep.reprocessed import merge, name_part, restore_newest, unmerged
from service.storage.upkeep.reprocessing import Reprocessing, now_text, write_reprocessing

TOLD_EVERY_S = 1.0
"""How often the state is written, and `step` called, while nothing comes."""

Step = Callable[[ReprocessProgress], object]


@dataclass
class _Told:
    """Writes and shows how far it is."""

    folder: Path
    source: str
    progress: ReprocessProgress
    step: Step
    started: str = field(default_factory=now_text)
    _last_s: float = 0.0

    def tell(self, *, finished: bool = False, at_once: bool = True) -> None:
        now_s = time.monotonic()
        if at_once:
            self.step(self.progress)
        if not finished and now_s - self._last_s < TOLD_EVERY_S:
            return
        if not at_once:
            self.step(self.progress)
        self._last_s = now_s
        now, of = now_text(), self.progress
        state = Reprocessing(
            run=of.run,
            source=self.source,
            partitions=of.partitions,
            partitions_done=of.partitions_done,
            batches=of.total,
            before=of.before,
            recorded=of.recorded,
            refused=of.refused,
            started=self.started,
            updated=now,
            finished=now if finished else None,
        )
        write_reprocessing(self.folder, state)


def reprocess_partitions(
    store: Store,
    folder: Path,
    plan: ReprocessPlan,
    catalog_digest: str,
    workers: Callable[[], Workers],
    step: Step,
) -> ReprocessProgress:
    """Run every batch of the plan's stretch that its run does not hold yet, into an archive.

    `workers` makes those that do the tasks.  `step` is called at the start, after each partition,
    and every second.  Interrupted, it is called again and goes on.  Raises `BadBatch` for a run
    that is the source itself or has results of other settings, `BadConfiguration` where the folder
    is missing, in use or of another database, and for what keeps a task from being done.
    """
    with locked(folder):
        require_same_settings(store, plan, catalog_digest)
        planner = Planner(store, folder, plan, catalog_digest)
        planner.require_same_settings()
        with store.reading_record() as connection:
            claim(connection, folder)
            digests = [each.digest for each in plan.missions.values()]
            keep_settings(connection, folder, digests, [catalog_digest])
        begin_run(store, plan)
        unfinished = f".run-{quote(plan.run, safe='')}-*{UNFINISHED}"
        remove_unfinished(folder, unfinished)
        for path, made in unmerged(store, folder, plan.run):
            merge(store, folder, path, made)
        progress = ReprocessProgress(plan.run, 0, 0)
        told = _Told(folder, plan.stretch.run or "", progress, step)
        _run_tasks(store, folder, planner, workers, told)
        for spacecraft in sorted(plan.missions):
            restore_newest(store, folder, spacecraft, plan.run)
        remove_unfinished(folder, unfinished)
        told.tell(finished=True)
    return progress


def _run_tasks(
    store: Store,
    folder: Path,
    planner: Planner,
    workers: Callable[[], Workers],
    told: _Told,
) -> None:
    progress = told.progress
    units = planner.units()
    progress.total = sum(unit.batches for unit in units)
    progress.partitions = sum(unit.partitions for unit in units)
    told.tell()

    def tasks() -> Iterator[PartitionTask]:
        for unit in units:
            of_unit = planner.tasks_of(unit)
            progress.before += of_unit.before
            some = False
            for task in of_unit.tasks:
                some = True
                yield task
            if not some:
                progress.partitions_done += unit.partitions

    # Workers start only if a task is left.
    left = tasks()
    first = next(left, None)
    if first is None:
        return
    with closing(workers()) as doing:
        waiting: deque[Wait] = deque([doing.submit(first)])
        for task in left:
            waiting.append(doing.submit(task))
            while len(waiting) >= doing.most_pending:
                _take(store, folder, _waited(waiting.popleft(), told), told)
        while waiting:
            _take(store, folder, _waited(waiting.popleft(), told), told)


def _waited(wait: Wait, told: _Told) -> PartitionResult:
    while (found := wait(TOLD_EVERY_S)) is None:
        told.tell(at_once=False)
    return found


def _take(store: Store, folder: Path, found: PartitionResult, told: _Told) -> None:
    if found.made is not None:
        merge(store, folder, name_part(folder, found.made), found.made)
    told.progress.recorded += found.batches
    told.progress.add_refused(found.refused)
    told.progress.partitions_done += 1
    told.tell()
