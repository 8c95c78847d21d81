"""Recorded results: one, a page of them, and a batch again with other options."""

from service.access.audit import Entry
from service.acquire.choices import Choices, choices_of
from service.app.context import ALL_RUNS, Context, known_id
from service.app.submissions import Submissions
from service.errors import NotFound
from service.ingest.solver_pool import mission_in_input
from service.observations.schema import OptionsIn
from service.storage.models.answers import Answer, Neighbours, Result, Summary
from service.storage.models.base import Page
from service.storage.models.charts import PeriodStars, StarField
from service.storage.queries import results
from service.storage.queries.pages import ResultFilter
from service.storage.queries.period import period_stars, sample_period
from service.storage.queries.recorded_batch import recorded_batch, recorded_mission
from service.storage.queries.results import OutcomeName, StatusName, here_of, neighbours
from service.storage.queries.star_field import star_field_of, tracker_comparison
from service.storage.queries.time_buckets import BucketFilter
from service.storage.recording.ids import is_ulid
from service.storage.recording.unsaved_result import LIVE, Answered
from service.storage.sql.columns import Row
from service.times import Utc, utc_now


class Results:
    """Reads recorded results."""

    def __init__(self, context: Context, submissions: Submissions) -> None:
        self._context = context
        self._submissions = submissions

    def get(self, id: str) -> Result:
        """One result: `answer`, `input`, `current`, `parent`, and the `what_ifs` of its batch."""
        with self._context.reading_batch(known_id(id, "batch")) as (connection, archived):
            return results.read_record(connection, id, archived=archived)

    def latest(self, spacecraft: str, run: str | None = None) -> Result:
        """The newest current result of a spacecraft in a run, by batch time; as `get`.

        A live batch that is dated far in the future counts only where there is no other.
        """
        run = run or LIVE
        self._context.mission(spacecraft)
        selected = ResultFilter(run, spacecraft)
        with self._context.reading_record() as connection:
            id = results.newest_id(connection, selected, utc_now())
            if id is None:
                raise NotFound(f"{spacecraft} has no batch in the run {run}")
            return results.read_record(connection, id)

    def page(
        self,
        *,
        spacecraft: str | None = None,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        outcome: OutcomeName | None = None,
        status: StatusName | None = None,
        batch: str | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[Summary]:
        """Current results, newest batch time first; see `results.list_batches`.

        The run `*` stands for every run, live batches included.  `batch` is a batch id, of
        which there is one in each run of a spacecraft.
        Raises `BadBatch` for a spacecraft that has neither batches nor a mission.
        """
        stretch = ResultFilter(None if run == ALL_RUNS else run or LIVE, spacecraft, start, end)
        with self._context.reading_record() as connection:
            page = results.list_batches(
                connection,
                self._context.store.archive,
                stretch,
                outcome=outcome,
                status=status,
                batch=batch,
                limit=limit,
                cursor=cursor,
            )
        if spacecraft is not None and not page.items and page.next_cursor is None:
            # A misspelt name must not look like a spacecraft without data.
            mission_in_input(self._context.known, spacecraft)
        return page

    def neighbours(self, id: str) -> Neighbours:
        """The results before and after one in time: `earlier` and `later`, or None."""
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            here = here_of(connection, id)
        with self._context.reading_record() as connection:
            return neighbours(connection, self._context.store.archive, here)

    def star_field(self, id: str, answer: Answer | None = None) -> StarField:
        """The data of the chart of a result's stars; see `star_field.star_field_of`.

        An `answer` in place of the recorded one, such as that of a what-if, is
        drawn over the same batch.
        """
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            batch, recorded = recorded_batch(connection, id)
            answer = answer or recorded
            mission = recorded_mission(connection, answer.provenance.mission)
        return star_field_of(batch, mission, self._context.sky, answer)

    def trackers(self, id: str, answer: Answer | None = None) -> list[Row]:
        """The trackers of a result side by side; see `tracker_comparison`.

        Empty for a result of one tracker.  An `answer` in place of the recorded one, such
        as that of a what-if, is compared over the same batch.
        """
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            batch, recorded = recorded_batch(connection, id)
            answer = answer or recorded
            if len(answer.observations) < 2:
                return []
            mission = recorded_mission(connection, answer.provenance.mission)
        return tracker_comparison(batch, mission, self._context.sky, answer)

    def period(
        self, spacecraft: str, *, run: str | None = None, start: Utc, end: Utc
    ) -> PeriodStars:
        """The stars and attitudes of a period, of some batches where there are many.

        See `period.sample.sample_period`, which also bounds what is read.
        """
        self._context.mission(spacecraft)
        span = BucketFilter(spacecraft, run or LIVE, start, end)
        with self._context.reading() as connection:
            sample = sample_period(connection, span)
        return period_stars(sample, self._context.sky)

    def settings_for(self, id: str) -> Choices:
        """The settings that a what-if of a result changes."""
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            batch, _ = recorded_batch(connection, id)
        return choices_of(batch, self._context.mission(batch.spacecraft))

    def spacecraft_of(self, id: str) -> str | None:
        """The spacecraft that a recorded result belongs to; None where there is no such result."""
        if not is_ulid(id):
            return None
        with self._context.reading_record() as connection:
            return results.spacecraft_of(connection, id)

    def what_if(
        self,
        id: str,
        options: OptionsIn,
        record: bool = False,
        adopt: bool = False,
        entry: Entry | None = None,
    ) -> Answered:
        """Process a recorded batch again; `options` replace those of the result that they name.

        The answer names its parent.  It is kept only where `record` or `adopt`
        asks for that; adopted, it becomes what lists, histories and rates show.
        `entry` goes to the audit list with it.
        """
        known = known_id(id, "batch")
        self._submissions.require_kernels()
        return self._submissions.ingest.what_if(
            known, options, record=record, adopt=adopt, entry=entry
        )
