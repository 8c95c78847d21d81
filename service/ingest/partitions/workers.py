"""Where tasks are done: in this process, in local processes, or by workers of a Dask scheduler."""

from collections.abc import Callable
from concurrent.futures import TimeoutError as NotYet
from pathlib import Path
from typing import Protocol

from service.errors import AcquisitionError, BadConfiguration
from service.ingest.local_workers import LocalWorkers, WorkerLost
from service.ingest.partitions.tasks import PartitionResult, PartitionTask, process_partition
from service.ingest.solver_pool import Solver
from service.ingest.worker_process import WorkerConfig

Outcome = PartitionResult | AcquisitionError
Wait = Callable[[float], PartitionResult | None]
"""Waits at most so many seconds for a result; None: there is none yet.

Raises `BadConfiguration` for what ends the reprocessing.
"""


class Workers(Protocol):
    """Whatever does tasks."""

    @property
    def most_pending(self) -> int:
        """How many tasks should be begun before the first of them is taken."""

    def submit(self, task: PartitionTask) -> Wait:
        """Begin with a task, or queue it."""

    def close(self) -> None:
        """Let what is unfinished go."""


def attempt(solver: Solver, task: PartitionTask) -> list[Outcome]:
    """Do a task in a worker; what went wrong is a result, with its words."""
    try:
        return list(process_partition(solver, task))
    except OSError as error:
        return [unwritten(task, error)]
    except AcquisitionError as error:
        return [error]


def unwritten(task: PartitionTask, error: OSError) -> BadConfiguration:
    """The error of a disk, such as a full one, in words."""
    file = error.filename or task.target
    return BadConfiguration(f"{file}: {error.strerror or error}")


def result_of(outcome: Outcome) -> PartitionResult:
    """The result of a task; raises what went wrong."""
    if isinstance(outcome, AcquisitionError):
        raise outcome
    return outcome


class OwnProcess:
    """Does a task when its result is asked for."""

    most_pending = 1

    def __init__(self, solver: Solver) -> None:
        self._solver = solver

    def submit(self, task: PartitionTask) -> Wait:
        """The task is begun when the function returned is called."""
        return lambda seconds: result_of(attempt(self._solver, task)[0])

    def close(self) -> None:
        """There is nothing to end."""


class LocalProcesses:
    """Does tasks in so many processes."""

    PENDING_A_WORKER = 2

    def __init__(self, config: WorkerConfig, count: int) -> None:
        self._workers = LocalWorkers[PartitionTask, Outcome](config, attempt, count)
        self.most_pending = self.PENDING_A_WORKER * count
        self._workers.start()

    @property
    def pids(self) -> frozenset[int]:
        """The processes that are ready to work."""
        return self._workers.pids

    def submit(self, task: PartitionTask) -> Wait:
        """Queue a task."""
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
        """End the processes."""
        self._workers.close()


def remove_unfinished(folder: Path, run_files: str) -> None:
    """Delete the files that killed workers left half-written."""
    for file in folder.glob(f"spacecraft=*/day=*/{run_files}"):
        file.unlink(missing_ok=True)
