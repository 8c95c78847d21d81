"""Calibrations computed one after the other, beside other work."""

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import msgspec
from sqlalchemy.exc import SQLAlchemyError

from service.app.calibrations.estimates import CalibrationRequest, CalibrationRun, Estimator
from service.app.calibrations.findings import result_of
from service.app.context import Context
from service.errors import AcquisitionError, Busy, Stopping
from service.missions.mission import Mission
from service.storage import calibrations
from service.storage.sql.columns import Row
from service.times import utc_now

MOST_WAITING = 4
SAVED_EVERY_S = 0.5

log = logging.getLogger(__name__)


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
