"""Background thread that keeps the filtered attitude of live data up to date."""

import logging
import threading
import time
from dataclasses import dataclass, field

from sqlalchemy import func, select

from service.acquire.kernel_build import KernelBuild
from service.app.context import Context
from service.attitude.definitive import day_bounds
from service.errors import AcquisitionError, NotFound
from service.features.definitive.carried import CarriedFilter, live_window
from service.features.definitive.inputs import RatesRead, recorded_in
from service.features.definitive.records import LiveAttitude, live_attitude
from service.missions.mission import mission_named
from service.observations.schema import LIVE
from service.storage.queries.pages import ResultFilter, newest
from service.storage.recording.events import last_event
from service.storage.sql.tables import audit, batches, gyro_blocks, results
from service.times import DAY_S, recorded_utc, utc_now

log = logging.getLogger(__name__)

REST = 20.0
"""Pause of the thread after each pass, in multiples of its duration: at most 5 % load."""

_TIMES = select(batches.c.time).join_from(results, batches, results.c.batch_id == batches.c.id)
_LAST_FORGOTTEN = select(func.max(audit.c.id)).where(audit.c.action == "forget_run")


@dataclass
class _Kept:
    """Live filter of a spacecraft, with the state of the record that it has processed."""

    filter: CarriedFilter = field(default_factory=CarriedFilter)
    rates_read: RatesRead = field(default_factory=dict)
    version: tuple[int, str | None] | None = None
    forgotten: str | None = None
    """Id of the last audit entry about the removal of recorded batches or gyro blocks."""
    attitude: LiveAttitude | None = None


class LiveFilter:
    """Live filters of all missions that configure one; only the server starts them.

    The result of a filter depends on the record alone, so that a service that was killed and
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
        """Start the thread that updates the filters, if any mission has a live filter."""
        if self._names() and self._thread is None:
            self._thread = threading.Thread(target=self._keep_up, name="live-filter", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Stop the thread that updates the filters."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()

    def latest(self, name: str) -> LiveAttitude:
        """Filtered attitude of a spacecraft at its last epoch.

        Raises `NotFound` for a mission without a live filter, and if no filter could start, the
        thread has not read the record yet, or the attitude is lost.
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
        """Filter the new data of a spacecraft."""
        mission = self._context.missions[name]
        with self._lock:
            kept = self._kept.setdefault(name, _Kept())
            with self._context.reading() as connection:
                block = connection.scalar(select(func.max(gyro_blocks.c.id)))
                version = last_event(connection), block
                forgotten = connection.scalar(_LAST_FORGOTTEN)
                if kept.forgotten != forgotten:
                    # The filter holds results from batches or blocks that were removed.
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
