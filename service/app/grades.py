"""Filtered and smoothed attitudes: computed day by day, on request or on schedule, and live.

Those of live data are kept up beside the posts while these are recorded.
"""

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Unpack

from msgspec import structs
from sqlalchemy import Connection, func, select

from service.acquire.kernel_build import KernelBuild
from service.app.context import Context, PageOfPeriod, checked_run_name
from service.contract.base import Page
from service.contract.products import DefinitiveJob, Innovation, LiveAttitude
from service.errors import AcquisitionError, Busy, NotFound, Stopping
from service.grades.carried import CarriedFilter, live_window
from service.grades.day import LOOK_AHEAD_S, day_bounds, grade_day, window_of
from service.missions.mission import Mission, mission_named
from service.storage.archive.reading import holds_any
from service.storage.grades import days as recorded_days
from service.storage.grades import period
from service.storage.grades.days import live_attitude
from service.storage.grades.inputs import RatesRead, days_with_batches, inputs_digest, recorded_in
from service.storage.queries.pages import ResultFilter, newest
from service.storage.recording.events import last_event
from service.storage.recording.ids import Ulids
from service.storage.recording.unsaved_result import LIVE
from service.storage.sql.grade_tables import gyro_blocks
from service.storage.sql.tables import audit, batches, results
from service.times import DAY_S, Utc, bucket_start, recorded_utc, shifted, utc_now

log = logging.getLogger(__name__)

MOST_WAITING = 8
MOST_KEPT = 50
"""Jobs that are remembered, the newest; what they made is recorded."""
SCHEDULE = "schedule"
"""The author of the jobs that no person asked for."""
SETTLED_S = LOOK_AHEAD_S + 600.0
"""The delay after the end of a day, when the data that the day depends on are present."""
LATE_DAYS = 3
"""Days before the last one that are looked at again, for batches that came late."""
LOOK_EVERY_S = 600.0


@dataclass(frozen=True)
class _Wanted:
    """The product of a job."""

    spacecraft: str
    run: str
    start: Utc | None
    end: Utc | None


@dataclass
class SmoothProgress:
    """How far a period is smoothed.

    `total` counts its days with batches; `days` are the present revisions of those that have
    attitudes, `new` the ids of the revisions that were recorded now.  `empty` counts days
    without an attitude to start from, and `archived` those left as they are.
    """

    total: int
    days: list[recorded_days.GradedDayRow] = field(default_factory=list)
    new: set[str] = field(default_factory=set)
    empty: int = 0
    archived: int = 0

    @property
    def done(self) -> int:
        """Days that are finished."""
        return len(self.days) + self.empty + self.archived


