"""Reprocessing of runs into an archive, for an open app."""

import os
from collections.abc import Callable
from pathlib import Path

from service.app.factory import App
from service.errors import BadBatch, Fault
from service.features.archive.reprocessing import Reprocessing, reprocessings
from service.ingest.reprocess import ReprocessProgress
from service.ingest.solver_pool import Solver
from service.ingest.worker_process import WorkerConfig
from service.observations.schema import LIVE
from service.times import Utc


class Reprocessings:
    """Processes runs again into an archive, and lists the reprocessings into the service's own."""

    def __init__(self, app: App) -> None:
        self._app = app

    def reprocess(
        self,
        run: str | None,
        folder: Path,
        *,
        source: str = LIVE,
        spacecraft: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        processes: int = 0,
        scheduler: str | None = None,
        step: Callable[[ReprocessProgress], object] = lambda progress: None,
    ) -> ReprocessProgress:
        """Process the batches of a run again into parts of an archive, archived ones included.

        Local processes compute, or the workers of a Dask scheduler.  See `Runs.reprocess`.
        """
        from service.features.archive.partition_coordinator import reprocess_partitions
        from service.features.archive.partition_tasks import LocalProcesses, OwnProcess, Workers

        plan = self._app.runs.plan(run, source, spacecraft, start, end, processes)
        if plan.run == LIVE:
            raise BadBatch(Fault("run", "must be another run than the live one", LIVE))
        digest = self._app.sky.catalog.digest
        config = WorkerConfig(plan.missions, plan.catalog, digest, plan.cache_bytes)

        def workers() -> Workers:
            if scheduler is not None:
                from service.features.archive.dask_workers import DaskWorkers

                return DaskWorkers(scheduler, config, folder)
            count = processes or os.cpu_count() or 1
            if count == 1:
                return OwnProcess(Solver(plan.missions, self._app.sky))
            return LocalProcesses(config, count)

        return reprocess_partitions(self._app.store, folder, plan, digest, workers, step)

    def all(self) -> list[Reprocessing]:
        """Reprocessings into the service's archive, the latest first; empty without an archive."""
        folder = self._app.settings.archive_folder
        return [] if folder is None else reprocessings(folder)

    def close(self) -> None:
        """Do nothing on closing: a reprocessing ends with its call."""


def open_part(app: App) -> Reprocessings:
    """Create the reprocessing of runs into an archive, for an open app."""
    return Reprocessings(app)
