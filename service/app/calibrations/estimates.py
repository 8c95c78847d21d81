"""Trackers calibrated from the recorded batches of a spacecraft; see `service.calibration`."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from msgspec import structs

from service.acquire import Acquisition
from service.app.context import Context
from service.app.submissions import Submissions
from service.calibration.estimate import (
    Calibration,
    HeldOut,
    calibrate,
    calibrate_with_chosen_degree,
)
from service.calibration.evidence import identified_magnitudes, identified_stars
from service.calibration.magnitudes import (
    MagnitudeCalibration,
    MagnitudeStars,
    calibrate_magnitudes,
    calibrated_settings,
)
from service.calibration.magnitudes import joined as joined_magnitudes
from service.calibration.stars import IdentifiedStars, joined
from service.calibration.unknowns import LARGEST_DEGREE, Model
from service.errors import BadInput, Busy, Fault, Stopping, shown_value
from service.missions.corrections import Magnitudes
from service.missions.mission import Mission
from service.observations.batch import ObservationBatch
from service.storage.queries.pages import ResultFilter
from service.storage.queries.recorded_batch import sample_batches
from service.storage.recording.unsaved_result import LIVE
from service.times import Utc
from service.vectors import Matrix

CALIBRATION_SAMPLE = 2_000
LARGEST_CHOSEN_DEGREE = 5
LONGEST_WAIT_S = 120.0
"""For a thread of the solver, while others keep them all at work."""

Step = Callable[[int, int], object]
"""Told after each batch: how many are done, and of how many."""


@dataclass(frozen=True)
class CalibrationRequest:
    """The unknowns of a calibration, and the batches that it is estimated from.

    Without `trackers` all of the mission's; the first of them is the reference.  Without
    a `degree` the distortion's is chosen, up to `LARGEST_CHOSEN_DEGREE`.
    """

    spacecraft: str
    run: str | None = None
    start: Utc | None = None
    end: Utc | None = None
    trackers: Sequence[str] = ()
    degree: int | None = None
    alignment: bool = True
    scale: bool = True
    time_tag: bool = False
    magnitudes: bool = True
    sample: int = CALIBRATION_SAMPLE

    def require(self, mission: Mission, trackers_field: str = "trackers") -> None:
        """Raise `BadInput` for trackers that the mission has not, and for a useless model."""
        for name in self.trackers:
            mission.tracker(name, trackers_field)
        if self.degree is not None and not 0 <= self.degree <= LARGEST_DEGREE:
            message = f"must be from 0 to {LARGEST_DEGREE}"
            raise BadInput(Fault("degree", message, shown_value(self.degree)))
        if self.degree == 0 and not (self.alignment or self.scale or self.time_tag):
            raise BadInput(Fault("degree", "leaves nothing to estimate", "0"))

    def model(self, degree: int) -> Model:
        """The unknowns, with a distortion of this degree."""
        return Model(self.alignment, self.scale, degree, time_tag=self.time_tag)


@dataclass(frozen=True)
class CalibrationRun:
    """A calibration with the batches it came from.

    `total` batches are in the period, `sampled` were run again and `used` had identified
    stars; `refused` no longer fit the mission.  `tried` is empty where the degree was given.
    """

    mission: Mission
    found: Calibration
    tried: tuple[HeldOut, ...]
    total: int
    sampled: int
    used: int
    refused: int
    first: str | None
    last: str | None
    magnitudes: tuple[MagnitudeCalibration, ...] = ()
    """Of each tracker that was calibrated; empty where they were not asked for."""

    @property
    def calibrated_magnitudes(self) -> dict[str, Magnitudes]:
        """The settings of every tracker's magnitudes, with what was found, by its name."""
        names = [each.name for each in self.found.stars.trackers]
        return calibrated_settings(self.mission.trackers, self.magnitudes, names)

    @property
    def covariance(self) -> Matrix:
        """Of all unknowns, those of magnitudes last: these share nothing with the others."""
        blocks = [self.found.covariance, *(each.covariance for each in self.magnitudes)]
        size = sum(len(each) for each in blocks)
        whole, first = np.zeros((size, size)), 0
        for each in blocks:
            end = first + len(each)
            whole[first:end, first:end] = each
            first = end
        return whole


class Estimator:
    """Estimates calibrations; nothing is recorded and no setting is changed."""

    def __init__(self, context: Context, submissions: Submissions) -> None:
        self._context = context
        self._submissions = submissions

    def estimate(
        self,
        wanted: CalibrationRequest,
        mission: Mission,
        step: Step = lambda done, total: None,
    ) -> CalibrationRun:
        """The calibration that the batches of a run give.

        Batches are identified anew by verified identification, which does not look at the
        tolerances.  Raises `BadInput` where there are too few identified stars.
        """
        names = set(wanted.trackers or (each.name for each in mission.trackers))
        selected = ResultFilter(wanted.run or LIVE, wanted.spacecraft, wanted.start, wanted.end)
        with self._context.reading() as connection:
            drawn = sample_batches(connection, self._context.store.archive, selected, wanted.sample)
        parts: list[IdentifiedStars] = []
        seen: list[MagnitudeStars] = []
        color_bv_mag = self._context.sky.catalog.color_bv_mag
        refused = 0
        for number, batch in enumerate(drawn.batches, 1):
            options = structs.replace(batch.options, identifier="verified", solver="quest")
            try:
                again = self._run_again(structs.replace(batch, options=options), mission)
                stars = identified_stars(again, names)
            except BadInput:
                refused += 1
            else:
                parts += [] if stars is None else [stars]
                magnitudes = identified_magnitudes(again, names, color_bv_mag)
                seen += [] if magnitudes is None else [magnitudes]
            step(number, len(drawn.batches))
        if not parts:
            message = "have no identified stars: there is nothing to calibrate with"
            raise BadInput(Fault("batches", message, f"{len(drawn.batches)} batches"))
        found, tried = _calibrated(joined(parts), wanted)
        counts = drawn.total, len(drawn.batches), len(parts), refused
        used = [each.name for each in found.stars.trackers]
        of_magnitudes: tuple[MagnitudeCalibration, ...] = ()
        if wanted.magnitudes:
            settings = {each.name: each.magnitudes for each in mission.trackers}
            of_magnitudes = calibrate_magnitudes(joined_magnitudes(seen), used, settings)
        ends = drawn.first, drawn.last
        return CalibrationRun(mission, found, tried, *counts, *ends, of_magnitudes)

    def _run_again(self, batch: ObservationBatch, mission: Mission) -> Acquisition:
        """The acquisition of a batch; while the threads are at work on others it waits."""
        until_s = time.monotonic() + LONGEST_WAIT_S
        while True:
            try:
                return self._submissions.ingest.run_again(batch, mission.within_zones)
            except Stopping:
                raise
            except Busy:
                if time.monotonic() > until_s:
                    raise


def _calibrated(
    stars: IdentifiedStars, wanted: CalibrationRequest
) -> tuple[Calibration, tuple[HeldOut, ...]]:
    """With the degree that is wanted, or the best of those that so many stars allow."""
    if wanted.degree is not None:
        return calibrate(stars, wanted.model(wanted.degree)), ()
    for degree in range(LARGEST_CHOSEN_DEGREE, 0, -1):
        try:
            return calibrate_with_chosen_degree(stars, wanted.model(degree))
        except BadInput:
            continue
    return calibrate_with_chosen_degree(stars, wanted.model(0))
