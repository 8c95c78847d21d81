"""Coordinator of a reprocessing into an archive: plans tasks, distributes them, records results.

A part is written by a worker, then named in the manifest of its day, then noted in the database
with its rollups in one transaction.  An interruption between these steps leaves a file that the
next call uses, or a part that it notes.
"""

import hashlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path
from urllib.parse import quote

import pyarrow as pa
from sqlalchemy import ColumnElement, Connection, func, select

from service.errors import BadBatch, Fault, shown_value
from service.features.archive.archive import ParquetArchive
from service.features.archive.archiving import keep_settings
from service.features.archive.folder import (
    UNFINISHED,
    Part,
    claim,
    encoded,
    locked,
    manifest_of,
    manifests,
)
from service.features.archive.partition_tasks import (
    PartitionResult,
    PartitionTask,
    Source,
    Wait,
    Workers,
    remove_unfinished,
)
from service.features.archive.reprocessed import merge, name_part, restore_newest, unmerged
from service.features.archive.reprocessing import Reprocessing, now_text, write_reprocessing
from service.ingest.reprocess import (
    ReprocessPlan,
    ReprocessProgress,
    after_place,
    begin_run,
    not_yet,
    require_same_settings,
)
from service.storage.archived import PlacedPart, parts_between
from service.storage.queries.pages import PLACE, Place, ResultFilter, bounds_of
from service.storage.recording.identity import look_up
from service.storage.sql.tables import batches, results, rollups_daily
from service.storage.store import Store
from service.times import DAY_S, bucket_start, parse_utc

REPORT_EVERY_S = 1.0
"""Seconds between progress reports while no result arrives."""

Step = Callable[[ReprocessProgress], object]


