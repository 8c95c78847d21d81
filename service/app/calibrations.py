"""Calibrations: begun, computed beside other work, recorded, tried, read, and adopted."""

import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import msgspec
from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from service.access import Entry
from service.app.calibration_estimates import (
    CalibrationRequest,
    CalibrationRun,
    Estimator,
    Step,
    geometry_digest,
    result_of,
    with_geometry,
)
from service.app.context import Context, known_id
from service.app.results import COMPARE_SAMPLE, Comparisons, Stretch
from service.contract.base import Page
from service.contract.runs import Comparison
from service.errors import AcquisitionError, Busy, NotFound, Stopping, WrongState, shown_value
from service.ingest.submit import SubmissionService
from service.missions.mission import Mission, load_missions, mission_named
from service.storage import calibrations
from service.storage.calibrations import (
    Calibration,
    CalibrationAdoption,
    CalibrationInForce,
    CalibrationSummary,
    TrackerGeometry,
)
from service.storage.recording import events
from service.storage.recording.ids import Ulids
from service.storage.recording.results import register
from service.storage.recording.unsaved_result import LIVE
from service.storage.sql.columns import Row
from service.times import Utc, utc_now

log = logging.getLogger(__name__)


class CalibrationService:
    """Estimates and records calibrations; no setting is changed."""

    def __init__(
        self, context: Context, submissions: SubmissionService, comparisons: Comparisons
    ) -> None:
        self._context = context
        self._submissions = submissions
        self._comparisons = comparisons
        self._estimator = Estimator(context, submissions)
        self._ids = Ulids()
        self._background = BackgroundCalibrations(context, self._estimator)

    def of_spacecraft(
        self, wanted: CalibrationRequest, step: Step = lambda done, total: None
    ) -> CalibrationRun:
        """The calibration that the batches of a run give; nothing is recorded.

        Raises `BadInput` where there are too few identified stars.
        """
        mission = mission_named(self._context.missions, wanted.spacecraft)
        return self._estimator.estimate(wanted, mission, step)

    def record(self, wanted: CalibrationRequest, found: CalibrationRun, who: str) -> Calibration:
        """Record a calibration that was computed here."""
        id = self._ids.new()
        row = self._row(id, wanted, found.mission, who)
        changes = found_columns(found) | {"done": found.sampled, "total": found.sampled}

        def change(connection: Connection) -> None:
            calibrations.add_calibration(connection, row)
            calibrations.change_calibration(connection, id, changes)

        self._context.change(change)
        return self.get(id)

    def start(
        self, wanted: CalibrationRequest, who: str, entry: Entry | None = None
    ) -> Calibration:
        """Record a calibration as begun, and compute it beside other work, one after the other.

        Raises `BadInput` for trackers that the mission has not, `Busy` where too many wait.
        """
        mission = mission_named(self._context.missions, wanted.spacecraft)
        wanted.require(mission)
        self._submissions.require_kernels()
        id = self._ids.new()
        row = self._row(id, wanted, mission, who)

        def begin() -> None:
            self._context.change_audited(
                lambda connection: calibrations.add_calibration(connection, row), entry
            )

        self._background.compute(id, wanted, mission, begin)
        return self.get(id)

    def get(self, id: str) -> Calibration:
        """One calibration."""
        with self._context.reading() as connection:
            return calibrations.read_calibration(connection, known_id(id, "calibration"))

    def page(
        self, spacecraft: str | None = None, limit: int = 100, cursor: str | None = None
    ) -> Page[CalibrationSummary]:
        """Calibrations, newest first."""
        if spacecraft is not None:
            self._context.mission(spacecraft)
        with self._context.reading() as connection:
            return calibrations.list_calibrations(connection, spacecraft, limit, cursor)

    def trial(
        self,
        id: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        sample: int = COMPARE_SAMPLE,
        limit_s: float = math.inf,
    ) -> Comparison:
        """Recorded batches with the settings in force (`a`), and with a calibration (`b`).

        Without a `run` the batches of the calibration's run.  The comparison is not recorded.
        """
        calibration = self.get(id)
        result = calibration.result
        if result is None:
            raise WrongState(f"the calibration is {calibration.state}")
        name = calibration.spacecraft
        mission = mission_named(self._context.missions, name)
        stretch = Stretch(name, run or calibration.run, start, end, sample)
        calibrated = with_geometry(mission, result.trackers)
        return self._comparisons.of_missions(stretch, mission, calibrated, limit_s)

    def interrupt(self) -> None:
        """Close the calibrations that a stopped process left unfinished."""
        now = utc_now().text
        self._context.change(
            lambda connection: calibrations.interrupt_calibrations(connection, now)
        )

    def close(self) -> None:
        """End the calibration that is computed, and those that wait."""
        self._background.close()

    def _row(self, id: str, wanted: CalibrationRequest, mission: Mission, who: str) -> Row:
        request = asdict(wanted) | {
            "run": wanted.run or LIVE,
            "start": wanted.start and wanted.start.text,
            "end": wanted.end and wanted.end.text,
            "trackers": list(wanted.trackers),
        }
        return {
            "id": id,
            "spacecraft": wanted.spacecraft,
            "run": wanted.run or LIVE,
            "created": utc_now().text,
            "who": who,
            "state": "queued",
            "done": 0,
            "total": 0,
            "mission_digest": mission.digest,
            "request": msgspec.json.encode(request).decode(),
        }


