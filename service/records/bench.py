"""Where a submission becomes a draft: the missions and the sky that are needed for it."""

import logging
import os
import threading
from collections.abc import Mapping

from service.acquire import Acquisition, acquire
from service.errors import AcquisitionError, BadBatch, Busy, Fault, NotFound, shown_value
from service.missions.mission import Mission, mission_named
from service.observe.batch import ObservationBatch
from service.observe.wire import Submission
from service.records.draft import Draft, submission_draft
from service.records.identity import identity_of
from service.records.ids import Ulids
from service.records.writer import RETRY_AFTER_S
from service.sky.view import Sky
from service.times import utc_now

PROCESSOR_WAIT_S = 5.0
"""A batch takes a millisecond: whoever waits longer stands behind a pile of the worst ones."""

log = logging.getLogger(__name__)


class Bench:
    """Computes batches, so many at once as there are processors; any thread may ask."""

    def __init__(self, missions: Mapping[str, Mission], sky: Sky) -> None:
        self.missions = missions
        self.sky = sky
        self.ids = Ulids()
        self.processors = max(2, os.cpu_count() or 1)
        self._free = threading.BoundedSemaphore(self.processors)

    def draft(self, submission: Submission, key: str | None = None) -> Draft:
        """The draft of a submission; raises `BadBatch` for what does not fit its mission."""
        received = utc_now()
        mission = mission_in_input(self.missions, submission.batch.spacecraft)
        acquisition = self.acquire(submission.batch, mission)
        return submission_draft(
            submission, acquisition, id=self.ids.new(), received=received, key=key
        )

    def draft_or_error(self, submission: Submission) -> Draft | AcquisitionError:
        """The draft of one submission of many, or what is wrong with this one alone."""
        try:
            return self.draft(submission)
        except Busy:
            # Says nothing about the batch: the whole chunk may come again.
            raise
        except AcquisitionError as error:
            return error
        except Exception:
            # A fault of ours in one batch: the others are recorded all the same.
            log.exception("%s, run %s, batch %s failed", *identity_of(submission.batch))
            return AcquisitionError("the fault is on the service's side; it is logged")

    def acquire(self, batch: ObservationBatch, mission: Mission) -> Acquisition:
        """`acquire`, when a processor is free; raises `Busy` where none is for long."""
        if not self._free.acquire(timeout=PROCESSOR_WAIT_S):
            raise Busy("every processor is at work on other batches", RETRY_AFTER_S)
        try:
            return acquire(batch, mission, self.sky)
        finally:
            self._free.release()


def mission_in_input(missions: Mapping[str, Mission], name: str) -> Mission:
    """The mission that an input names; raises `BadBatch` naming the field where there is none."""
    try:
        return mission_named(missions, name)
    except NotFound:
        there_are = f"there is no such spacecraft; there are {', '.join(sorted(missions))}"
        raise BadBatch(Fault("spacecraft", there_are, shown_value(name))) from None
