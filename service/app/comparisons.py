"""Two sets of options over the same recorded batches."""

import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from service.acquire.choices import refuse_idle_options
from service.advice.advice import RunAgain
from service.app.context import Context
from service.app.submissions import Submissions
from service.errors import Busy
from service.ingest.compare_options import ComparedSample, Pair, compare
from service.missions.mission import Mission, mission_named
from service.observations.schema import OptionsIn
from service.storage.models.compare import Comparison
from service.storage.queries.pages import ResultFilter
from service.storage.queries.recorded_batch import batch_with_options, sample_batches
from service.storage.recording.unsaved_result import LIVE
from service.storage.sql.columns import Row
from service.times import Utc

COMPARE_SAMPLE, COMPARE_RETRY_S = 100, 10


@dataclass(frozen=True)
class Stretch:
    """The batches to compare with: at most `sample` of a period."""

    spacecraft: str
    run: str | None = None
    start: Utc | None = None
    end: Utc | None = None
    sample: int = COMPARE_SAMPLE


class Comparisons:
    """Compares sets of options, or settings, for one caller at a time."""

    def __init__(self, context: Context, submissions: Submissions) -> None:
        self._context = context
        self._submissions = submissions
        self._lock = threading.Lock()

    def of_options(
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
    ) -> Comparison:
        """Run recorded batches again with two sets of options and show where they differ.

        Raises `BadBatch` for a setting that changes nothing for any of them.
        Of a stretch at most `sample` batches, fewer where `limit_s` seconds run
        out.  Settings that the options do not name stay as they were for a batch.  Raises
        `Busy` while the service is computing another comparison.
        """
        mission = mission_named(self._context.missions, name)
        again = self._submissions.ingest.run_again

        def pair_of(row: Row) -> Pair:
            own = batch_with_options(row["input"], row["options"])
            if own.measurement is not None:
                # Such a batch has no stars to identify: options do not change its answer.
                return Pair(row["id"], own, own)
            options = (batch_with_options(row["input"], row["options"], each) for each in (a, b))
            return Pair(row["id"], *options)

        def check(pairs: Sequence[Pair]) -> None:
            of_stars = [each for each in pairs if each.a.measurement is None]
            refuse_idle_options(a, [each.a for each in of_stars], mission, "a")
            refuse_idle_options(b, [each.b for each in of_stars], mission, "b")

        stretch = Stretch(name, run, start, end, sample)
        told = tuple(each.model_dump(mode="json", exclude_none=True) for each in (a, b))
        return self._compared(stretch, pair_of, (again, again), (told[0], told[1]), limit_s, check)

    def of_missions(
        self, stretch: Stretch, a: Mission, b: Mission, limit_s: float = math.inf
    ) -> Comparison:
        """The same with two settings of the mission, and every batch's own options."""

        def pair_of(row: Row) -> Pair:
            batch = batch_with_options(row["input"], row["options"])
            return Pair(row["id"], batch, batch)

        again = self._submissions.ingest.run_again
        sides = partial(again, mission=a), partial(again, mission=b)
        return self._compared(stretch, pair_of, sides, ({}, {}), limit_s)

    def _compared(
        self,
        stretch: Stretch,
        pair_of: Callable[[Row], Pair],
        sides: tuple[RunAgain, RunAgain],
        options: tuple[Row, Row],
        limit_s: float,
        check: Callable[[Sequence[Pair]], None] = lambda pairs: None,
    ) -> Comparison:
        if not self._lock.acquire(blocking=False):
            raise Busy("the service is computing another comparison", COMPARE_RETRY_S)
        name, run = stretch.spacecraft, stretch.run or LIVE
        try:
            with self._context.reading() as connection:
                drawn = sample_batches(
                    connection,
                    self._context.store.archive,
                    ResultFilter(run, name, stretch.start, stretch.end),
                    stretch.sample,
                )
            pairs = [pair_of(row) for row in drawn.rows]
            check(pairs)
            found, cut_short = compare(pairs, sides, limit_s)
        finally:
            self._lock.release()
        sample = ComparedSample(name, run, drawn.first, drawn.last, drawn.total, len(pairs))
        return found.record(sample, options, cut_short=cut_short)