@dataclass
class _ProgressReporter:
    """Reporter that writes and shows the progress of a reprocessing."""

    folder: Path
    source: str
    progress: ReprocessProgress
    step: Step
    started: str = field(default_factory=now_text)
    _last_s: float = 0.0

    def report(self, *, finished: bool = False, at_once: bool = True) -> None:
        now_s = time.monotonic()
        if at_once:
            self.step(self.progress)
        if not finished and now_s - self._last_s < REPORT_EVERY_S:
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
    """Run the batches of the plan's period that its run lacks, and write results to an archive.

    `workers` creates the workers for the tasks.  `step` is called at the start, after each part,
    and every second.  After an interruption another call continues.  Raises `BadBatch` for a run
    that is the source itself or has results of other settings, `BadConfiguration` where the folder
    is missing, in use or of another database, and for a failed task.
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
        reporter = _ProgressReporter(folder, plan.stretch.run or "", progress, step)
        _run_tasks(store, folder, planner, workers, reporter)
        for spacecraft in sorted(plan.missions):
            restore_newest(store, folder, spacecraft, plan.run)
        remove_unfinished(folder, unfinished)
        reporter.report(finished=True)
    return progress


# The partitions to run again: parts of the archive, and days of the record.
# A batch that the run has already, in either place, is in no task: an interrupted reprocessing
# continues, and every batch is run once.

MOST_BATCHES = 10_000
"""Largest number of batches in a task from the database, as in an archive part."""
_AT_ONCE = 1_000


@dataclass(frozen=True)
class Unit:
    """Unit of work: an archive part, or a day's recorded batches, with the number selected."""

    spacecraft: str
    day: int
    first_ns: int
    part: PlacedPart | None
    batches: int
    before: int = 0
    """Number of the unit's recorded batches that the run has already."""

    @property
    def partitions(self) -> int:
        """Maximum number of tasks of the reprocessing."""
        left = self.batches - self.before
        return 1 if self.part else -(-left // MOST_BATCHES)


@dataclass(frozen=True)
class UnitTasks:
    """Tasks of a unit of work, and the number of its batches that the run has already."""

    before: int
    tasks: Iterator[PartitionTask]


@dataclass
class Planner:
    """Planner that finds the batches to run again, and groups them into tasks."""

    store: Store
    folder: Path
    plan: ReprocessPlan
    catalog_digest: str
    _archive: ParquetArchive = field(init=False)
    _days: dict[str, set[int]] = field(init=False, default_factory=dict)
    """Days on which the run has batches, by spacecraft."""

    def __post_init__(self) -> None:
        self._archive = ParquetArchive(self.folder)

    def require_same_settings(self) -> None:
        """Raise `BadBatch` where the archive has parts of the run with other settings."""
        for manifest in manifests(self.folder):
            mission = self.plan.missions.get(manifest.spacecraft)
            for part in manifest.parts:
                if mission is None or part.run != self.plan.run:
                    continue
                has_catalog = part.catalogs == [self.catalog_digest]
                if part.missions != [mission.digest] or not has_catalog:
                    what = "mission" if has_catalog else "catalog"
                    message = (
                        f"holds results of {mission.name} with another {what}: name another run"
                    )
                    raise BadBatch(Fault("run", message, shown_value(self.plan.run)))

    def units(self) -> list[Unit]:
        """All units of work in the period, in order of time for each spacecraft."""
        found: list[Unit] = []
        with self.store.reading() as connection:
            for spacecraft in sorted(self.plan.missions):
                self._days[spacecraft] = set(_days(connection, spacecraft, self.plan.run))
                found += self._archived(connection, spacecraft)
                found += self._recorded(connection, spacecraft)
        return sorted(found, key=lambda unit: (unit.spacecraft, unit.first_ns))

    def tasks_of(self, unit: Unit) -> UnitTasks:
        """Create the tasks of a unit of work."""
        if unit.part is None:
            return UnitTasks(unit.before, self._of_record(unit))
        left_out, before = self._left_out(unit, unit.part)
        source = Source(unit.part.sha256, unit.part.path)
        task = self._task(unit, source, unit.batches - before, left_out)
        return UnitTasks(before, iter([task] if task.batches else []))

    def _archived(self, connection: Connection, spacecraft: str) -> Iterator[Unit]:
        stretch = self.plan.stretch
        for part in parts_between(connection, spacecraft, stretch.run, *bounds_of(stretch)):
            count = part.batches
            if _is_cut(part, stretch):
                count = len(self._archive.current_ids(part, *bounds_of(stretch)))
            day = Path(part.path).parent.name.removeprefix("day=")
            if count:
                yield Unit(spacecraft, _number(day), part.first_ns, part, count)

    def _recorded(self, connection: Connection, spacecraft: str) -> Iterator[Unit]:
        for day in _days(connection, spacecraft, self.plan.stretch.run):
            chosen = self._of_day(spacecraft, day)
            counted = select(func.count(), func.min(results.c.time_ns)).select_from(results)
            total, first_ns = connection.execute(counted.where(*chosen)).one()
            if not total:
                continue
            left = total
            if day in self._days[spacecraft]:
                joined = counted.join(batches, results.c.batch_id == batches.c.id)
                left, _ = connection.execute(joined.where(*chosen, not_yet(self.plan.run))).one()
            yield Unit(spacecraft, day, first_ns, None, int(total), int(total - left))

    def _of_day(self, spacecraft: str, day: int) -> list[ColumnElement[bool]]:
        begin_ns, end_ns = (bucket_start(day + k, DAY_S).tai_ns for k in (0, 1))
        return [
            *self.plan.stretch.conditions(),
            results.c.spacecraft == spacecraft,
            results.c.time_ns >= begin_ns,
            results.c.time_ns < end_ns,
        ]

    def _of_record(self, unit: Unit) -> Iterator[PartitionTask]:
        columns = (
            results.c.id,
            results.c.batch_id,
            batches.c.batch,
            batches.c.received,
            results.c.created,
            batches.c.input,
            results.c.options,
            results.c.current,
        )
        query = (
            select(results.c.time_ns, *columns)
            .join_from(results, batches, results.c.batch_id == batches.c.id)
            .where(*self._of_day(unit.spacecraft, unit.day), not_yet(self.plan.run))
            .order_by(*PLACE)
            .limit(MOST_BATCHES)
        )
        place: Place | None = None
        while True:
            beyond = query if place is None else query.where(after_place(place))
            with self.store.reading() as connection:
                rows = connection.execute(beyond).all()
            if not rows:
                return
            place = rows[-1].time_ns, rows[-1].batch_id
            table = pa.table({c.name: [getattr(row, c.name) for row in rows] for c in columns})
            content = encoded(table)
            source = Source(hashlib.sha256(content).hexdigest(), None, content)
            yield self._task(unit, source, len(rows), frozenset())

    def _task(
        self, unit: Unit, source: Source, count: int, left_out: frozenset[str]
    ) -> PartitionTask:
        return PartitionTask(
            self.folder,
            unit.spacecraft,
            bucket_start(unit.day, DAY_S).text[:10],
            self.plan.run,
            source,
            count,
            (self.plan.missions[unit.spacecraft].digest, self.catalog_digest),
            left_out,
        )

    def _left_out(self, unit: Unit, part: PlacedPart) -> tuple[frozenset[str], int]:
        """Batches of an archive part to leave out, and the number that the run has already."""
        is_cut = _is_cut(part, self.plan.stretch)
        is_begun = unit.day in self._days[unit.spacecraft]
        if not is_cut and not is_begun:
            return frozenset(), 0
        if not is_cut and sum(each.batches for each in self._made_of(unit, part)) == part.batches:
            return frozenset(), part.batches
        read = self._archive.read(part.path, ["batch", "time_ns"], [("current", "=", True)])
        times = dict(zip(read["batch"].to_pylist(), read["time_ns"].to_pylist(), strict=True))
        start_ns, end_ns = bounds_of(self.plan.stretch)
        outside = {
            name
            for name, time_ns in times.items()
            if (start_ns is not None and time_ns < start_ns)
            or (end_ns is not None and time_ns >= end_ns)
        }
        done = self._known(unit.spacecraft, sorted(times.keys() - outside)) if is_begun else set()
        return frozenset(outside | done), len(done)

    def _made_of(self, unit: Unit, part: PlacedPart) -> Sequence[Part]:
        """Archive parts of the run that were made from the whole of a given part."""
        day = bucket_start(unit.day, DAY_S).text[:10]
        named = manifest_of(self.folder, unit.spacecraft, day).parts
        return [p for p in named if p.run == self.plan.run and p.source == part.sha256]

    def _known(self, spacecraft: str, names: Sequence[str]) -> set[str]:
        found: set[str] = set()
        for first in range(0, len(names), _AT_ONCE):
            chunk = {(spacecraft, self.plan.run, name) for name in names[first : first + _AT_ONCE]}
            with self.store.reading() as connection:
                found |= {name for _, _, name in look_up(connection, chunk).identities}
        return found


def _is_cut(part: PlacedPart, stretch: ResultFilter) -> bool:
    start_ns, end_ns = bounds_of(stretch)
    return (start_ns is not None and part.first_ns < start_ns) or (
        end_ns is not None and part.last_ns >= end_ns
    )


def _days(connection: Connection, spacecraft: str, run: str | None) -> list[int]:
    c = rollups_daily.c
    query = select(c.bucket).where(c.spacecraft == spacecraft, c.run == run).order_by(c.bucket)
    return list(connection.scalars(query))


def _number(day: str) -> int:
    """Number of a day from its text, as `Utc.bucket` gives it."""
    return parse_utc(f"{day}T00:00:00Z").bucket(DAY_S)


def _run_tasks(
    store: Store,
    folder: Path,
    planner: Planner,
    workers: Callable[[], Workers],
    reporter: _ProgressReporter,
) -> None:
    progress = reporter.progress
    units = planner.units()
    progress.total = sum(unit.batches for unit in units)
    progress.partitions = sum(unit.partitions for unit in units)
    reporter.report()

    def tasks() -> Iterator[PartitionTask]:
        for unit in units:
            of_unit = planner.tasks_of(unit)
            progress.before += of_unit.before
            has_tasks = False
            for task in of_unit.tasks:
                has_tasks = True
                yield task
            if not has_tasks:
                progress.partitions_done += unit.partitions

    # Start workers only if a task is left.
    left = tasks()
    first = next(left, None)
    if first is None:
        return
    with closing(workers()) as doing:
        waiting: deque[Wait] = deque([doing.submit(first)])
        for task in left:
            waiting.append(doing.submit(task))
            while len(waiting) >= doing.most_pending:
                _take(store, folder, _waited(waiting.popleft(), reporter), reporter)
        while waiting:
            _take(store, folder, _waited(waiting.popleft(), reporter), reporter)


def _waited(wait: Wait, reporter: _ProgressReporter) -> PartitionResult:
    while (found := wait(REPORT_EVERY_S)) is None:
        reporter.report(at_once=False)
    return found


def _take(store: Store, folder: Path, found: PartitionResult, reporter: _ProgressReporter) -> None:
    if found.made is not None:
        merge(store, folder, name_part(folder, found.made), found.made)
    reporter.progress.recorded += found.batches
    reporter.progress.add_refused(found.refused)
    reporter.progress.partitions_done += 1
    reporter.report()