MOST_WAITING = 4
SAVED_EVERY_S = 0.5


class BackgroundCalibrations:
    """A thread that computes calibrations and records what they come to."""

    def __init__(self, context: Context, estimator: Estimator) -> None:
        self._context, self._estimator = context, estimator
        self._thread = ThreadPoolExecutor(1, "calibrate")
        self._lock = threading.Lock()
        self._unfinished = 0
        self._closing = False
        self._closed = threading.Event()

    def compute(
        self,
        id: str,
        wanted: CalibrationRequest,
        mission: Mission,
        begin: Callable[[], object],
    ) -> None:
        """Queue a calibration once `begin` has recorded it.

        Raises `Busy` where too many wait, `Stopping` while the service closes.
        """
        with self._lock:
            if self._closing:
                raise Stopping("the service is stopping")
            if self._unfinished >= MOST_WAITING:
                raise Busy(f"{self._unfinished} calibrations wait already", 10)
            self._unfinished += 1
            self._context.store.at_work.add(id)
        try:
            begin()
            self._thread.submit(self._compute, id, wanted, mission)
        except BaseException:
            self._over(id)
            raise

    def close(self) -> None:
        """End the calibration that is computed, and those that wait."""
        with self._lock:
            self._closing = True
        self._closed.set()
        self._thread.shutdown(cancel_futures=True)

    def _compute(self, id: str, wanted: CalibrationRequest, mission: Mission) -> None:
        progress = _Progress(self._context, id, lambda: self._closing)
        try:
            ended = found_columns(self._estimator.estimate(wanted, mission, progress.step))
        except Stopping:
            ended = {"state": "interrupted"}
        except AcquisitionError as error:
            ended = {"state": "failed", "fault": str(error)}
        except Exception:
            # Whatever fails, the calibration must end: a client waits for its state.
            log.exception("calibration %s failed", id)
            fault = "the fault is on the service's side; it is logged"
            ended = {"state": "failed", "fault": fault}
        finally:
            self._over(id)
        ended |= {"ended": utc_now().text}
        while True:
            try:
                progress.save(ended)
                return
            except (AcquisitionError, SQLAlchemyError) as error:
                log.warning("the end of calibration %s cannot be recorded yet: %s", id, error)
            # After this another service, or the next start, records it as interrupted.
            if self._closed.wait(SAVED_EVERY_S):
                return

    def _over(self, id: str) -> None:
        with self._lock:
            self._unfinished -= 1
            self._context.store.at_work.discard(id)


