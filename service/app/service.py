"""The service as a whole: readiness, its description, and its events."""

import gc
import logging
import threading
from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import partial

from msgspec import structs

from service import __version__
from service.acquire.kernel_build import KernelBuild, progress_logged
from service.acquire.prewarm import build_sky_files, prewarm_kernels, prewarm_sky
from service.app.context import Context
from service.app.replays import Replays
from service.app.single_projector import SingleProjector
from service.contract.events import RecordHead
from service.contract.spacecraft import About, CatalogAbout, MissionAbout
from service.errors import AcquisitionError, Busy
from service.ingest.submit import SubmissionService
from service.missions.identifiers import IDENTIFIERS
from service.missions.mission import Mission
from service.observations.schema import Submission, submission_from_json
from service.sky.cache import LruCache
from service.storage.projections.heads import require_head
from service.storage.queries.fleet import latest_inputs
from service.storage.recording import events
from service.storage.recording.events import Event
from service.storage.recording.ids import Ulids
from service.storage.upkeep.expiries import ExpiryDates
from service.storage.upkeep.split_trackers import BackgroundUpgrade
from service.times import Utc, parse_utc, utc_now

log = logging.getLogger(__name__)

WARM_UP_RUNS = 8
"""Number of extra runs of recorded batches before the service takes its first batch.

The interpreter then has specialised its code.
"""
CREDITS = (
    "Hipparcos and Tycho-2 catalogs: ESA 1997, ESA/ESTEC; Hog et al. 2000",
    "Method: D. Fink and D. Shoup, Goddard Space Flight Center, 1994",
    "Earth orientation, aberration and time: ERFA, derived from the IAU SOFA software",
)


