"""The one object that every door holds: web, replay, simulator and scripts go through it."""

import gc
import hashlib
import json
import logging
import math
import threading
import time
from asyncio import wrap_future
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from typing import IO, TypeVar

from msgspec import structs
from pydantic import TypeAdapter, ValidationError
from sqlalchemy import Connection

from service import __version__
from service.acquire import Choices, choices_of
from service.advice.advice import Pace, advise
from service.advice.report import as_row
from service.alarms import latch
from service.alarms.limits import LimitSettings
from service.alarms.quantities import TRENDS, QuantityName
from service.errors import (
    AcquisitionError,
    BadBatch,
    Busy,
    Fault,
    NotFound,
    Stopping,
    shown_value,
)
from service.imaging.files import digest_of
from service.imaging.marks import marks_of
from service.imaging.overlay import draw_overlay
from service.imaging.submit import FrameIn, submission_of_frame
from service.missions.mission import Mission, load_missions, mission_named
from service.observe.compressed import Coding, unpacked_lines
from service.observe.wire import (
    APrioriIn,
    OptionsIn,
    RunName,
    Submission,
    TolerancesIn,
    prior_of,
    submission_from_json,
)
from service.records import (
    again,
    alarms,
    audit,
    events,
    histories,
    limits,
    overview,
    reading,
    rollups,
    trends,
)
from service.records.access import Access
from service.records.ahead import LIVE
from service.records.audit import Entry
from service.records.bench import mission_in_input
from service.records.bulk import Bulk, Check
from service.records.comparing import Pair, compare
from service.records.comparison import compare_runs
from service.records.database_file import FileIdentity
from service.records.draft import Answered, Row
from service.records.events import Event
from service.records.identity import OwnKey, own_key
from service.records.ids import Ulids, is_ulid, lone_ulid
from service.records.intake import Asked, Intake, Observer, Recorded
from service.records.looking import neighbours, recorded_batch, recorded_mission
from service.records.pages import Page, Stretch
from service.records.reading import OutcomeName, Status
from service.records.recording import register, watch_run
from service.records.replays import (
    Replay,
    list_replays,
    mark_cancelled,
    mark_interrupted,
    read_replay,
    require_cancellable,
)
from service.records.reprocess import Plan, Progress, reprocess
from service.records.star_field import star_field_of
from service.records.store import Readers, Store
from service.records.tokens import Caller
from service.records.watching import is_due, latest_inputs, shelf_end, sweep
from service.records.workers import Equipment
from service.records.worst import worst_batches
from service.settings import Settings, is_loopback
from service.sky.catalog import open_catalog
from service.sky.run_catalog import RunCatalog
from service.sky.shelf import Shelf
from service.sky.view import Sky
from service.sky.zones import Zone
from service.times import Utc, utc_now
from service.warm import warm_up, warm_zones

__all__ = ["LIVE", "Answered", "Operations", "Page", "Recorded"]

log = logging.getLogger(__name__)

ALL_RUNS = "*"
MAX_REPLAYS = 8
REHEARSALS = 8
"""So often a batch is rehearsed at the start: the interpreter settles on how it runs code."""
"""Each keeps a thread and a file of its own; those that come later may come again."""
REPLAY_RETRY_S = 30
CANCEL_WAIT_S = 5.0
"""So long whoever cancels a replay waits until it has ended."""

ADVICE_SAMPLE = 200
"""Batches enough to tell a sigma to some five percent, and run again in seconds."""
CREDITS = (
    "Hipparcos and Tycho-2 catalogs: ESA 1997, ESA/ESTEC; Hog et al. 2000",
    "Method: D. Fink and D. Shoup, Goddard Space Flight Center, 1994",
    "Earth orientation, aberration and time: ERFA, derived from the IAU SOFA software",
)
COMPARE_SAMPLE, COMPARE_RETRY_S = 100, 10
ADVICE_RETRY_S = 10
NO_TOLERANCES = TolerancesIn()
MAX_FRAMES_AT_WORK = 2
"""A frame at work takes some twenty bytes a pixel."""
FRAME_WAIT_S, FRAME_RETRY_S = 30.0, 5

_RUN_NAME = TypeAdapter(RunName)

