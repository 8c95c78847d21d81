"""The one object that every door holds: web, replay, simulator and scripts go through it."""

import threading
from collections.abc import Iterable, Sequence

from pydantic import TypeAdapter, ValidationError

from service.errors import (
    AcquisitionError,
    BadBatch,
    Busy,
    Fault,
    NotFound,
    Stopping,
    shown_value,
)
from service.missions.mission import Mission, load_missions, mission_named
from service.observe.wire import APrioriIn, OptionsIn, RunName, Submission, prior_of
from service.records import histories, reading, rollups
from service.records.draft import Answered, Row
from service.records.ids import Ulids, is_ulid
from service.records.intake import Intake, Observer, mission_in_input, now
from service.records.pages import Page, Stretch
from service.records.reading import OutcomeName, Status
from service.records.recording import register
from service.records.replays import Replay, mark_interrupted, read_replay
from service.records.store import Store
from service.settings import Settings
from service.sky.catalog import open_catalog
from service.sky.run_catalog import RunCatalog
from service.sky.shelf import Shelf
from service.sky.view import Sky
from service.sky.zones import Zone
from service.times import Utc
from service.warm import warm_up, warm_zones

__all__ = ["LIVE", "Answered", "Operations", "Page"]

LIVE = "live"
MAX_REPLAYS = 8
"""Each keeps a thread and a file of its own; those that come later may come again."""
REPLAY_RETRY_S = 30

_RUN_NAME = TypeAdapter(RunName)


