"""Reprocessing tasks on a Dask scheduler, whose workers need this package and the archive.

A scheduler runs any code that it receives: its address comes from the command line, never from a
request, and should use TLS.
"""

import logging
import pickle
import threading
from asyncio import CancelledError
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pyarrow as pa

from service import __version__
from service.acquire.prewarm import prewarm_kernels
from service.errors import BadConfiguration, BadInput, Fault
from service.extras import require_extra
from service.features.archive import partition_tasks
from service.features.archive.folder import write_whole
from service.ingest.solver_pool import Solver
from service.ingest.worker_process import WorkerConfig

RETRIES = 3
"""Number of retries of a task that raises; the scheduler itself moves tasks of dead workers."""
CONNECT_S = 20
FEWEST_PENDING, PENDING_A_WORKER = 4, 2
SCHEMES = ("tls://", "tcp://")

log = logging.getLogger(__name__)


def require_scheduler(address: str) -> None:
    """Raise `BadInput` for an invalid scheduler address, `NotAvailable` without the package."""
    if not address.startswith(SCHEMES) or not address.rpartition(":")[2].isdigit():
        raise BadInput(Fault("--scheduler", "must be tls://HOST:PORT or tcp://HOST:PORT", address))
    require_extra("dask", "distributed", "--scheduler", address)
    from distributed.security import Security

    # A client without certificates fails slowly, and again when it is closed.
    settings: Any = Security
    if address.startswith("tls://") and not settings().get_connection_args("client")["ssl_context"]:
        message = (
            "needs certificates: set DASK_DISTRIBUTED__COMM__TLS__CA_FILE, and CERT and KEY of "
            "DASK_DISTRIBUTED__COMM__TLS__CLIENT"
        )
        raise BadInput(Fault("--scheduler", message, address))


class DaskWorkers:
    """Workers of a Dask scheduler, whose number may change."""

    def __init__(self, address: str, config: WorkerConfig, folder: Path) -> None:
        """Connect to a Dask scheduler; raises `BadConfiguration` if it does not answer."""
        from distributed import Client

        # Errors are reported below, in a line and without the trace.
        for name in (
            "asyncio",
            "distributed",
            "distributed.client",
            "distributed.utils",
            "tornado",
        ):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        # The client's methods have no types.
        connect: Any = Client
        self._address = address
        self._config = pickle.dumps(replace(config, catalog=_kept_catalog(config, folder)))
        try:
            self._client = connect(address, timeout=CONNECT_S, set_as_default=False)
        except (OSError, TypeError, ValueError) as error:
            # A TypeError means that certificates are missing.
            raise BadConfiguration(f"--scheduler: {address}: {error}") from None
        self._unfinished: set[Any] = set()

    @property
    def workers(self) -> int:
        """Number of workers of the scheduler at present."""
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    @property
    def most_pending(self) -> int:
        """Number of tasks to submit before the first result is collected."""
        return max(FEWEST_PENDING, PENDING_A_WORKER * self.workers)

    def submit(self, task: partition_tasks.PartitionTask) -> partition_tasks.Wait:
        """Queue a task on the scheduler; returns the function that waits for its result."""
        # The task writes a file: a cached result of the scheduler would not write it.
        future = self._client.submit(
            do_task, self._config, versions(), task, pure=False, retries=RETRIES
        )
        self._unfinished.add(future)
        return self._wait(future, task)

    def _wait(
        self, future: Any, task: partition_tasks.PartitionTask
    ) -> Callable[[float], partition_tasks.PartitionResult | None]:
        def wait(seconds: float) -> partition_tasks.PartitionResult | None:
            try:
                outcome = future.result(timeout=seconds)
            except TimeoutError:
                # A result lost with its worker is computed again.
                if self._client.status == "closed":
                    raise self._gone(task) from None
                return None
            except BadConfiguration:
                raise
            except (Exception, CancelledError) as error:
                # The scheduler's own error: workers died over the task, or the scheduler is gone.
                raise self._gone(task, error) from None
            self._unfinished.discard(future)
            return partition_tasks.result_of(outcome)

        return wait

    def _gone(
        self, task: partition_tasks.PartitionTask, error: BaseException | None = None
    ) -> BadConfiguration:
        why = "the scheduler is gone" if error is None else f"{type(error).__name__}: {error}"
        return BadConfiguration(
            f"--scheduler: {self._address}: {task.target.name}: {why}; to go on, run the command "
            "again"
        )

    def close(self) -> None:
        """Cancel the unfinished tasks and disconnect."""
        try:
            self._client.cancel(list(self._unfinished), force=True)
        except Exception as error:
            # Close whatever the client raises: with a lost scheduler there is nothing to cancel.
            log.debug("nothing was cancelled: %s", error)
        self._client.close()


def _kept_catalog(config: WorkerConfig, folder: Path) -> Path | None:
    """Copy a site's own catalog to the archive for the workers; None for the shipped catalog."""
    if config.catalog is None:
        return None
    place = folder / "catalogs" / config.catalog_digest.replace(":", "-") / config.catalog.name
    if not place.exists():
        write_whole(place, config.catalog.read_bytes())
    return place


# ---- in a worker -------------------------------------------------------------------------------

_lock = threading.Lock()
_solvers: dict[bytes, Solver] = {}


def versions() -> dict[str, str]:
    """Package versions that affect the bytes of an archive part."""
    return {
        "attitude-acquisition": __version__,
        "numba": numba.__version__,
        "numpy": np.__version__,
        "pyarrow": pa.__version__,
    }


def do_task(
    config: bytes, expected: dict[str, str], task: partition_tasks.PartitionTask
) -> partition_tasks.Outcome:
    """Run a task in a worker, which must have the command's package versions and catalog."""
    for package, version in versions().items():
        if expected[package] != version:
            raise BadConfiguration(
                f"a worker has {package} {version}, and the command {expected[package]}: install "
                "the same version"
            )
    if not task.folder.is_dir():
        raise BadConfiguration(f"{task.folder}: a worker has no such folder: mount it there")
    return partition_tasks.attempt(_solver_of(config), task)[0]


def _solver_of(config: bytes) -> Solver:
    """Solver with these settings and compiled kernels; a worker caches the latest."""
    with _lock:
        if config not in _solvers:
            solver = pickle.loads(config).solver()
            prewarm_kernels(solver.sky, solver.missions)
            _solvers.clear()
            _solvers[config] = solver
        return _solvers[config]
