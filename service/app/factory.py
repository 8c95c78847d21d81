"""Construction of the app from all parts of the service."""

import logging
from typing import Protocol, TypeVar

from service.access import Access, Tokens
from service.acquire.kernel_build import KernelBuild
from service.app.adoptions import CalibrationAdoptions
from service.app.annotations import Annotations
from service.app.context import Context
from service.app.fleet import Spacecraft
from service.app.gyro import Gyro
from service.app.replays import Replays
from service.app.results import Comparisons, Results
from service.app.runs import Runs
from service.app.service import Events, Service
from service.app.single_projector import SingleProjector
from service.app.zones import Zones
from service.feature import SETTING, feature_modules
from service.ingest.missions_in_force import MissionsInForce
from service.ingest.spool import Spool
from service.ingest.submit import SubmissionService
from service.missions.mission import Mission, load_missions
from service.settings import Settings, is_loopback
from service.sky.cache import LruCache
from service.sky.catalog.star_catalog import open_catalog
from service.sky.model import SkyModel
from service.storage.projections.heads import HeadMaker, Sign
from service.storage.projections.projector import Projector
from service.storage.queries.histories import retired
from service.storage.queries.replay_rows import mark_interrupted
from service.storage.recording.results import register
from service.storage.recording.signing import Signer
from service.storage.store import Store
from service.storage.upkeep.expiries import ExpiryDates
from service.storage.upkeep.split_trackers import BackgroundUpgrade, TrackerSplitter
from service.times import utc_now

log = logging.getLogger(__name__)

T = TypeVar("T")


class Part(Protocol):
    """Interface of the part that a feature adds to an open app."""

    def close(self) -> None:
        """Stop the work that the feature has started."""


class App:
    """The app: all functions of the service over one sky, one set of missions and one database.

    Its attributes are the parts by subject.  Without a named run they read the live one, so replays
    never show in live lists and rates.
    """

    def __init__(
        self,
        context: Context,
        kernels: KernelBuild | None = None,
        head_maker: HeadMaker | None = None,
    ) -> None:
        self.context = context
        self.settings = context.settings
        self.missions = context.missions
        self.sky = context.sky
        self.store = context.store
        self.kernels = kernels
        self.single_projector = SingleProjector(context.store)
        self.projector = Projector(context.store, head_maker)
        self.access = Access(
            context.store.reading_record,
            context.change,
            is_loopback(context.settings.host),
            utc_now,
        )
        self.tokens = Tokens(context, context.missions)
        self.in_force = MissionsInForce(context.missions, context.store)
        self.adoptions = CalibrationAdoptions(context, self.in_force)
        self.submissions = SubmissionService(self.in_force, context.sky, context.store, kernels)
        self.results = Results(context, self.submissions)
        self.spacecraft = Spacecraft(context)
        self.gyro = Gyro(context)
        self.annotations = Annotations(context)
        self.runs = Runs(context)
        self.replays = Replays(context, self.in_force, self.submissions, self.gyro.record_many)
        self.zones = Zones(context)
        self.comparisons = Comparisons(context, self.submissions)
        self.events = Events(context)
        self.expiries = ExpiryDates(context.reading_record)
        self.upgrade = BackgroundUpgrade(
            TrackerSplitter(context.store, context.sky, context.missions)
        )
        self.service = Service(
            context,
            self.submissions,
            self.replays,
            kernels,
            self.upgrade,
            self.expiries,
            self.single_projector,
        )

        self._parts: dict[type, Part] = {}
        for module in feature_modules("part", context.settings.features_off):
            part: Part = module.open_part(self)
            self._parts[type(part)] = part

    def part(self, kind: type[T]) -> T:
        """Part of the open app that a feature added, found by its class."""
        part = self._parts[kind]
        assert isinstance(part, kind)
        return part

    def close(self) -> None:
        """Stop the replays, write and project the queued work, and close the database."""
        self.single_projector.stop()
        for part in self._parts.values():
            part.close()
        self.replays.stop()
        self.upgrade.stop()
        self.submissions.close()
        self.projector.close()
        self.store.close()
        self.service.close()


def _signer_of(settings: Settings) -> Sign | None:
    """Function that signs heads of the record; None without a key."""
    if settings.record_key is None:
        return None
    return Signer(settings.record_key).sign


def open_app(
    settings: Settings,
    mission: Mission | None = None,
    *,
    create: bool = True,
    serving: bool = False,
    reads_only: bool = False,
) -> App:
    """Open the app: read missions and catalog, open the database, start writing.

    With `serving`, other services may share the database: one of them projects.  With `reads_only`,
    another process may write to a SQLite file: this start records nothing.

    A given `mission` replaces the one of the same name.  `create` and `serving` are about the
    database; see `Store`.  Raises `BadConfiguration` for an unusable mission, catalog or database.
    """
    missions = load_missions(*settings.mission_places, shipped=settings.ships_missions)
    if mission is not None:
        missions[mission.name] = mission
    # Check the key before the database is opened, so that an invalid one is reported first.
    head_maker = None if reads_only else HeadMaker(_signer_of(settings))
    catalog, cache = open_catalog(settings.catalog), LruCache(settings.shelf_mb << 20)
    kernels = KernelBuild() if serving else None
    sky = SkyModel(catalog, cache)
    if kernels is not None:
        sky = SkyModel(catalog, cache, require_whole_sky=kernels.require_whole_sky)
    store = Store(
        settings.database,
        create=create,
        serving=serving,
        archive_folder=settings.archive_folder,
        features_off=settings.features_off,
    )
    with store.reading() as connection:
        context = Context(settings, missions, sky, store, retired(connection, missions))
    app = App(context, kernels, head_maker)
    # A given mission also replaces an adopted calibration.
    leave = mission.name if mission is not None else None

    try:
        app.in_force.load(leave)
        adopted = app.in_force.adopted_names()
        if adopted and not context.has_feature("calibration"):
            log.warning(
                "%s leaves calibration out, and adopted calibrations stay in force for %s: "
                "they can be taken back while the feature is on",
                SETTING,
                ", ".join(adopted),
            )
        if not reads_only:
            _register(app.context)
            if store.lock is None:
                _end_left_work(app)
        app.single_projector.start(app.in_force.follow)
        app.projector.start()
    except BaseException:
        app.close()
        raise
    return app


def _register(context: Context) -> None:
    """Record the settings of all missions and the catalog in use."""
    moment = utc_now().text
    mission_rows = [
        {
            "digest": mission.digest,
            "spacecraft": mission.name,
            "settings": mission.model_dump_json(),
            "first_used": moment,
        }
        for mission in context.missions.values()
    ]
    catalog = context.sky.catalog
    catalog_row = {"digest": catalog.digest, "name": catalog.name, "first_used": moment}
    context.change(lambda connection: register(connection, mission_rows, catalog_row))


def _end_left_work(app: App) -> None:
    """Mark replays of an ended process as waiting if their files are stored, else interrupted."""
    moment = utc_now().text
    stored = Spool(app.settings.spool_folder).ids()
    app.context.change(lambda connection: mark_interrupted(connection, moment, stored))
