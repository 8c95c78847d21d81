"""Trackers calibrated from the recorded batches of a spacecraft; see `service.calibration`."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from msgspec import structs

from service.app.context import Context
from service.app.submissions import Submissions
from service.calibration.estimate import Calibration, calibrate
from service.calibration.evidence import identified_stars
from service.calibration.held_out import HeldOut, calibrate_with_chosen_degree
from service.calibration.stars import IdentifiedStars, joined
from service.calibration.unknowns import Model
from service.errors import BadInput, Fault
from service.missions.mission import mission_named
from service.storage.queries.future_dated import LIVE
from service.storage.queries.pages import ResultFilter
from service.storage.queries.recorded_batch import sample_batches
from service.times import Utc

CALIBRATION_SAMPLE = 2_000
LARGEST_CHOSEN_DEGREE = 5


@dataclass(frozen=True)
class CalibrationRequest:
    """What is to be calibrated, and with which batches.

    Without `trackers` all of the mission's; the first of them is the reference.  Without
    a `degree` the distortion's is chosen, up to `LARGEST_CHOSEN_DEGREE`.
    """

    spacecraft: str
    run: str | None = None
    start: Utc | None = None
    end: Utc | None = None
    trackers: Sequence[str] = ()
    degree: int | None = None
    time_tag: bool = False
    sample: int = CALIBRATION_SAMPLE


@dataclass(frozen=True)
class CalibrationRun:
    """A calibration with the batches it came from.

    `total` batches are in the period, `sampled` were run again and `used` had identified
    stars; `refused` no longer fit the mission.  `tried` is empty where the degree was given.
    """

    found: Calibration
    tried: tuple[HeldOut, ...]
    total: int
    sampled: int
    used: int
    refused: int
    first: str | None
    last: str | None


class CalibrationService:
    """Estimates calibrations; nothing is recorded and no setting is changed."""

    def __init__(self, context: Context, submissions: Submissions) -> None:
        self._context = context
        self._submissions = submissions

    def of_spacecraft(
        self, wanted: CalibrationRequest, step: Callable[[], object] = lambda: None
    ) -> CalibrationRun:
        """The calibration that the batches of a run give; `step` is called after each batch.

        Batches are identified anew by verified identification, which does not look at the
        tolerances.  Raises `BadInput` for a tracker that the mission has not, and where
        there are too few identified stars.
        """
        mission = mission_named(self._context.missions, wanted.spacecraft)
        for name in wanted.trackers:
            mission.tracker(name, "--tracker")
        names = set(wanted.trackers or (each.name for each in mission.trackers))
        selected = ResultFilter(wanted.run or LIVE, wanted.spacecraft, wanted.start, wanted.end)
        with self._context.reading() as connection:
            drawn = sample_batches(connection, self._context.store.archive, selected, wanted.sample)
        run_again = partial(self._submissions.ingest.run_again, mission=mission.within_zones)
        parts: list[IdentifiedStars] = []
        refused = 0
        for batch in drawn.batches:
            options = structs.replace(batch.options, identifier="verified", solver="quest")
            try:
                stars = identified_stars(run_again(structs.replace(batch, options=options)), names)
            except BadInput:
                refused += 1
            else:
                parts += [] if stars is None else [stars]
            step()
        if not parts:
            message = "have no identified stars: there is nothing to calibrate with"
            raise BadInput(Fault("batches", message, f"{len(drawn.batches)} batches"))
        found, tried = _calibrated(joined(parts), wanted)
        counts = drawn.total, len(drawn.batches), len(parts), refused
        return CalibrationRun(found, tried, *counts, drawn.first, drawn.last)


def _calibrated(
    stars: IdentifiedStars, wanted: CalibrationRequest
) -> tuple[Calibration, tuple[HeldOut, ...]]:
    """With the degree that is wanted, or the best of those that so many stars allow."""
    if wanted.degree is not None:
        return calibrate(stars, Model(degree=wanted.degree, time_tag=wanted.time_tag)), ()
    for degree in range(LARGEST_CHOSEN_DEGREE, 0, -1):
        try:
            return calibrate_with_chosen_degree(
                stars, Model(degree=degree, time_tag=wanted.time_tag)
            )
        except BadInput:
            continue
    return calibrate_with_chosen_degree(stars, Model(degree=0, time_tag=wanted.time_tag))
