"""Advice on a mission's settings from recorded batches; see `service.advice`."""

import math
import threading
import time
from collections.abc import Callable
from functools import partial

from service.acquire.choices import idle_reason
from service.advice.advice import WorkLimit, advise
from service.advice.innovation_statements import innovation_findings
from service.advice.innovations import innovation_noise
from service.advice.zone_statements import zone_statements
from service.app.advice_record import advice_record
from service.app.context import Context
from service.app.submissions import Submissions
from service.app.zones import Zones
from service.errors import BadInput, Busy, Fault
from service.observations.schema import TolerancesIn
from service.storage.grades.period import latest_innovations
from service.storage.models.advice import Advice
from service.storage.queries.pages import ResultFilter
from service.storage.queries.recorded_batch import sample_batches
from service.storage.recording.unsaved_result import LIVE
from service.times import Utc

ADVICE_SAMPLE = 200
"""Gives a sigma to about five percent; these batches are processed again in seconds."""
ADVICE_RETRY_S = 10
NO_TOLERANCES = TolerancesIn()


class AdviceService:
    """Computes advice, for one caller at a time."""

    def __init__(self, context: Context, submissions: Submissions, zones: Zones) -> None:
        self._context = context
        self._zones = zones
        self._submissions = submissions
        self._lock = threading.Lock()

    def of_spacecraft(
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
    ) -> Advice:
        """Advice on a mission's settings from the batches of a run; see `service.advice`.

        Of the batches at most `sample` are run again, fewer where `limit_s`
        seconds run out; `step` is called after each, twice a batch.  `tolerances`
        are tried as well.  Raises `Busy` while the service is computing other advice.
        """
        mission = self._context.mission(name)
        own = tolerances.model_dump(exclude_none=True)
        for key in own:
            reason = idle_reason(key, "starid", mission.tests, mission.zone)
            if reason is not None:
                raise BadInput(Fault(f"tolerance {key}", f"{reason} and would change nothing"))
        if not self._lock.acquire(blocking=False):
            raise Busy("the service is computing other advice", ADVICE_RETRY_S)
        try:
            with self._context.reading() as connection:
                selected = ResultFilter(run or LIVE, name, start, end)
                archive = self._context.store.archive
                drawn = sample_batches(connection, archive, selected, sample)
                met = latest_innovations(connection, selected, of_gyro=True)
            began = time.monotonic()
            pace = WorkLimit(lambda share: time.monotonic() - began < share * limit_s, step)
            # Without the search of the whole sky, which would hide faults of the settings.
            run_again = partial(self._submissions.ingest.run_again, mission=mission.within_zones)
            run_freely = partial(self._submissions.ingest.run_again, mission=mission)
            findings = advise(mission, drawn.batches, run_again, run_freely, own, pace)
            zone = zone_statements(mission, *self._zones.advised_size(name, run))
        finally:
            self._lock.release()
        noise = innovation_findings(innovation_noise(met), mission, findings.noise)
        return advice_record(name, run or LIVE, drawn, findings, zone, noise)