class _Progress:
    """Notes how far a calibration is."""

    def __init__(self, context: Context, id: str, is_closing: Callable[[], bool]) -> None:
        self._context, self._id, self._is_closing = context, id, is_closing
        self._next_s = 0.0

    def step(self, done: int, total: int) -> None:
        """Raises `Stopping` where the service stops."""
        if self._is_closing():
            raise Stopping("the service is stopping")
        now_s = time.monotonic()
        if now_s >= self._next_s or done == total:
            self._next_s = now_s + SAVED_EVERY_S
            self.save({"state": "running", "ended": None, "done": done, "total": total})

    def save(self, changes: Row) -> None:
        self._context.change(
            lambda connection: calibrations.change_calibration(connection, self._id, changes)
        )


def found_columns(run: CalibrationRun) -> Row:
    """The columns of a calibration that is done."""
    return {
        "state": "done",
        "ended": utc_now().text,
        "result": msgspec.json.encode(result_of(run)).decode(),
        "covariance": msgspec.json.encode(run.covariance.tolist()).decode(),
    }


# The calibration in force of each spacecraft: adopted and taken back by an operator.
#
# An adopted calibration lies over the mission file: alignment and focal plane of every
# tracker are those that were adopted, and all other settings the file's.  Where the file's
# own alignments or focal planes have changed since, the file holds.

EVENT_FIELDS = ("id", "spacecraft", "adopted", "who", "note", "calibration", "version", "mission")
"""The fields of a change's event; the others are long."""


def adopted_missions(
    connection: Connection, files: Mapping[str, Mission], leave: str | None = None
) -> dict[str, Mission]:
    """The missions of these files with an adopted calibration over them, but for `leave`."""
    found: dict[str, Mission] = {}
    for each in calibrations.latest_adoptions(connection):
        file = files.get(each.spacecraft)
        if file is None or each.spacecraft == leave or each.trackers is None:
            continue
        if each.file != geometry_digest(file):
            log.warning(
                "%s: the mission file was changed after calibration version %s was adopted; "
                "the file holds",
                each.spacecraft,
                each.version,
            )
            continue
        found[each.spacecraft] = with_geometry(file, each.trackers)
    return found


