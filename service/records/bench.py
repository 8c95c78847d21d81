"""Where a submission becomes a draft: the missions and the sky that are needed for it."""

import logging
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from queue import Empty, SimpleQueue
from typing import TypeVar

from service.acquire import Acquisition, acquire
from service.errors import AcquisitionError, BadBatch, Busy, Fault, NotFound, shown_value
from service.missions.mission import Mission, mission_named
from service.observe.batch import ObservationBatch
from service.observe.wire import Submission
from service.records.draft import Draft, submission_draft
from service.records.identity import OwnKey, identity_of
from service.records.ids import Ulids
from service.records.writer import RETRY_AFTER_S
from service.sky.view import Sky
from service.times import Utc, utc_now

PROCESSOR_WAIT_S = 5.0
"""A batch takes a millisecond: whoever waits longer stands behind a pile of the worst ones."""

log = logging.getLogger(__name__)

T = TypeVar("T")


class Bench:
    """Computes batches, so many at once as there are processors; any thread may ask."""

    def __init__(self, missions: Mapping[str, Mission], sky: Sky) -> None:
        self.missions = missions
        self.sky = sky
        self.ids = Ulids()
        self.processors = max(2, os.cpu_count() or 1)
        # What waits in it for whoever computes: a queue in C is quicker than a semaphore.
        self._free: SimpleQueue[None] = SimpleQueue()
        for _ in range(self.processors):
            self._free.put(None)

    def draft(self, submission: Submission, key: OwnKey | None = None) -> Draft:
        """The draft of a submission; raises `BadBatch` for what does not fit its mission."""
        received = utc_now()
        return self.draft_of(submission, self.acquired(submission), received, key)

    def acquired(self, submission: Submission) -> Acquisition:
        """What a submission comes to, all but recorded; raises as `draft` does."""
        mission = mission_in_input(self.missions, submission.batch.spacecraft)
        return self.acquire(submission.batch, mission)

    def draft_of(
        self,
        submission: Submission,
        acquisition: Acquisition,
        received: Utc,
        key: OwnKey | None = None,
    ) -> Draft:
        """The draft of what was acquired of a submission that was received at a moment."""
        return submission_draft(
            submission, acquisition, id=self.ids.new(), received=received, key=key
        )

    def drafts_or_errors(
        self, submissions: Sequence[Submission]
    ) -> "list[Draft | AcquisitionError]":
        """The draft of each of many, or what is wrong with that one alone.

        All are acquired before the first draft is made: whoever does one thing many
        times finds its code in the processor's cache.
        """
        received = utc_now()
        acquired = [self._or_error(each, partial(self.acquired, each)) for each in submissions]
        return [
            found
            if isinstance(found, AcquisitionError)
            else self._or_error(each, partial(self.draft_of, each, found, received))
            for each, found in zip(submissions, acquired, strict=True)
        ]

    def _or_error(self, submission: Submission, work: Callable[[], T]) -> "T | AcquisitionError":
        try:
            return work()
        except Busy:
            # Says nothing about the batch: the whole chunk may come again.
            raise
        except AcquisitionError as error:
            return error
        except Exception:
            # A fault of ours in one batch: the others are recorded all the same.
            identity = identity_of(submission.batch)
            run = {"run": submission.batch.run}
            log.exception("%s, run %s, batch %s failed", *identity, extra=run)
            return AcquisitionError("the fault is on the service's side; it is logged")

    def acquire(self, batch: ObservationBatch, mission: Mission) -> Acquisition:
        """`acquire`, when a processor is free; raises `Busy` where none is for long."""
        try:
            self._free.get(timeout=PROCESSOR_WAIT_S)
        except Empty:
            raise Busy("every processor is at work on other batches", RETRY_AFTER_S) from None
        try:
            return acquire(batch, mission, self.sky)
        finally:
            self._free.put(None)


def mission_in_input(missions: Mapping[str, Mission], name: str) -> Mission:
    """The mission that an input names; raises `BadBatch` naming the field where there is none."""
    try:
        return mission_named(missions, name)
    except NotFound:
        there_are = f"there is no such spacecraft; there are {', '.join(sorted(missions))}"
        raise BadBatch(Fault("spacecraft", there_are, shown_value(name))) from None
