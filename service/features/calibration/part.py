"""Calibrations in the service: start, computation in the background, recording, adoption."""

import logging
import math
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict

import msgspec
from sqlalchemy import Connection
from sqlalchemy.exc import SQLAlchemyError

from service.access import Entry
from service.app.adoptions import CalibrationAdoptions
from service.app.context import Context, known_id
from service.app.factory import App
from service.app.results import COMPARE_SAMPLE, Comparisons, Stretch
from service.contract.base import Page
from service.contract.calibration import CalibrationAdoption
from service.contract.runs import Comparison
from service.errors import AcquisitionError, Busy, Stopping, WrongState
from service.features.calibration import records
from service.features.calibration.estimates import (
    CalibrationRequest,
    CalibrationRun,
    Estimator,
    Step,
    result_of,
)
from service.features.calibration.records import (
    Calibration,
    CalibrationSummary,
    interrupt_calibrations,
    unfinished_calibrations,
)
from service.ingest.missions_in_force import with_geometry
from service.ingest.submit import SubmissionService
from service.missions.mission import Mission, mission_named
from service.observations.schema import LIVE
from service.storage.recording.ids import Ulids
from service.storage.sql.columns import Row
from service.times import Utc, utc_now

log = logging.getLogger(__name__)


class Calibrations:
    """Starts, records, reads and tries calibrations; settings change only by adoption."""

    def __init__(
        self,
        context: Context,
        submissions: SubmissionService,
        comparisons: Comparisons,
        adoptions: CalibrationAdoptions,
    ) -> None:
        self._context = context
        self._adoptions = adoptions
        self._submissions = submissions
        self._comparisons = comparisons
        self._estimator = Estimator(context, submissions)
        self._ids = Ulids()
        self._background = BackgroundCalibrations(context, self._estimator)

    def of_spacecraft(
        self, wanted: CalibrationRequest, step: Step = lambda done, total: None
    ) -> CalibrationRun:
        """Calibrate a mission from batches of a run without recording the result.

        Raises `BadInput` if there are too few identified stars.
        """
        mission = mission_named(self._context.missions, wanted.spacecraft)
        return self._estimator.estimate(wanted, mission, step)

    def record(self, wanted: CalibrationRequest, found: CalibrationRun, who: str) -> Calibration:
        """Record a calibration that is already computed."""
        id = self._ids.new()
        row = self._row(id, wanted, found.mission, who)
        changes = found_columns(found) | {"done": found.sampled, "total": found.sampled}

        def change(connection: Connection) -> None:
            records.add_calibration(connection, row)
            records.change_calibration(connection, id, changes)

        self._context.change(change)
        return self.get(id)

    def start(
        self, wanted: CalibrationRequest, who: str, entry: Entry | None = None
    ) -> Calibration:
        """Record a calibration as started, and queue its computation in a background thread.

        Raises `BadInput` for trackers that the mission lacks, `Busy` if too many calibrations wait.
        """
        mission = mission_named(self._context.missions, wanted.spacecraft)
        wanted.require(mission)
        self._submissions.require_kernels()
        id = self._ids.new()
        row = self._row(id, wanted, mission, who)

        def begin() -> None:
            self._context.change_audited(
                lambda connection: records.add_calibration(connection, row), entry
            )

        self._background.compute(id, wanted, mission, begin)
        return self.get(id)

    def get(self, id: str) -> Calibration:
        """Return the calibration with an id."""
        with self._context.reading() as connection:
            return records.read_calibration(connection, known_id(id, "calibration"))

    def page(
        self, spacecraft: str | None = None, limit: int = 100, cursor: str | None = None
    ) -> Page[CalibrationSummary]:
        """One page of calibrations, newest first."""
        if spacecraft is not None:
            self._context.mission(spacecraft)
        with self._context.reading() as connection:
            return records.list_calibrations(connection, spacecraft, limit, cursor)

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
        """Process recorded batches with the settings in force (`a`) and with a calibration (`b`).

        Without a `run` the batches of the calibration's run are taken.  The comparison is not
        recorded.
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

    def adopt(
        self, id: str, who: str, note: str = "", entry: Entry | None = None
    ) -> CalibrationAdoption:
        """Process new batches with a calibration from now on.

        Raises `WrongState` for a calibration that is not done, is in force already, or has other
        trackers than the mission.
        """
        found = self.get(id)
        if found.result is None:
            raise WrongState(f"the calibration is {found.state}")
        trackers = found.result.trackers
        return self._adoptions.adopt(found.spacecraft, trackers, found.id, who, note, entry)

    def interrupt(self) -> None:
        """Mark calibrations that a stopped process left unfinished as interrupted."""
        now = utc_now().text
        self._context.change(lambda connection: interrupt_calibrations(connection, now))

    def close(self) -> None:
        """Stop the calibration that is being computed, and drop the queued ones."""
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
    """A thread that computes queued calibrations and records their results."""

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

        Raises `Busy` if too many wait, `Stopping` while the service closes.
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
        """Stop the calibration that is being computed, and drop the queued ones."""
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
            # The calibration must end after any error: a client waits for its state.
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
            # Later another service, or the next start, records the calibration as interrupted.
            if self._closed.wait(SAVED_EVERY_S):
                return

    def _over(self, id: str) -> None:
        with self._lock:
            self._unfinished -= 1
            self._context.store.at_work.discard(id)


class _Progress:
    """Records the progress of a calibration in the database, at most every half second."""

    def __init__(self, context: Context, id: str, is_closing: Callable[[], bool]) -> None:
        self._context, self._id, self._is_closing = context, id, is_closing
        self._next_s = 0.0

    def step(self, done: int, total: int) -> None:
        """Record progress; raises `Stopping` if the service stops."""
        if self._is_closing():
            raise Stopping("the service is stopping")
        now_s = time.monotonic()
        if now_s >= self._next_s or done == total:
            self._next_s = now_s + SAVED_EVERY_S
            self.save({"state": "running", "ended": None, "done": done, "total": total})

    def save(self, changes: Row) -> None:
        self._context.change(
            lambda connection: records.change_calibration(connection, self._id, changes)
        )


def found_columns(run: CalibrationRun) -> Row:
    """Database columns of a completed calibration."""
    return {
        "state": "done",
        "ended": utc_now().text,
        "result": msgspec.json.encode(result_of(run)).decode(),
        "covariance": msgspec.json.encode(run.covariance.tolist()).decode(),
    }


def open_part(app: App) -> Calibrations:
    """Create the calibration service of an open app; ends calibrations of a stopped service."""
    app.single_projector.ends_left_work(unfinished_calibrations, interrupt_calibrations)
    return Calibrations(app.context, app.submissions, app.comparisons, app.adoptions)
