"""Reprocessing task for one archive part: read batches, acquire with other settings, write.

The module also has the kinds of workers.  A task may run twice, on any machine, and be killed at
any point: its bytes follow from its input alone, and its file appears complete.  Values that would
differ between two runs are replaced in the results: ids derive from the source's ids, a result has
the time of its batch's receipt, and steps have zero duration.
"""

import hashlib
import io
from collections.abc import Callable, Sequence
from concurrent.futures import TimeoutError as NotYet
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol
from urllib.parse import quote

import pyarrow as pa
from msgspec import structs
from pyarrow import parquet
from sqlalchemy import Table

from service import __version__
from service.acquire import Acquisition
from service.errors import AcquisitionError, BadConfiguration
from service.features.archive.folder import (
    day_folder,
    encoded,
    read_partition,
    whole_content,
    write_first,
)
from service.features.archive.reprocessed import RunPart, run_part
from service.features.archive.rows import CHILDREN, Rows, from_partition, schema_of, to_partition
from service.ingest.local_workers import LocalWorkers, WorkerLost
from service.ingest.reprocess import RefusedBatch, submission_again
from service.ingest.solver_pool import Solver, mission_in_input
from service.ingest.worker_process import WorkerConfig
from service.observations.schema import Submission
from service.storage.recording.ids import derived_ulid
from service.storage.recording.unsaved_result import UnsavedResult, unsaved_submission
from service.storage.sql.columns import Row
from service.storage.sql.tables import batches, results
from service.times import recorded_utc

COLUMNS = ("id", "batch_id", "batch", "received", "created", "input", "options", "current")
"""Columns that a task reads from its source."""
AT_ONCE = 1_000
"""Number of batches acquired together."""
_DIGITS = 24
"""Length of a digest in a file name, in hexadecimal digits."""


@dataclass(frozen=True)
class Source:
    """Source of a task's batches: an archive part, or the content of one made from the database."""

    digest: str
    """SHA-256 of the source file."""
    path: str | None
    """Path of the source file within the archive; None: `content` holds the file."""
    content: bytes = b""

    def read(self, folder: Path) -> bytes:
        """Read the source file's content; raises `BadConfiguration` if missing or damaged."""
        return self.content if self.path is None else whole_content(folder, self.path, self.digest)


@dataclass(frozen=True)
class PartitionTask:
    """Task of a reprocessing: a day's batches to run again, and the place of the results."""

    folder: Path
    spacecraft: str
    day: str
    run: str
    source: Source
    batches: int
    settings: tuple[str, str]
    """Digests of the mission and of the catalog."""
    left_out: frozenset[str] = frozenset()
    """Names of batches that the run has already, which the task leaves out."""

    @property
    def digest(self) -> str:
        """Digest of the task's input: the source without the batches left out."""
        if not self.left_out:
            return self.source.digest
        names = "\0".join((self.source.digest, *sorted(self.left_out)))
        return hashlib.sha256(names.encode()).hexdigest()

    @property
    def target(self) -> Path:
        """Path of the result file, which is unique for the source, settings and version."""
        made_from = "\0".join((self.digest, *self.settings, __version__))
        digest = hashlib.sha256(made_from.encode()).hexdigest()[:_DIGITS]
        place = day_folder(self.folder, self.spacecraft, self.day)
        return place / f"run-{quote(self.run, safe='')}-{digest}.parquet"


@dataclass(frozen=True)
class PartitionResult:
    """Result of a task: the archive part, and the batches that the settings do not allow."""

    made: RunPart | None
    """Archive part that was written; None if every batch was refused."""
    refused: Sequence[RefusedBatch]

    @property
    def batches(self) -> int:
        """Number of batches with a result."""
        return 0 if self.made is None else self.made.part.batches


def process_partition(solver: Solver, task: PartitionTask) -> list[PartitionResult]:
    """Run a task, and write its archive part unless that exists or no batch has a result."""
    found: list[UnsavedResult] = []
    refused: list[RefusedBatch] = []
    stored = [row for row in _stored(task) if row["batch"] not in task.left_out]
    for start in range(0, len(stored), AT_ONCE):
        chunk = stored[start : start + AT_ONCE]
        submissions = [submission_again(each["input"], each["options"], task.run) for each in chunk]
        several = solver.acquired([each.batch for each in submissions])
        for row, submission, acquired in zip(chunk, submissions, several, strict=True):
            if isinstance(acquired, AcquisitionError):
                refused.append(RefusedBatch(row["batch"], str(acquired)))
            elif isinstance(acquired, Exception):
                raise acquired
            else:
                found.append(_unsaved(solver, submission, row, acquired))
    if not found:
        return [PartitionResult(None, refused)]
    rows = _rows_of(found)
    content = encoded(to_partition(rows))
    written = write_first(task.target, content)
    if written != content:
        # A different kind of process has written the file first: use its results.
        rows = from_partition(read_partition(written))
    return [PartitionResult(run_part(task.target.name, task.digest, rows, written), refused)]


def _stored(task: PartitionTask) -> list[dict[str, str]]:
    content = io.BytesIO(task.source.read(task.folder))
    table = parquet.read_table(
        content,
        columns=list(COLUMNS),
        filters=[("current", "=", True)],
        page_checksum_verification=True,
    )
    found: list[dict[str, str]] = table.to_pylist()
    return found