class Grades:
    """Computes and reads filtered and smoothed attitudes."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._ids = Ulids()

    def smooth(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        step: Callable[[SmoothProgress], object] = lambda progress: None,
    ) -> SmoothProgress:
        """Filter and smooth every UTC day of a period that has batches.

        A day is recorded as a new revision where anything has changed that it is computed from;
        else the revision stays that there is, as it does where batches that the day is computed
        from are archived: those that are left would make a poorer one.

        Raises `NotFound` where the period has no batch.
        """
        mission = mission_named(self._context.missions, name)
        run = LIVE if run is None else checked_run_name(run)
        with self._context.reading() as connection:
            days = days_with_batches(connection, name, run, start, end)
        if not days:
            raise NotFound(f"{name} has no batch in run {run} in the period")
        progress = SmoothProgress(len(days))
        step(progress)
        for day in days:
            self._smooth_day(mission, recorded_days.DayKey(name, run, day), progress)
            step(progress)
        return progress

    def innovations(self, name: str, **asked: Unpack[PageOfPeriod]) -> Page[Innovation]:
        """How the measured attitudes of a period met the filter, the earliest first."""
        return self._context.page(period.list_innovations, ResultFilter, name, asked)

    def of_period(self, name: str, run: str, start: Utc, end: Utc) -> period.GradesOfPeriod | None:
        """A bounded number of samples and innovations of a period; None where none are recorded."""
        self._context.mission(name)
        with self._context.reading() as connection:
            return period.grades_of_period(connection, name, run, start, end)

    def _smooth_day(
        self, mission: Mission, key: recorded_days.DayKey, progress: SmoothProgress
    ) -> None:
        window = window_of(key.day)
        with self._context.reading() as connection:
            if holds_any(connection, key.spacecraft, key.run, *window):
                progress.archived += 1
                return
            recorded = recorded_in(connection, self._context.sky, key.spacecraft, key.run, *window)
            before = recorded_days.current_day(connection, key)
        inputs = inputs_digest(recorded, mission)
        if before is not None and before.inputs == inputs:
            progress.days.append(before)
            return
        graded = grade_day(recorded, mission, key.day)
        if before is None and not graded.samples:
            progress.empty += 1
            return
        rows = recorded_days.rows_of(key, graded, inputs, self._ids.new(), utc_now())

        def change(connection: Connection) -> recorded_days.GradedDayRow:
            recorded_day = recorded_days.record_day(connection, key, rows)
            # Another process may have recorded the same meanwhile.
            if recorded_day.id == rows[0]["id"]:
                off = self._context.settings.features_off
                period.evaluate_day(connection, mission, key, recorded_day, off)
            return recorded_day

        row = self._context.change(change)
        progress.days.append(row)
        if row.id == rows[0]["id"]:
            progress.new.add(row.id)


class DefinitiveAttitudes:
    """Jobs that filter and smooth recorded days, one after the other, beside other work.

    A job is forgotten at the end of the process; the days that it has made stay.
    """

    def __init__(
        self, context: Context, grades: Grades, kernels: KernelBuild | None = None
    ) -> None:
        self._context, self._grades, self._kernels = context, grades, kernels
        self._ids = Ulids()
        self._lock = threading.Lock()
        self._jobs: dict[str, DefinitiveJob] = {}
        self._worker = ThreadPoolExecutor(1, "definitive-attitude")
        self._stopped = threading.Event()
        self._schedule: threading.Thread | None = None
        self._made: dict[str, int] = {}
        """By spacecraft, the day up to which its schedule has been followed."""

    def begin(
        self,
        spacecraft: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        who: str,
    ) -> DefinitiveJob:
        """Queue a job for the UTC days of a period that have batches; without one, all days.

        Raises `Busy` where too many wait or kernels are still compiled, `Stopping` while the
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
        """The jobs of a spacecraft, the newest first."""
        self._context.mission(spacecraft)
        with self._lock:
            found = [each for each in self._jobs.values() if each.spacecraft == spacecraft]
        return found[::-1]

    def get(self, spacecraft: str, id: str) -> DefinitiveJob:
        """One job; raises `NotFound`."""
        for job in self.all(spacecraft):
            if job.id == id:
                return job
        raise NotFound(f"{spacecraft} has no job {id[:40]!r} since the start of the service")

    def start_schedule(self) -> None:
        """Start to make the definitive attitude of each day where the mission asks for it."""
        if self._schedule is None and any(map(self._is_daily, self._context.missions)):
            self._schedule = threading.Thread(
                target=self._keep_schedule, name="definitive-schedule", daemon=True
            )
            self._schedule.start()

    def close(self) -> None:
        """End the job that is computed, and those that wait."""
        with self._lock:
            self._stopped.set()
        if self._schedule is not None:
            self._schedule.join()
        self._worker.shutdown(cancel_futures=True)

    def begin_due(self, now: Utc) -> list[DefinitiveJob]:
        """Queue a job for each mission whose last day is complete and not made yet."""
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
        while not self._stopped.wait(5.0 if not self._made else LOOK_EVERY_S):
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
            self._grades.smooth(
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


REST = 20.0
"""The thread's rest as a multiple of its last look: it works 5 % of the time at most."""

_TIMES = select(batches.c.time).join_from(results, batches, results.c.batch_id == batches.c.id)
_LAST_FORGOTTEN = select(func.max(audit.c.id)).where(audit.c.action == "forget_run")


@dataclass
class _Kept:
    """The filter of a spacecraft, and what it was up to."""

    filter: CarriedFilter = field(default_factory=CarriedFilter)
    rates_read: RatesRead = field(default_factory=dict)
    version: tuple[int, str | None] | None = None
    forgotten: str | None = None
    """The last entry of the audit list about recorded batches or blocks that were removed."""
    attitude: LiveAttitude | None = None


class LiveFilter:
    """The filters of the missions that ask for them; started by the server alone.

    What a filter gives depends on the record alone, so that a service that was killed and
    started again gives the same.
    """

    def __init__(self, context: Context, kernels: KernelBuild | None = None) -> None:
        self._context = context
        self._kernels = kernels
        self._kept: dict[str, _Kept] = {}
        self._lock = threading.Lock()
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Keep the filters up from now on, if any mission asks for it."""
        if self._names() and self._thread is None:
            self._thread = threading.Thread(target=self._keep_up, name="live-filter", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()

    def latest(self, name: str) -> LiveAttitude:
        """The filtered attitude of a spacecraft at the last epoch.

        Raises `NotFound` for a mission without a live filter, and where no filter could start,
        the thread has not looked at the record yet, or the attitude is lost.
        """
        mission = mission_named(self._context.missions, name)
        if mission.live_filter is None:
            raise NotFound(f"the mission {name} has no live filter")
        if self._thread is None and name not in self._kept:
            self.refresh(name)
        # Not of a look in this thread: many requests would wait for the first one, which may
        # take long, and repeat one that fails.
        kept = self._kept.get(name)
        attitude = None if kept is None else kept.attitude
        if attitude is None:
            raise NotFound(f"{name} has no filtered attitude")
        return attitude

    def _names(self) -> list[str]:
        missions = self._context.missions
        return sorted(name for name, each in missions.items() if each.live_filter is not None)

    def _keep_up(self) -> None:
        due = dict.fromkeys(self._names(), 0.0)
        while not self._stopped.wait(max(0.05, min(due.values()) - time.monotonic())):
            if self._kernels is not None and self._kernels.is_needed:
                # Compiled here they would hold up the requests; other processes do that.
                continue
            name = min(due, key=lambda each: due[each])
            begun = time.monotonic()
            try:
                self.refresh(name)
            except AcquisitionError as error:
                log.warning("the live filter of %s waits: %s", name, error)
            except Exception:
                # The next look may find the database back; posts do not wait for this thread.
                log.exception("the live filter of %s failed", name)
            settings = self._context.missions[name].live_filter
            every_s = 10.0 if settings is None else settings.every_s
            now = time.monotonic()
            due[name] = now + max(every_s, REST * (now - begun))

    def refresh(self, name: str) -> None:
        """Filter what is new of a spacecraft."""
        mission = self._context.missions[name]
        with self._lock:
            kept = self._kept.setdefault(name, _Kept())
            with self._context.reading() as connection:
                block = connection.scalar(select(func.max(gyro_blocks.c.id)))
                version = last_event(connection), block
                forgotten = connection.scalar(_LAST_FORGOTTEN)
                if kept.forgotten != forgotten:
                    # The filter holds what was computed from facts that are gone.
                    kept.filter, kept.rates_read, kept.version = CarriedFilter(), {}, None
                    kept.forgotten = forgotten
                if kept.version == version:
                    return
                row = newest(connection, _TIMES, ResultFilter(LIVE, name), utc_now())
                latest = None if row is None else recorded_utc(row["time"])
                if latest is not None:
                    window = live_window(latest)
                    recorded = recorded_in(
                        connection, self._context.sky, name, LIVE, *window, kept.rates_read
                    )
            attitude = None
            if latest is not None:
                carried = kept.filter.carry_on(recorded, mission)
                attitude = live_attitude(name, day_bounds(latest.bucket(DAY_S))[0], carried)
            # Readers do not wait: until now they had the one before.
            kept.attitude, kept.version = attitude, version