T = TypeVar("T")


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
        self.readers: Readers = store
        self.access = Access(self.reading, self.change, is_loopback(settings.host), utc_now)
        self._intake = Intake(missions, sky, store)
        equipment = Equipment(
            missions, settings.catalog, sky.catalog.digest, settings.shelf_mb << 20
        )
        self._bulk = Bulk(self._intake, store, equipment, settings.replay_processes)
        self._ids = Ulids()
        self._replays: list[Replay] = []
        self._replays_lock = threading.Lock()
        self._closing = False
        self._frame_desks = threading.BoundedSemaphore(MAX_FRAMES_AT_WORK)
        self._warming = threading.Lock()
        self._warm = False
        self.started = utc_now()
        self._comparing = threading.Lock()
        self._advising = threading.Lock()

    @classmethod
    def open(
        cls,
        settings: Settings,
        mission: Mission | None = None,
        *,
        create: bool = True,
        serving: bool = False,
        expected: FileIdentity | None = None,
    ) -> "Operations":
        """Read missions and catalog, open the database, start writing.

        `mission`, where given, takes the place of the one of that name.  `create`,
        `serving` and `expected` are about the database; see `Store`.
        Raises `BadConfiguration` for whatever of these cannot be used.
        """
        missions = load_missions(settings.missions)
        if mission is not None:
            missions[mission.name] = mission
        sky = Sky(open_catalog(settings.catalog), Shelf(settings.shelf_mb << 20))
        store = Store(settings.database, create=create, serving=serving, expected=expected)
        operations = cls(settings, missions, sky, store)
        try:
            operations._register()
        except BaseException:
            operations.close()
            raise
        return operations

    def _register(self) -> None:
        moment = utc_now().text
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
        self._bulk.close()
        for replay in self._replays:
            replay.wait()
        self._intake.close()
        self.store.close()

    def ready(self) -> None:
        """Return once batches can be taken at full speed; the first call compiles and warms.

        Raises `Busy` while another call is at that, where the database cannot be
        read, and where the last write failed and another that is tried now does too.
        """
        if not self._warm:
            if not self._warming.acquire(blocking=False):
                raise Busy("the service is warming up")
            try:
                warm_up(self.sky, self.missions)
                self._look_where_they_look()
                # What is there by now stays: to go through it again and again costs more than
                # a batch does.
                gc.freeze()
                self._warm = True
            finally:
                gc.enable()
                self._warming.release()
        self.store.writer.require()
        self.store.writer.require_written()
        with self.reading() as connection:
            connection.exec_driver_sql("SELECT 1")

    def stop_warming(self) -> None:
        """Let nobody wait for what is not ready yet, where that can be helped: not here."""

    def _look_where_they_look(self) -> None:
        """Build what the next batch of each live spacecraft will most likely ask for.

        A batch of each is rehearsed, all but kept, under a name that it does not have; where
        there are few, more than once: what runs for the first times is slow.
        """
        with self.reading() as connection:
            inputs = latest_inputs(connection)
        for text in inputs:
            try:
                sent = submission_from_json(text)
                for _ in range(1 + REHEARSALS // len(inputs)):
                    batch = structs.replace(sent.batch, batch=self._ids.new())
                    self._intake.rehearse(structs.replace(sent, batch=batch))
            except Exception as error:
                # One that cannot be run any more is no reason not to start.
                log.warning("the latest batch of a spacecraft could not be rehearsed: %s", error)

    def backlog(self) -> Row:
        """What waits to be answered and to be written, and whether the last write succeeded."""
        return self._intake.backlog()

    async def attach(self) -> None:
        """Be asked from an event loop from now on."""

    def reading(self) -> AbstractContextManager[Connection]:
        """A connection that sees one moment of the database; see `Readers.reading`."""
        return self.readers.reading()

    def change(self, change: Callable[[Connection], T]) -> T:
        """Have something changed in the database, whole or not at all, and wait until it is."""
        return self.store.writer.change(change).result()

    def listen(self, listener: Callable[[], object]) -> None:
        """Have a function called, from any thread, whenever something was written."""
        self.store.writer.after_commit.append(listener)
        self._intake.after_group.append(listener)

    def unlisten(self, listener: Callable[[], object]) -> None:
        """Have it called no more."""
        self.store.writer.after_commit.remove(listener)
        self._intake.after_group.remove(listener)

    # ---- batches -----------------------------------------------------------------------------

    @property
    def observers(self) -> list[Observer]:
        """Called with every batch that is new, after its commit."""
        return self._intake.observers

    def submit(
        self,
        submission: Submission,
        idempotency_key: str | None = None,
        caller: Caller | None = None,
    ) -> Answered:
        """Record a batch and answer it; a repeat gets the stored answer.

        Raises `KeyReused` and `Conflict` for another body under a key or a
        batch that is taken, `BadBatch` for an unknown spacecraft and for what
        does not fit its mission, `Busy` when too much is waiting.
        """
        return self.take(submission, idempotency_key, caller).result()

    def take(
        self,
        sent: bytes | Submission,
        idempotency_key: str | None = None,
        caller: Caller | None = None,
    ) -> "Future[Answered]":
        """`submit` for who does not want to wait: the future gives the answer, or the error.

        What was sent as JSON is read here; `caller`, where given, must be allowed
        to ask about its spacecraft; a key of one token is not that of another.
        """
        done: Future[Answered] = Future()
        # Who gives up does not take the record back.
        done.set_running_or_notify_cancel()

        def settle(outcome: Answered | Exception) -> None:
            if isinstance(outcome, Exception):
                done.set_exception(outcome)
            else:
                done.set_result(outcome)

        self._intake.take([Asked(sent, own_key(caller, idempotency_key), settle, caller)])
        return done

    def take_all(self, asked: Sequence[Asked]) -> None:
        """`take` of many at once, each of which says who is called with its outcome."""
        self._intake.take(asked)

    def take_all_here(self, asked: Sequence[Asked], more: Callable[[], Sequence[Asked]]) -> None:
        """`take_all`, worked through in this thread until nothing waits any longer.

        `more` is called before each group, by whichever thread is at work then,
        for what came meanwhile.
        """
        self._intake.take_here(asked, more)

    async def answered(
        self, sent: bytes, idempotency_key: str | None = None, caller: Caller | None = None
    ) -> Answered:
        """`take` for an event loop, which does other things meanwhile."""
        return await wrap_future(self.take(sent, idempotency_key, caller))

    def submit_many(self, submissions: Sequence[Submission]) -> list[Answered | AcquisitionError]:
        """`submit` of each in one transaction; an error stands in the place of what is refused."""
        return self._intake.submit_many(submissions)

    def submit_frame(
        self,
        spacecraft: str,
        known: FrameIn,
        file: IO[bytes],
        idempotency_key: str | None = None,
        caller: Caller | None = None,
    ) -> Answered:
        """Find the stars on a frame, then `submit` the batch of them; see `imaging.submit`.

        The same frame, told the same of, is a repeat and is not looked at again.
        The file is closed at the end.
        Raises `NotFound` for an unknown spacecraft, `BadInput` for a file that is no
        frame of its tracker's, and whatever `submit` raises.
        """
        with file:
            return self._submit_frame(spacecraft, known, file, own_key(caller, idempotency_key))

    def _submit_frame(
        self, spacecraft: str, known: FrameIn, file: IO[bytes], key: OwnKey | None
    ) -> Answered:
        mission = mission_named(self.missions, spacecraft)
        digest = digest_of(file)

        def make() -> Submission:
            if not self._frame_desks.acquire(timeout=FRAME_WAIT_S):
                raise Busy("other frames are being worked on", FRAME_RETRY_S)
            try:
                max_pixels = self.settings.frame_megapixels * 1_000_000
                return submission_of_frame(file, digest, known, mission, max_pixels)
            finally:
                self._frame_desks.release()

        return self._intake.submit_made(
            (mission.name, known.run, known.batch_of(digest)),
            known.fingerprint(mission.name, digest),
            make,
            key,
        )

    def overlay(self, id: str) -> bytes:
        """A PNG of the frame that a result was made of, with what was made of it."""
        with self.reading() as connection:
            row = reading.frame_behind(connection, _known(id, "batch"))
        # As it was for that result, whatever its file says now.
        mission = Mission.model_validate_json(row["settings"])
        answer, batch = json.loads(row["answer"]), submission_from_json(row["input"]).batch
        tracker, camera = mission.camera_tracker(batch.observations[0].tracker, "tracker")
        run_catalog = None
        if row["catalog_digest"] == self.sky.catalog.digest:
            run_catalog = self.sky.run_catalog(mission, batch.time)
        detections = json.loads(row["detections"])
        marks = marks_of(answer, batch, tracker, camera, detections, run_catalog)
        state = answer["attitude"]["status"] if answer["attitude"] else answer["reason"]
        title = f"{mission.name} {tracker.name}  {batch.batch}  {batch.time.text}  {state}"
        return draw_overlay(row["preview"], row["preview_step"], marks, title)

    def what_if(
        self,
        id: str,
        options: OptionsIn,
        record: bool = False,
        adopt: bool = False,
        entry: Entry | None = None,
    ) -> Answered:
        """Run a recorded batch again with other options, in place of what they name.

        The answer names its parent.  It is kept only where `record` or `adopt`
        asks for that; adopted, it becomes what lists, histories and rates show.
        `entry` is what the audit list is to say of it then.
        """
        known = _known(id, "batch")
        return self._intake.what_if(known, options, record=record, adopt=adopt, entry=entry)

    def batch(self, id: str) -> Row:
        """One result: `answer`, `input`, `current`, `parent`, and the `what_ifs` of its batch."""
        with self.reading() as connection:
            return reading.whole_record(connection, _known(id, "batch"))

    def neighbours(self, id: str) -> Row:
        """The results before and after one in time: `earlier` and `later`, or None."""
        with self.reading() as connection:
            return neighbours(connection, _known(id, "batch"))

    def star_field(self, id: str, answer: Row | None = None) -> Row:
        """What a picture of a result's stars is drawn from; see `star_field.star_field_of`.

        An `answer` in place of the recorded one, such as that of a what-if, is
        drawn over the same batch.
        """
        with self.reading() as connection:
            batch, recorded = recorded_batch(connection, _known(id, "batch"))
            answer = answer or recorded
            mission = recorded_mission(connection, answer["provenance"]["mission"])
        return star_field_of(batch, mission, self.sky, answer)

    def settings_for(self, id: str) -> Choices:
        """The settings that a what-if of a result begins from."""
        with self.reading() as connection:
            batch, _ = recorded_batch(connection, _known(id, "batch"))
        return choices_of(batch, mission_named(self.missions, batch.spacecraft))

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

        The run `*` stands for every run, live batches included.
        Raises `BadBatch` for a spacecraft that has neither batches nor a mission.
        """
        stretch = Stretch(None if run == ALL_RUNS else run or LIVE, spacecraft, start, end)
        with self.reading() as connection:
            page = reading.list_batches(
                connection, stretch, outcome=outcome, status=status, limit=limit, cursor=cursor
            )
        if spacecraft is not None and not page.items:
            # A misspelt name must not pass for a spacecraft without data.
            mission_in_input(self.missions, spacecraft)
        return page

    def spacecraft_of(self, id: str) -> str | None:
        """The spacecraft that a recorded result belongs to; None where there is no such result."""
        if not is_ulid(id):
            return None
        with self.reading() as connection:
            return reading.spacecraft_of(connection, id)

    # ---- access ------------------------------------------------------------------------------

    def audit(self, limit: int = 100, cursor: str | None = None) -> Page:
        """Who changed what, newest first."""
        with self.reading() as connection:
            return audit.list_entries(connection, limit, cursor)

    # ---- spacecraft --------------------------------------------------------------------------

    def overview(self, run: str | None = None) -> Row:
        """Every spacecraft in a run at a glance; see `overview.overview`."""
        with self.reading() as connection:
            missions = self.missions.values()
            return overview.overview(connection, missions, run or LIVE, utc_now())

    def about(self) -> Row:
        """What answers: version, catalog, missions, kind of database."""
        catalog = self.sky.catalog
        return {
            "version": __version__,
            "started": self.started.text,
            "database": self.readers.url.get_backend_name(),
            "catalog": {
                "digest": catalog.digest,
                "name": catalog.name,
                "stars": len(catalog.magnitude_v_mag),
            },
            "missions": [
                {"name": each.name, "description": each.description, "digest": each.digest}
                for each in self.missions.values()
            ],
            "credits": list(CREDITS),
        }

    def default_run(self) -> str:
        """The run to look at first: live, or while that is empty the newest."""
        with self.reading() as connection:
            return overview.default_run(connection)

    def spacecraft(self, run: str | None = None) -> list[Row]:
        """Every spacecraft that has a mission file, with its state in a run."""
        moment = utc_now()
        with self.reading() as connection:
            return [
                histories.live_state(connection, mission, run or LIVE, moment)
                for mission in self.missions.values()
            ]

    def spacecraft_state(self, name: str, run: str | None = None) -> Row:
        """One spacecraft's state in a run, its mission's settings and their history."""
        mission = mission_named(self.missions, name)
        with self.reading() as connection:
            return {
                **histories.live_state(connection, mission, run or LIVE, utc_now()),
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
        with self.reading() as connection:
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
        """Stars by outcome over all observed ones, in UTC hours or days by batch time.

        Raises `BadInput` for a stretch with too many of them.
        """
        mission_named(self.missions, name)
        with self.reading() as connection:
            return rollups.rates(
                connection, name, run=run or LIVE, start=start, end=end, bucket=bucket
            )

    def history(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        strategy: trends.Strategy = "minmax",
        size: int = 500,
        quantities: Sequence[QuantityName] = (),
    ) -> Row:
        """Histories of quantities, all of them unless named, in at most `size` points each.

        `minmax` gives buckets with mean, least and greatest, `latest` the newest
        batches one by one; see `trends.history`.
        """
        mission_named(self.missions, name)
        asked = trends.Asked(tuple(quantities) or TRENDS, strategy, size)
        with self.reading() as connection:
            return trends.history(
                connection, name, run=run or LIVE, start=start, end=end, asked=asked
            )

    def every_batch(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        quantities: Sequence[QuantityName] = (),
    ) -> Iterator[Row]:
        """The history of every batch of a stretch, in pages; see `trends.every_batch`."""
        mission_named(self.missions, name)
        names = tuple(quantities) or TRENDS
        return trends.every_batch(
            self.reading, name, run=run or LIVE, start=start, end=end, quantities=names
        )

    def worst_batches(
        self,
        name: str,
        *,
        by: QuantityName,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        limit: int = 20,
    ) -> list[Row]:
        """The batches of a stretch that are worst by a quantity, with its `value`, worst first."""
        mission_named(self.missions, name)
        stretch = Stretch(run or LIVE, name, start, end)
        with self.reading() as connection:
            return worst_batches(connection, stretch, by, limit)

    def advise(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        sample: int = ADVICE_SAMPLE,
        tolerances: TolerancesIn = NO_TOLERANCES,
        limit_s: float = math.inf,
        step: Callable[[], object] = lambda: None,
    ) -> Row:
        """What the batches of a run say of a mission's settings; see `service.advice`.

        Of the batches at most `sample` are run again, fewer where `limit_s`
        seconds run out; `step` is called after each, twice a batch.  `tolerances`
        are tried as well.  Raises `Busy` while other advice is being worked out.
        """
        mission = mission_named(self.missions, name)
        own = tolerances.model_dump(exclude_none=True)
        if not self._advising.acquire(blocking=False):
            raise Busy("other advice is being worked out", ADVICE_RETRY_S)
        try:
            with self.reading() as connection:
                drawn = again.sample(connection, Stretch(run or LIVE, name, start, end), sample)
            began = time.monotonic()
            pace = Pace(lambda share: time.monotonic() - began < share * limit_s, step)
            # Were the worst looked up in the whole sky, the others would look too good.
            run_again = partial(self._intake.run_again, mission=mission.within_zones)
            advice = advise(mission, drawn.batches, run_again, own, pace)
        finally:
            self._advising.release()
        return {
            "spacecraft": name,
            "run": run or LIVE,
            "first": drawn.first,
            "last": drawn.last,
            "batches_in_range": drawn.total,
            **as_row(advice),
        }

    def compare(
        self,
        name: str,
        a: OptionsIn,
        b: OptionsIn,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        sample: int = COMPARE_SAMPLE,
        limit_s: float = math.inf,
    ) -> Row:
        """Run recorded batches again with two sets of options and show where they differ.

        Of a stretch at most `sample` batches, fewer where `limit_s` seconds run
        out.  What options do not name stays as it was for a batch.  Raises
        `Busy` while another comparison is being worked out.
        """
        mission_named(self.missions, name)
        if not self._comparing.acquire(blocking=False):
            raise Busy("another comparison is being worked out", COMPARE_RETRY_S)
        try:
            with self.reading() as connection:
                drawn = again.sample(connection, Stretch(run or LIVE, name, start, end), sample)
            pairs = [
                Pair(
                    row["id"], *(again.batch_again(row["input"], row["options"], o) for o in (a, b))
                )
                for row in drawn.rows
            ]
            found, cut_short = compare(pairs, self._intake.run_again, limit_s)
        finally:
            self._comparing.release()
        options = (each.model_dump(mode="json", exclude_none=True) for each in (a, b))
        return {
            "spacecraft": name,
            "run": run or LIVE,
            "start": drawn.first,
            "end": drawn.last,
            "batches_in_stretch": drawn.total,
            "sampled": len(pairs),
            "cut_short": cut_short,
            **found.row(*options),
        }

    # ---- limits and alarms -------------------------------------------------------------------

    def limits(self, name: str) -> list[Row]:
        """The limit of every quantity of a spacecraft."""
        mission = mission_named(self.missions, name)
        with self.reading() as connection:
            return limits.list_limits(connection, mission)

    def limit(self, name: str, quantity: QuantityName) -> Row:
        """The limit of one quantity, the shipped one, and every one that was set."""
        mission = mission_named(self.missions, name)
        with self.reading() as connection:
            return limits.limit_history(connection, mission, quantity)

    def set_limit(
        self,
        name: str,
        quantity: QuantityName,
        settings: LimitSettings | None,
        *,
        who: str,
        comment: str | None = None,
        entry: Entry | None = None,
    ) -> Row:
        """Let a limit hold from the next batch on; None: the shipped one again.

        Here as in what follows, `entry` is what the audit list is to say of the change.
        """
        mission, moment = mission_named(self.missions, name), utc_now().text
        return self._change_noted(
            lambda connection: limits.set_limit(
                connection, mission, quantity, settings, who=who, comment=comment, now=moment
            ),
            entry,
        )

    def alarms(
        self,
        *,
        run: str | None = None,
        spacecraft: str | None = None,
        state: alarms.StateFilter = "active",
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page:
        """Alarms, newest first; the run `*` stands for every run."""
        with self.reading() as connection:
            return alarms.list_alarms(
                connection,
                run=None if run == ALL_RUNS else run or LIVE,
                spacecraft=spacecraft,
                state=state,
                limit=limit,
                cursor=cursor,
                now=utc_now().text,
            )

    def active_alarms(self, run: str = LIVE) -> list[Row]:
        """Every alarm of a run that is not cleared, the worst first."""
        with self.reading() as connection:
            return alarms.active_alarms(connection, run, utc_now().text)

    def alarm(self, id: str) -> Row:
        """One alarm with all that was noted of it."""
        with self.reading() as connection:
            return alarms.one_alarm(connection, _known(id, "alarm"), utc_now().text)

    def acknowledge(
        self, id: str, who: str, comment: str | None = None, entry: Entry | None = None
    ) -> Row:
        """Somebody has seen an alarm; with the quantity back in limits it is cleared."""
        moment = utc_now().text
        return self._act(
            id, lambda alarm: latch.acknowledged(alarm, who, moment), who, comment, moment, entry
        )

    def shelve(
        self,
        id: str,
        who: str,
        minutes: int,
        comment: str | None = None,
        entry: Entry | None = None,
    ) -> Row:
        """Put an alarm aside for some minutes."""
        now = utc_now()
        until = shelf_end(now, minutes)
        return self._act(
            id,
            lambda alarm: latch.shelved(alarm, who, until, now.text),
            who,
            comment,
            now.text,
            entry,
        )

    def unshelve(
        self, id: str, who: str, comment: str | None = None, entry: Entry | None = None
    ) -> Row:
        """Take an alarm off the shelf."""
        return self._act(id, latch.unshelved, who, comment, utc_now().text, entry)

    def comment(self, id: str, who: str, comment: str, entry: Entry | None = None) -> Row:
        """Say something about an alarm, cleared ones included."""
        return self._act(id, lambda _: ({}, ["commented"]), who, comment, utc_now().text, entry)

    def _act(
        self,
        id: str,
        step: Callable[[Row], latch.Step],
        who: str,
        comment: str | None,
        moment: str,
        entry: Entry | None,
    ) -> Row:
        known = _known(id, "alarm")
        return self._change_noted(
            lambda connection: alarms.act(
                connection, known, step, who=who, comment=comment, now=moment
            ),
            entry,
        )

    def _change_noted(self, change: Callable[[Connection], T], entry: Entry | None) -> T:
        """`change`, with its entry in the audit list: both are stored, or neither."""

        def noted(connection: Connection) -> T:
            changed = change(connection)
            if entry is not None:
                entry.add_to(connection)
            return changed

        return self.store.writer.change(noted).result()

    def sweep(self) -> bool:
        """Look for silent spacecraft and shelves whose time is over; whether there were any."""
        moment = utc_now()
        with self.reading() as connection:
            due = is_due(connection, self.missions, moment)
        if due:
            self.store.writer.change(
                lambda connection: sweep(connection, self.missions, moment)
            ).result()
        return due

    # ---- events ------------------------------------------------------------------------------

    def last_event(self) -> int:
        """The number of the latest event."""
        with self.reading() as connection:
            return events.last_event(connection)

    def events_after(self, last: int, limit: int) -> Sequence[Event] | None:
        """The events after a number, oldest first; None where some are kept no more."""
        with self.reading() as connection:
            return events.events_after(connection, last, limit)

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
        with self.reading() as connection:
            return histories.list_runs(connection)

    def reprocess(
        self,
        run: str | None,
        *,
        source: str = LIVE,
        spacecraft: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        processes: int = 0,
        step: Callable[[Progress], object] = lambda progress: None,
    ) -> tuple[Progress, Row]:
        """Run the batches of a run again into another, and compare both.

        The settings are those of these operations.  `run` None takes a name
        that tells the settings.  What the run holds already is not run again.
        Raises `BadBatch` where the run holds results of other settings.
        """
        if spacecraft is not None:
            mission_named(self.missions, spacecraft)
        chosen = {name: each for name, each in self.missions.items() if spacecraft in (None, name)}
        stretch = Stretch(source, spacecraft, start, end)
        plan = Plan(
            stretch=stretch,
            run=checked_run_name(run or self._run_of_settings(source, chosen)),
            missions=chosen,
            catalog=self.settings.catalog,
            shelf_bytes=self.settings.shelf_mb << 20,
            processes=processes,
        )
        progress = reprocess(self.store, plan, self.sky.catalog.digest, step)
        return progress, self.compare_runs(source, plan.run, spacecraft, start, end)

    def _run_of_settings(self, source: str, missions: Mapping[str, Mission]) -> str:
        """A name for a run that the same settings give again, so that it can be gone on with."""
        digests = [self.sky.catalog.digest, *sorted(each.digest for each in missions.values())]
        short = hashlib.sha256("".join(digests).encode()).hexdigest()[:8]
        return f"{source[:50]}-again-{short}"

    def compare_runs(
        self,
        run: str,
        other: str,
        spacecraft: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
    ) -> Row:
        """What became of the same stars in two runs, and how far the attitudes differ."""
        with self.reading() as connection:
            return compare_runs(connection, Stretch(run, spacecraft, start, end), other)

    def watch_run(self, run: str, alarms: bool = True, entry: Entry | None = None) -> Row:
        """Let limits be held against the batches that a run gets from now on, or no longer."""
        name = checked_run_name(run)
        if name == LIVE and not alarms:
            raise BadBatch(Fault("alarms", "live batches are always watched", "False"))
        self._change_noted(
            lambda connection: watch_run(connection, name, alarms, utc_now().text), entry
        )
        return {"run": name, "alarms": alarms}

    def start_replay(
        self,
        lines: Iterable[bytes],
        run: str,
        name: str = "replay",
        total: int | None = None,
        check: Check = lambda spacecraft: None,
        alarms: bool = False,
        owner: str | None = None,
        entry: Entry | None = None,
    ) -> str:
        """Work through NDJSON lines in the background; the id under which to ask for progress.

        Every batch goes to `run`.  `total` is the number of lines, where it is
        known.  Lines that can be closed are closed at the end.  A line for whose
        spacecraft `check` raises an `AcquisitionError` is refused with it.  With `alarms`
        limits are held against the run (see `watch_run`).  `owner` is the token
        that it is started with (see `cancel_replay`).  `entry` of the audit is noted
        with it.
        """
        return self._start_replay(
            lambda replay: lines, run, name, total, check, alarms, owner, entry
        )

    def _start_replay(
        self,
        lines_for: Callable[[Replay], Iterable[bytes]],
        run: str,
        name: str,
        total: int | None,
        check: Check,
        alarms: bool,
        owner: str | None,
        entry: Entry | None,
    ) -> str:
        # Whoever knows the id may ask for the progress.
        row = {"id": lone_ulid(), "run": checked_run_name(run), "name": name, "lines_total": total}
        replay = Replay(
            self.store,
            self._bulk,
            lambda: utc_now().text,
            row,
            check,
            owner,
            self.settings.replay_seconds,
        )
        with self._replays_lock:
            if self._closing:
                raise Stopping("the service is stopping")
            at_work = [each for each in self._replays if not each.is_over]
            if len(at_work) >= MAX_REPLAYS:
                raise Busy(f"{len(at_work)} replays are at work", REPLAY_RETRY_S)
            self._replays = [*at_work, replay]

        def also(connection: Connection) -> None:
            if alarms:
                watch_run(connection, str(row["run"]), True, utc_now().text)
            if entry is not None:
                entry.add_to(connection)

        replay.start(lines_for(replay), also)
        return replay.id

    def start_replay_of(
        self,
        file: IO[bytes],
        coding: Coding,
        run: str,
        *,
        name: str,
        total: int | None,
        longest_bytes: int,
        check: Check,
        alarms: bool = False,
        owner: str | None = None,
        entry: Entry | None = None,
    ) -> str:
        """`start_replay` of the lines of a file, which is closed at the end.

        Of a line with more than `longest_bytes` the rest is not read.
        """
        with ExitStack() as on_failure:
            on_failure.callback(file.close)
            id = self._start_replay(
                lambda replay: unpacked_lines(file, coding, longest_bytes, replay.require_going_on),
                run,
                name,
                total,
                check,
                alarms,
                owner,
                entry,
            )
            on_failure.pop_all()
        return id

    def cancel_replay(self, id: str, caller: Caller | None = None) -> Row:
        """End a replay; what it recorded stays.  Returns how far it came.

        Waits a few seconds for its end, until when its state is `running`.  A
        replay that is cancelled already is left as it is.  Raises `NotFound`,
        also where the caller is bound to spacecraft and the replay was not
        started with their token, and `NotNow` where it has ended otherwise.
        """
        known = _known(id, "replay")
        with self._replays_lock:
            replay = next((each for each in self._replays if each.id == known), None)
        if caller is not None and caller.spacecraft is not None:
            theirs = replay is not None and replay.owner == caller.token_id
            if not theirs:
                raise NotFound(f"{caller.name} has started no replay with the id {id[:80]!r}")
        if replay is None:
            moment = utc_now().text
            self.store.writer.change(
                lambda connection: mark_cancelled(connection, known, moment)
            ).result()
        elif not replay.is_over:
            replay.cancel()
            replay.wait(CANCEL_WAIT_S)
        state = self.replay(known)
        require_cancellable(state["state"])
        return state

    def replay_processes(self) -> int:
        """How many processes beside this one are ready to compute replays."""
        return self._bulk.workers.up

    def replays(self) -> list[Row]:
        """The latest replays and how far they are, newest first."""
        with self.reading() as connection:
            return list_replays(connection)

    def replay(self, id: str) -> Row:
        """A replay and how far it is, with the lines that were refused."""
        with self.reading() as connection:
            return read_replay(connection, _known(id, "replay"))


def _known(id: str, what: str) -> str:
    # What has not the form of an id was never given out: the database need not be asked.
    if not is_ulid(id):
        raise NotFound(f"there is no {what} with the id {shown_value(id)}")
    return id


def checked_run_name(text: str) -> str:
    """The name of a run; raises `BadBatch` for a text that names none."""
    try:
        return _RUN_NAME.validate_python(text)
    except ValidationError as error:
        message = str(error.errors()[0]["msg"])
        raise BadBatch(Fault("run", message, shown_value(text))) from None