class Service:
    """Preparation of the service for its first batch, and its description."""

    def __init__(
        self,
        context: Context,
        submissions: SubmissionService,
        replays: Replays,
        kernels: KernelBuild | None,
        upgrade: BackgroundUpgrade,
        expiries: ExpiryDates,
        single_projector: SingleProjector,
    ) -> None:
        self._context = context
        self._submissions = submissions
        self._replays = replays
        self._kernels = kernels
        self._upgrade = upgrade
        self._expiries = expiries
        self._single_projector = single_projector
        self._warming = threading.Lock()
        self._is_warm = False
        self._ids = Ulids()
        self.started = utc_now()

    def ready(self) -> None:
        """Prepare the service and return when batches run at full speed.

        The first call compiles kernels and builds the sky.  While it does, other calls return as
        soon as batches with a zone can be processed.  Raises `Busy` before that, if the database
        cannot be read, and if the last write failed and another write, tried now, fails too.
        """
        if not self._is_warm:
            if not self._warming.acquire(blocking=False):
                raise Busy("the service is warming up")
            try:
                self._prepare()
            except BaseException:
                # The kernels of zones may exist without the others: the next call tries again.
                self._is_warm = False
                raise
            finally:
                gc.enable()
                self._warming.release()
        self._submissions.require_alive()
        self._context.store.writer.require_written()
        with self._context.reading_record() as connection:
            connection.exec_driver_sql("SELECT 1")

    def _prepare(self) -> None:
        if self._kernels is not None and self._kernels.is_needed:
            with progress_logged(log):
                self._kernels.run(
                    self._context.missions,
                    self._begin_with_zones,
                    self._go_on_with_whole_sky,
                    partial(build_sky_files, self._context.settings.catalog, self._epochs()),
                )
        prewarm_kernels(self._context.sky, self._context.missions)
        self._prewarm_sky()
        self._become_warm()
        if self._kernels is not None:
            # Only a service does this by itself, not a command.
            self._replays.resume()
            self._single_projector.resume_with(self._replays.resume)
            self._single_projector.when_projecting(self._upgrade.start)
            self._expiries.warn()

    def _begin_with_zones(self) -> None:
        """Load the kernels of batches with a zone, and accept such batches."""
        in_zones = [name for name, entry in IDENTIFIERS.items() if entry.searches_zone]
        prewarm_kernels(self._context.sky, self._context.missions, in_zones)
        self._prewarm_sky()
        self._become_warm()
        log.info("ready for batches with an a priori attitude; still compiling other kernels")

    def _go_on_with_whole_sky(self) -> None:
        """Load the kernels of whole-sky searches, and open their catalogs."""
        prewarm_kernels(self._context.sky, self._context.missions)
        self._prewarm_sky(whole_sky=True)
        log.info("ready for batches that need the whole sky; still compiling other kernels")

    def _prewarm_sky(self, *, whole_sky: bool = False) -> None:
        """Build catalogs of all missions; also for the whole sky if its kernels exist.

        They are of the present epoch, of the latest batches, and in a server of simulated
        telemetry, so that no such batch waits while a file is built.
        """
        sky = self._context.sky
        # The files of other epochs displace no zones in memory before a batch opens them.
        files = replace(sky, cache=LruCache(1))
        whole_sky |= self._kernels is None or not self._kernels.whole_sky_needed
        for mission, (*times, now) in self._epochs():
            try:
                for time in times:
                    prewarm_sky(files, [mission], time, whole_sky)
                prewarm_sky(sky, [mission], now, whole_sky)
            except AcquisitionError as error:
                # Only batches of this mission are refused then; no other mission waits for it.
                log.warning("the sky of %s cannot be built: %s", mission.name, error)

    def _epochs(self) -> list[tuple[Mission, list[Utc]]]:
        """The missions with the times for which their catalogs are built, the present one last."""
        times: dict[str, list[Utc]] = {name: [] for name in self._context.missions}
        for sent in self._latest_batches():
            times[sent.batch.spacecraft].append(sent.batch.time)
        missions = self._context.missions.values()
        if self._kernels is not None:
            for mission in missions:
                times[mission.name].append(parse_utc(mission.simulated_start))
        now = utc_now()
        return [(mission, [*times[mission.name], now]) for mission in missions]

    def _become_warm(self) -> None:
        if not self._is_warm:
            self._prewarm_recent_pointings()
            # Collecting the present objects each time would take longer than a batch.
            gc.freeze()
            self._is_warm = True

    def being_compiled(self) -> list[str]:
        """Kinds of work that are refused while their kernels are compiled."""
        return [] if self._kernels is None else self._kernels.being_compiled

    def cancel_warmup(self) -> None:
        """Cancel the compilation of kernels, which may take minutes."""
        if self._kernels is not None:
            self._kernels.cancel()

    def close(self) -> None:
        """Return the objects that `ready` froze to the garbage collector.

        Otherwise a program that opens and closes services would never free one.
        """
        if self._is_warm:
            gc.unfreeze()

    def _prewarm_recent_pointings(self) -> None:
        """Build the zones that the next batch of each live spacecraft will most likely need.

        The latest batch of each is processed again under a new id and rolled back; with few
        spacecraft several times, because code runs slowly at first.
        """
        batches = self._latest_batches()
        for sent in batches:
            try:
                for _ in range(1 + WARM_UP_RUNS // len(batches)):
                    batch = structs.replace(sent.batch, batch=self._ids.new())
                    self._submissions.warm_up(structs.replace(sent, batch=batch))
            except Exception as error:
                # A batch that no longer runs must not prevent the start.
                log.warning("the latest batch of a spacecraft could not be run again: %s", error)

    def _latest_batches(self) -> list[Submission]:
        """Latest batch of each live spacecraft, as far as it can be read."""
        with self._context.reading_record() as connection:
            inputs = latest_inputs(connection, self._context.missions, utc_now())
        batches = []
        for text in inputs:
            try:
                batches.append(submission_from_json(text))
            except AcquisitionError as error:
                # A batch that is refused today must not prevent the start.
                log.warning("the latest batch of a spacecraft could not be read again: %s", error)
        return batches

    def about(self, spacecraft: Collection[str] | None = None) -> About:
        """Description of the service: version, catalog, missions and database."""
        catalog = self._context.sky.catalog
        return About(
            version=__version__,
            started=self.started.text,
            database=self._context.store.url.get_backend_name(),
            catalog=CatalogAbout(
                digest=catalog.digest, name=catalog.name, stars=len(catalog.magnitude_v_mag)
            ),
            missions=[
                MissionAbout(name=each.name, description=each.description, digest=each.digest)
                for each in self._context.missions.values()
                if spacecraft is None or each.name in spacecraft
            ],
            credits=list(CREDITS),
        )

    def record_head(self) -> RecordHead:
        """Last head of the record; raises `NotFound` before the first one."""
        with self._context.reading_record() as connection:
            return require_head(connection)


class Events:
    """Service that reads the recorded events and their numbers."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def last(self, spacecraft: Collection[str] | None = None) -> int:
        """Number of the latest event, or of the latest one about some spacecraft."""
        with self._context.reading() as connection:
            if spacecraft is None:
                return events.last_event(connection)
            return events.last_event_about(connection, spacecraft)

    def after(self, last: int, limit: int) -> Sequence[Event] | None:
        """Events after a number, oldest first; None where some of them are no longer kept."""
        with self._context.reading_record() as connection:
            return events.events_after(connection, last, limit)
