"""Calibrations: begun, computed beside other work, recorded, tried and read."""

import math
from dataclasses import asdict

import msgspec
from sqlalchemy import Connection

from service.access.audit import Entry
from service.app.calibrations.background import BackgroundCalibrations, found_columns
from service.app.calibrations.estimates import CalibrationRequest, CalibrationRun, Estimator, Step
from service.app.calibrations.geometry import with_geometry
from service.app.comparisons import COMPARE_SAMPLE, Comparisons, Stretch
from service.app.context import Context, known_id
from service.app.submissions import Submissions
from service.errors import WrongState
from service.missions.mission import Mission, mission_named
from service.storage import calibrations
from service.storage.calibrations import Calibration, CalibrationSummary
from service.storage.models.base import Page
from service.storage.models.compare import Comparison
from service.storage.recording.ids import Ulids
from service.storage.recording.unsaved_result import LIVE
from service.storage.sql.columns import Row
from service.times import Utc, utc_now


class CalibrationService:
    """Estimates and records calibrations; no setting is changed."""

    def __init__(
        self, context: Context, submissions: Submissions, comparisons: Comparisons
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
