"""Background jobs that filter and smooth recorded days, on request or on schedule."""

import logging
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

from msgspec import structs

from service.acquire.kernel_build import KernelBuild
from service.app.context import Context, checked_run_name
from service.errors import AcquisitionError, Busy, NotFound, Stopping
from service.features.definitive.day import LOOK_AHEAD_S
from service.features.definitive.days import DefinitiveDays, SmoothProgress
from service.features.definitive.records import DefinitiveJob
from service.missions.mission import mission_named
from service.observations.schema import LIVE
from service.storage.recording.ids import Ulids
from service.times import DAY_S, Utc, bucket_start, shifted, utc_now

log = logging.getLogger(__name__)

MOST_WAITING = 8
MOST_KEPT = 50
"""Number of jobs kept in memory, the newest; their results are recorded."""
SCHEDULE = "schedule"
"""Author of jobs that the schedule started."""
SETTLED_S = LOOK_AHEAD_S + 600.0
"""Seconds after the end of a day until all data that its attitudes depend on are present."""
LATE_DAYS = 3
"""Number of earlier days that a scheduled job computes again, for late batches."""


@dataclass(frozen=True)
class _Wanted:
    """Spacecraft, run and period whose days a job computes."""

    spacecraft: str
    run: str
    start: Utc | None
    end: Utc | None


class DefinitiveJobs:
    """Background jobs that filter and smooth recorded days, one at a time.

    Jobs are forgotten when the process ends; the recorded days stay.
    """

    def __init__(
        self, context: Context, days: DefinitiveDays, kernels: KernelBuild | None = None
    ) -> None:
        self._context, self._days, self._kernels = context, days, kernels
        self._ids = Ulids()
        self._lock = threading.Lock()
        self._jobs: dict[str, DefinitiveJob] = {}
        self._worker = ThreadPoolExecutor(1, "definitive-attitude")
        self._stopped = threading.Event()
        self._schedule: threading.Thread | None = None
        self._made: dict[str, int] = {}
        """Day up to which the schedule of each spacecraft has been followed."""

    def begin(
        self,
        spacecraft: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        who: str,
    ) -> DefinitiveJob:
        """Queue a job for the UTC days of a period that have batches; all days without a period.

        Raises `Busy` if too many jobs wait or kernels are still compiled, `Stopping` while the
        service closes.
        """
        mission_named(self._context.missions, spacecraft)
        run = LIVE if run is None else checked_run_name(run)
        self._context.store.writer.require()
        if self._kernels is not None and self._kernels.is_needed:
            raise Busy("the kernels of the filter are still being compiled", 10)
        job = DefinitiveJob(
            id=self._ids.new(),
            spacecraft=spacecraft,
            run=run,
            start=None if start is None else start.text,
            end=None if end is None else end.text,
            who=who,
            created=utc_now().text,
            ended=None,
            state="queued",
            done=0,
            total=0,
            recorded=0,
            fault=None,
        )
        with self._lock:
            if self._stopped.is_set():
                raise Stopping("the service is stopping")
            if sum(each.ended is None for each in self._jobs.values()) >= MOST_WAITING:
                raise Busy(f"{MOST_WAITING} jobs wait already", 10)
            self._jobs[job.id] = job
            for id in list(self._jobs)[:-MOST_KEPT]:
                del self._jobs[id]
            self._worker.submit(self._make, job.id, _Wanted(spacecraft, run, start, end))
        return job

    def all(self, spacecraft: str) -> list[DefinitiveJob]:
        """Jobs of a spacecraft, newest first."""
        self._context.mission(spacecraft)
        with self._lock:
            found = [each for each in self._jobs.values() if each.spacecraft == spacecraft]
        return found[::-1]

    def get(self, spacecraft: str, id: str) -> DefinitiveJob:
        """The job with an id; raises `NotFound`."""
        for job in self.all(spacecraft):
            if job.id == id:
                return job
        raise NotFound(f"{spacecraft} has no job {id[:40]!r} since the start of the service")

    def start_schedule(self) -> None:
        """Start the thread that queues a job every day for missions with daily smoothing."""
        if self._schedule is None and any(map(self._is_daily, self._context.missions)):
            self._schedule = threading.Thread(
                target=self._keep_schedule, name="definitive-schedule", daemon=True
            )
            self._schedule.start()

    def close(self) -> None:
        """Stop the job that is being computed, and drop the queued ones."""
        with self._lock:
            self._stopped.set()
        if self._schedule is not None:
            self._schedule.join()
        self._worker.shutdown(cancel_futures=True)

    def begin_due(self, now: Utc) -> list[DefinitiveJob]:
        """Queue a job for every daily mission whose last day is complete and not computed yet."""
        today = shifted(now, -SETTLED_S).bucket(DAY_S)
        begun = []
        for name in sorted(filter(self._is_daily, self._context.missions)):
            if self._made.get(name, 0) < today:
                days = bucket_start(today - 1 - LATE_DAYS, DAY_S), bucket_start(today, DAY_S)
                begun.append(self.begin(name, start=days[0], end=days[1], who=SCHEDULE))
                self._made[name] = today
        return begun

    def _is_daily(self, name: str) -> bool:
        settings = self._context.missions[name].smoothing
        return settings is not None and settings.daily

    def _keep_schedule(self) -> None:
        while not self._stopped.wait(5.0 if not self._made else 600.0):
            if not self._context.store.is_projecting:
                continue
            try:
                self.begin_due(utc_now())
            except (Busy, Stopping) as error:
                log.info("the daily definitive attitude waits: %s", error)
            except Exception:
                # The next look may find the database back.
                log.exception("the daily definitive attitude could not be begun")

    def _make(self, id: str, wanted: _Wanted) -> None:
        def step(progress: SmoothProgress) -> None:
            if self._stopped.is_set():
                raise Stopping("the service is stopping")
            self._change(
                id,
                state="running",
                done=progress.done,
                total=progress.total,
                recorded=len(progress.new),
            )

        try:
            self._days.smooth(
                wanted.spacecraft, run=wanted.run, start=wanted.start, end=wanted.end, step=step
            )
            ended = {"state": "done", "fault": None}
        except Stopping:
            ended = {"state": "interrupted", "fault": None}
        except NotFound as error:
            ended = {"state": "done", "fault": str(error)}
        except AcquisitionError as error:
            ended = {"state": "failed", "fault": str(error)}
        except Exception:
            # Whatever fails, the job must end: a client waits for its state.
            log.exception("the definitive attitude of %s failed", wanted.spacecraft)
            ended = {"state": "failed", "fault": "the fault is on the service's side; it is logged"}
        self._change(id, ended=utc_now().text, **ended)

    def _change(self, id: str, **changes: object) -> None:
        with self._lock:
            if id in self._jobs:
                self._jobs[id] = structs.replace(self._jobs[id], **changes)