class Operations:
    """Everything the service does, over one sky, one set of missions and one database.

    What is asked without naming a run is asked of the live one, so that
    replays never show in live lists and rates.
    """

    def __init__(
        self, settings: Settings, missions: dict[str, Mission], sky: Sky, store: Store
    ) -> None:
        self.settings = settings
        self.missions = missions
        self.sky = sky
        self.store = store
        self._intake = Intake(missions, sky, store)
        self._ids = Ulids()
        self._replays: list[Replay] = []
        self._replays_lock = threading.Lock()
        self._closing = False
        self._warming = threading.Lock()
        self._warm = False

    @classmethod
    def open(cls, settings: Settings) -> "Operations":
        """Read missions and catalog, open the database, start writing.

        Raises `BadConfiguration` for whatever of these cannot be used.
        """
        missions = load_missions(settings.missions)
        sky = Sky(open_catalog(settings.catalog), Shelf(settings.shelf_mb << 20))
        operations = cls(settings, missions, sky, Store(settings.database))
        try:
            operations._register()
        except BaseException:
            operations.close()
            raise
        return operations

    def _register(self) -> None:
        moment = now().text
        mission_rows = [
            {
                "digest": mission.digest,
                "spacecraft": mission.name,
                "settings": mission.model_dump_json(),
                "first_used": moment,
            }
            for mission in self.missions.values()
        ]
        catalog = self.sky.catalog
        catalog_row = {"digest": catalog.digest, "name": catalog.name, "first_used": moment}
        self.store.writer.change(
            lambda connection: register(connection, mission_rows, catalog_row)
        ).result()
        self.store.writer.change(lambda connection: mark_interrupted(connection, moment)).result()

    def close(self) -> None:
        """Stop the replays, write what is queued, and let go of the database."""
        with self._replays_lock:
            # From here on none is added.
            self._closing = True
        for replay in self._replays:
            replay.stop()
        self.store.close()

    def ready(self) -> None:
        """Return once batches can be taken at full speed; the first call compiles and warms.

        Raises `Busy` while another call is at that, and where the database can
        be neither read nor written.
        """
        if not self._warm:
            if not self._warming.acquire(blocking=False):
                raise Busy("the service is warming up")
            try:
                warm_up(self.sky, self.missions)
                self._warm = True
            finally:
                self._warming.release()
        self.store.writer.require()
        with self.store.reading() as connection:
            connection.exec_driver_sql("SELECT 1")

    # ---- batches -----------------------------------------------------------------------------

    @property
    def observers(self) -> list[Observer]:
        """Called with the acquisition of every batch that is new, after its commit."""
        return self._intake.observers

    def submit(self, submission: Submission, idempotency_key: str | None = None) -> Answered:
        """Record a batch and answer it; a repeat gets the stored answer.

        Raises `KeyReused` and `Conflict` for another body under a key or a
        batch that is taken, `BadBatch` for an unknown spacecraft and for what
        does not fit its mission, `Busy` when too much is waiting.
        """
        return self._intake.submit(submission, idempotency_key)

    def submit_many(self, submissions: Sequence[Submission]) -> list[Answered | AcquisitionError]:
        """`submit` of each in one transaction; an error stands in the place of what is refused."""
        return self._intake.submit_many(submissions)

    def what_if(
        self, id: str, options: OptionsIn, record: bool = False, adopt: bool = False
    ) -> Answered:
        """Run a recorded batch again with other options, in place of what they name.

        The answer names its parent.  It is kept only where `record` or `adopt`
        asks for that; adopted, it becomes what lists, histories and rates show.
        """
        return self._intake.what_if(_known(id, "batch"), options, record=record, adopt=adopt)

    def batch(self, id: str) -> Row:
        """One result: `answer`, `input`, `current`, `parent`, and the `what_ifs` of its batch."""
        with self.store.reading() as connection:
            return reading.whole_record(connection, _known(id, "batch"))

    def batches(
        self,
        *,
        spacecraft: str | None = None,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        outcome: OutcomeName | None = None,
        status: Status | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page:
        """Current results, newest batch time first; see `reading.list_batches`.

        Raises `BadBatch` for a spacecraft that has neither batches nor a mission.
        """
        stretch = Stretch(run or LIVE, spacecraft, start, end)
        with self.store.reading() as connection:
            page = reading.list_batches(
                connection, stretch, outcome=outcome, status=status, limit=limit, cursor=cursor
            )
        if spacecraft is not None and not page.items:
            # A misspelt name must not pass for a spacecraft without data.
            mission_in_input(self.missions, spacecraft)
        return page

    # ---- spacecraft --------------------------------------------------------------------------

    def spacecraft(self) -> list[Row]:
        """Every spacecraft that has a mission file, with its live state."""
        with self.store.reading() as connection:
            return [
                histories.live_state(connection, mission, LIVE)
                for mission in self.missions.values()
            ]

    def spacecraft_state(self, name: str) -> Row:
        """One spacecraft's live state, its mission's settings and their history."""
        mission = mission_named(self.missions, name)
        with self.store.reading() as connection:
            return {
                **histories.live_state(connection, mission, LIVE),
                "mission": {"digest": mission.digest, "settings": mission.model_dump(mode="json")},
                "history": histories.mission_history(connection, name),
            }

    def attitudes(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page:
        """The attitudes of current results, oldest batch time first."""
        mission_named(self.missions, name)
        stretch = Stretch(run or LIVE, name, start, end)
        with self.store.reading() as connection:
            return histories.list_attitudes(connection, stretch, limit=limit, cursor=cursor)

    def rates(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        bucket: rollups.Bucket = "hour",
    ) -> list[Row]:
        """Stars by outcome over all observed ones, in UTC hours or days by batch time."""
        mission_named(self.missions, name)
        with self.store.reading() as connection:
            return rollups.rates(
                connection, name, run=run or LIVE, start=start, end=end, bucket=bucket
            )

    # ---- zones -------------------------------------------------------------------------------

    def zones(self) -> Row:
        """What the shelf holds, the least recently used first, and its counters."""
        state = self.sky.shelf.state()
        zones, run_catalogs = [], []
        for entry in state.entries:
            use = {"bytes": entry.thing.nbytes, "hits": entry.hits, "build_us": entry.build_us}
            if isinstance(entry.thing, Zone):
                zone = entry.thing
                about = {"spacecraft": zone.mission, **zone.summary(), "grid_deg": zone.grid_deg}
                zones.append(about | {"run_catalog": zone.run_catalog} | use)
            elif isinstance(entry.thing, RunCatalog):
                catalog = entry.thing
                about = {"digest": catalog.digest, "epoch_year": catalog.epoch_year}
                run_catalogs.append(about | {"stars": len(catalog)} | use)
        return {
            "items": zones,
            "run_catalogs": run_catalogs,
            "bytes": state.nbytes,
            "max_bytes": state.max_bytes,
            "hits": state.hits,
            "misses": state.misses,
            "evictions": state.evictions,
            "build_us": state.build_us,
        }

    def warm_zones(self, spacecraft: str, a_priori: Sequence[APrioriIn], time: Utc) -> list[Row]:
        """Build the zones that batches of these a priori attitudes will ask for."""
        mission = mission_in_input(self.missions, spacecraft)
        return [
            zone.summary()
            for each in a_priori
            for zone in warm_zones(self.sky, mission, prior_of(each), time)
        ]

    def drop_zones(self, spacecraft: str | None = None) -> int:
        """Drop the cached zones of a spacecraft, or all; how many there were."""
        if spacecraft is not None:
            mission_in_input(self.missions, spacecraft)
        return self.sky.drop_zones(spacecraft)

    # ---- runs and replays --------------------------------------------------------------------

    def runs(self) -> list[Row]:
        """Every run that holds batches."""
        with self.store.reading() as connection:
            return histories.list_runs(connection)

    def start_replay(
        self, lines: Iterable[bytes], run: str, name: str = "replay", total: int | None = None
    ) -> str:
        """Work through NDJSON lines in the background; the id under which to ask for progress.

        Every batch goes to `run`.  `total` is the number of lines, where it is
        known.  Lines that can be closed are closed at the end.
        """
        row = {"id": self._ids.new(), "run": _run_name(run), "name": name, "lines_total": total}
        replay = Replay(self.store, self.submit_many, lambda: now().text, row)
        with self._replays_lock:
            if self._closing:
                raise Stopping("the service is stopping")
            at_work = [each for each in self._replays if not each.is_over]
            if len(at_work) >= MAX_REPLAYS:
                raise Busy(f"{len(at_work)} replays are at work", REPLAY_RETRY_S)
            self._replays = [*at_work, replay]
        replay.start(lines)
        return str(row["id"])

    def replay(self, id: str) -> Row:
        """A replay and how far it is, with the lines that were refused."""
        with self.store.reading() as connection:
            return read_replay(connection, _known(id, "replay"))


def _known(id: str, what: str) -> str:
    # What has not the form of an id was never given out: the database need not be asked.
    if not is_ulid(id):
        raise NotFound(f"there is no {what} with the id {shown_value(id)}")
    return id


def _run_name(text: str) -> str:
    try:
        return _RUN_NAME.validate_python(text)
    except ValidationError as error:
        message = str(error.errors()[0]["msg"])
        raise BadBatch(Fault("run", message, shown_value(text))) from None