class CalibrationAdoptions:
    """Adopts calibrations, and says what held when.

    `context.missions` have what is in force; the settings of the files are kept here.
    """

    def __init__(self, context: Context, missions_changed: Callable[[], None]) -> None:
        """`missions_changed` is called after a mission of the context was replaced."""
        self._context = context
        self._files = dict(context.missions)
        self._missions_changed = missions_changed
        self._ids = Ulids()
        self._lock = threading.Lock()
        self._leave: str | None = None
        self._loaded: str | None = None
        """The newest adoption when they were loaded; empty where there was none."""

    def follow(self) -> None:
        """`load` again where another service has adopted one since."""
        with self._context.reading_record() as connection:
            self.follow_in(connection)

    def follow_in(self, connection: Connection) -> None:
        """`follow`, with a connection that sees the record as it is now.

        Each group of posts begins with this: whoever posts after an adoption was answered, by
        whichever service, is answered with the calibration that was adopted.
        """
        if calibrations.newest_adoption(connection) != self._loaded:
            self.load(self._leave)

    def load(self, leave: str | None = None) -> None:
        """Put what was adopted over the mission files, but for the spacecraft `leave`."""
        self._leave = leave
        with self._lock:
            before = dict(self._context.missions)
            with self._context.reading_record() as connection:
                self._loaded = calibrations.newest_adoption(connection)
                adopted = adopted_missions(connection, self._files, leave)
            self._context.missions.update(self._files | adopted)
            if self._context.missions != before:
                self._missions_changed()

    def in_force(self, spacecraft: str) -> CalibrationInForce:
        """The calibration that new batches use, and every change of it, newest first."""
        mission = self._context.mission(spacecraft)
        with self._context.reading() as connection:
            history = calibrations.list_adoptions(connection, spacecraft)
        latest = history[0] if history else None
        overridden = (
            latest is not None
            and latest.trackers is not None
            and not mission.retired
            and latest.file != geometry_digest(self.file_of(spacecraft))
        )
        return CalibrationInForce(
            spacecraft=spacecraft,
            mission=mission.digest,
            calibration=None if latest is None or overridden else latest.calibration,
            overridden=overridden,
            history=history,
        )

    def adopt(
        self, id: str, who: str, note: str = "", entry: Entry | None = None
    ) -> CalibrationAdoption:
        """Let new batches be processed with a calibration.

        Raises `WrongState` for one that is not done, is in force already, or knows other
        trackers than the mission.
        """
        with self._context.reading() as connection:
            found = calibrations.read_calibration(connection, known_id(id, "calibration"))
        if found.result is None:
            raise WrongState(f"the calibration is {found.state}")
        names = [each.name for each in found.result.trackers]
        file = self.file_of(found.spacecraft)
        if names != [each.name for each in file.trackers]:
            raise WrongState("the mission has other trackers by now: calibrate anew")
        return self._change(file, found.result.trackers, found.id, who, note, entry)

    def revert(
        self, spacecraft: str, to: str | None, who: str, note: str = "", entry: Entry | None = None
    ) -> CalibrationAdoption:
        """Go back to an earlier adoption of this id, or with None to the mission file.

        Raises `NotFound` for another spacecraft's, `WrongState` where that is in force.
        """
        file = self.file_of(spacecraft)
        if to is None:
            return self._change(file, None, None, who, note, entry)
        with self._context.reading() as connection:
            history = calibrations.list_adoptions(connection, spacecraft)
        for each in history:
            if each.id == to:
                return self._change(file, each.trackers, each.calibration, who, note, entry)
        raise NotFound(f"{spacecraft} has no adoption with the id {shown_value(to)}")

    def file_of(self, spacecraft: str) -> Mission:
        """The settings as the mission file has them, whatever was adopted; the last without one."""
        return self._files.get(spacecraft) or self._context.mission(spacecraft)

    def changed_files(self) -> dict[str, str]:
        """By spacecraft, what the next start would change; raises `BadConfiguration`."""
        settings = self._context.settings
        now = load_missions(*settings.mission_places, shipped=settings.ships_missions)
        found = {}
        for name, mission in self._files.items():
            if name not in now:
                found[name] = "The mission file is gone: the next start retires the spacecraft."
            elif now[name].digest != mission.digest:
                found[name] = "The mission file was changed: it takes effect at the next start."
        return found

    def _change(
        self,
        file: Mission,
        trackers: Sequence[TrackerGeometry] | None,
        calibration: str | None,
        who: str,
        note: str,
        entry: Entry | None,
    ) -> CalibrationAdoption:
        name, moment = file.name, utc_now().text
        mission = file if trackers is None else with_geometry(file, trackers)
        row = {
            "spacecraft": name,
            "adopted": moment,
            "who": who,
            "note": note,
            "calibration_id": calibration,
            "file_digest": geometry_digest(file),
            "mission_digest": mission.digest,
            "trackers": None if trackers is None else msgspec.json.encode(trackers).decode(),
        }
        settings = {
            "digest": mission.digest,
            "spacecraft": name,
            "settings": mission.model_dump_json(),
            "first_used": moment,
        }
        catalog = self._context.sky.catalog
        used = {"digest": catalog.digest, "name": catalog.name, "first_used": moment}

        def change(connection: Connection) -> CalibrationAdoption:
            register(connection, [settings], used)
            id = calibrations.begin_adoption(connection, self._ids.new())
            calibrations.add_adoption(connection, row | {"id": id})
            adopted = calibrations.list_adoptions(connection, name)[0]
            fields = {each: getattr(adopted, each) for each in EVENT_FIELDS}
            events.add_event(connection, "calibration", fields, spacecraft=name)
            return adopted

        self.follow()
        with self._lock:
            if mission_named(self._context.missions, name).digest == mission.digest:
                raise WrongState("these settings are in force already")
            # Results name the settings by their digest, which is recorded before the first.
            adopted = self._context.change_audited(change, entry)
            self._context.missions[name] = mission
            self._missions_changed()
        return adopted
