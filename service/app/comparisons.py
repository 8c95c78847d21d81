"""Two sets of options over the same recorded batches."""

import math
import threading

from service.app.context import Context
from service.app.submissions import Submissions
from service.errors import Busy
from service.ingest.compare_options import ComparedSample, Pair, compare
from service.missions.mission import mission_named
from service.observations.schema import OptionsIn
from service.storage.models.compare import Comparison
from service.storage.queries.future_dated import LIVE
from service.storage.queries.pages import ResultFilter
from service.storage.queries.recorded_batch import batch_with_options, sample_batches
from service.times import Utc

COMPARE_SAMPLE, COMPARE_RETRY_S = 100, 10


class Comparisons:
    """Compares sets of options, for one caller at a time."""

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

        Of a stretch at most `sample` batches, fewer where `limit_s` seconds run
        out.  Settings that the options do not name stay as they were for a batch.  Raises
        `Busy` while the service is computing another comparison.
        """
        mission_named(self._context.missions, name)
        if not self._lock.acquire(blocking=False):
            raise Busy("the service is computing another comparison", COMPARE_RETRY_S)
        try:
            with self._context.reading() as connection:
                drawn = sample_batches(
                    connection,
                    self._context.store.archive,
                    ResultFilter(run or LIVE, name, start, end),
                    sample,
                )
            pairs = [
                Pair(
                    row["id"],
                    *(batch_with_options(row["input"], row["options"], o) for o in (a, b)),
                )
                for row in drawn.rows
            ]
            found, cut_short = compare(pairs, self._submissions.ingest.run_again, limit_s)
        finally:
            self._lock.release()
        run_name = run or LIVE
        sample_of = ComparedSample(name, run_name, drawn.first, drawn.last, drawn.total, len(pairs))
        options = tuple(each.model_dump(mode="json", exclude_none=True) for each in (a, b))
        return found.record(sample_of, (options[0], options[1]), cut_short=cut_short)