def _unsaved(
    solver: Solver, submission: Submission, row: dict[str, str], acquired: Acquisition
) -> UnsavedResult:
    batch = submission.batch
    mission = mission_in_input(solver.missions, batch.spacecraft)
    # Derive the id from the first result, also where the source's current one is an adopted
    # what-if.
    first = row["batch_id"] or row["id"]
    id = derived_ulid(first, batch.run, mission.digest, solver.sky.catalog.digest)
    received = recorded_utc(row["received"] or row["created"])
    return unsaved_submission(submission, _repeatable(acquired), id=id, received=received)


def _repeatable(acquisition: Acquisition) -> Acquisition:
    """The acquisition without values that differ between equal runs: timings and cached zones."""
    return structs.replace(
        acquisition,
        timings_us=dict.fromkeys(acquisition.timings_us, 0),
        trackers=tuple(structs.replace(each, zone_cached=False) for each in acquisition.trackers),
    )


def _rows_of(found: Sequence[UnsavedResult]) -> Rows:
    """Rows that recording the results would insert, in the order of `read_rows`."""
    in_order = sorted(found, key=lambda each: (each.result["time_ns"], each.id))
    children = {
        "stars": [_ordered(each.stars, "tracker", "position") for each in in_order],
        "solution": [[each.solution] if each.solution else [] for each in in_order],
        "trackers": [_ordered(each.trackers, "tracker") for each in in_order],
        "frame": [],
        "keys": [],
    }
    rows = {
        "batches": _table(batches, [each.batch for each in in_order]),
        "results": _table(results, [each.result_row(each.answer) for each in in_order]),
    }
    for name, (table, _, _) in CHILDREN.items():
        rows[table.name] = _table(table, [row for group in children[name] for row in group])
    return rows


def _ordered(rows: Sequence[Row], *names: str) -> list[Row]:
    return sorted(rows, key=lambda row: tuple(row[name] for name in names))


def _table(table: Table, rows: Sequence[Row | None]) -> pa.Table:
    return pa.Table.from_pylist(rows, schema=schema_of(table))


Outcome = PartitionResult | AcquisitionError
Wait = Callable[[float], PartitionResult | None]
"""Function that waits at most the given seconds for a result; returns None if there is none yet.

Raises `BadConfiguration` for an error that ends the reprocessing.
"""


class Workers(Protocol):
    """Interface of the workers that run reprocessing tasks."""

    @property
    def most_pending(self) -> int:
        """Number of tasks to submit before the first result is collected."""

    def submit(self, task: PartitionTask) -> Wait:
        """Start or queue a task; returns the function that waits for its result."""

    def close(self) -> None:
        """Abandon the tasks that are not finished."""


def attempt(solver: Solver, task: PartitionTask) -> list[Outcome]:
    """Run a task in a worker; an error is returned as the outcome."""
    try:
        return list(process_partition(solver, task))
    except OSError as error:
        return [unwritten(task, error)]
    except AcquisitionError as error:
        return [error]


def unwritten(task: PartitionTask, error: OSError) -> BadConfiguration:
    """Convert an error of the disk, such as a full one, to an error that names the file."""
    file = error.filename or task.target
    return BadConfiguration(f"{file}: {error.strerror or error}")


def result_of(outcome: Outcome) -> PartitionResult:
    """Result of a task's outcome; raises the error, if the outcome is one."""
    if isinstance(outcome, AcquisitionError):
        raise outcome
    return outcome


class OwnProcess:
    """Worker that runs a task in this process when its result is requested."""

    most_pending = 1

    def __init__(self, solver: Solver) -> None:
        self._solver = solver

    def submit(self, task: PartitionTask) -> Wait:
        """Return a function that runs the task when it is called."""
        return lambda seconds: result_of(attempt(self._solver, task)[0])

    def close(self) -> None:
        """Do nothing on closing: there are no processes to end."""


class LocalProcesses:
    """Workers that run tasks in local processes."""

    PENDING_A_WORKER = 2

    def __init__(self, config: WorkerConfig, count: int) -> None:
        self._workers = LocalWorkers[PartitionTask, Outcome](config, attempt, count)
        self.most_pending = self.PENDING_A_WORKER * count
        self._workers.start()

    @property
    def pids(self) -> frozenset[int]:
        """Ids of the processes that are ready to work."""
        return self._workers.pids

    def submit(self, task: PartitionTask) -> Wait:
        """Queue a task for the local processes; returns the function that waits for its result."""
        future = self._workers.submit(task)

        def wait(seconds: float) -> PartitionResult | None:
            try:
                (outcome,) = future.result(seconds)
            except NotYet:
                # Workers without new tasks end after a while; this task still needs one.
                self._workers.start()
                return None
            except WorkerLost as error:
                raise BadConfiguration(
                    f"{task.target}: cannot be computed: {error}; to go on, run the command again"
                ) from None
            return result_of(outcome)

        return wait

    def close(self) -> None:
        """End the local processes."""
        self._workers.close()


def remove_unfinished(folder: Path, run_files: str) -> None:
    """Delete incomplete files of killed workers."""
    for file in folder.glob(f"spacecraft=*/day=*/{run_files}"):
        file.unlink(missing_ok=True)
