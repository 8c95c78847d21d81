"""Recorded results: one, a page of them, and a batch again with other options."""

from service.access.audit import Entry
from service.acquire.choices import Choices, choices_of
from service.app.context import ALL_RUNS, Context, known_id
from service.app.submissions import Submissions
from service.ingest.solver_pool import mission_in_input
from service.missions.mission import mission_named
from service.observations.schema import OptionsIn
from service.storage.models.answers import Answer, Neighbours, Result, Summary
from service.storage.models.base import Page
from service.storage.models.star_field import StarField
from service.storage.queries import results
from service.storage.queries.future_dated import LIVE
from service.storage.queries.neighbours import neighbours
from service.storage.queries.pages import ResultFilter
from service.storage.queries.recorded_batch import recorded_batch, recorded_mission
from service.storage.queries.results import OutcomeName, StatusName
from service.storage.queries.star_field import star_field_of
from service.storage.recording.ids import is_ulid
from service.storage.recording.unsaved_result import Answered
from service.times import Utc


class Results:
    """Reads recorded results."""

    def __init__(self, context: Context, submissions: Submissions) -> None:
        self._context = context
        self._submissions = submissions

    def get(self, id: str) -> Result:
        """One result: `answer`, `input`, `current`, `parent`, and the `what_ifs` of its batch."""
        with self._context.reading() as connection:
            return results.read_record(connection, known_id(id, "batch"))

    def page(
        self,
        *,
        spacecraft: str | None = None,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        outcome: OutcomeName | None = None,
        status: StatusName | None = None,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[Summary]:
        """Current results, newest batch time first; see `results.list_batches`.

        The run `*` stands for every run, live batches included.
        Raises `BadBatch` for a spacecraft that has neither batches nor a mission.
        """
        stretch = ResultFilter(None if run == ALL_RUNS else run or LIVE, spacecraft, start, end)
        with self._context.reading() as connection:
            page = results.list_batches(
                connection, stretch, outcome=outcome, status=status, limit=limit, cursor=cursor
            )
        if spacecraft is not None and not page.items:
            # A misspelt name must not look like a spacecraft without data.
            mission_in_input(self._context.missions, spacecraft)
        return page

    def neighbours(self, id: str) -> Neighbours:
        """The results before and after one in time: `earlier` and `later`, or None."""
        with self._context.reading() as connection:
            return neighbours(connection, known_id(id, "batch"))

    def star_field(self, id: str, answer: Answer | None = None) -> StarField:
        """The data of the chart of a result's stars; see `star_field.star_field_of`.

        An `answer` in place of the recorded one, such as that of a what-if, is
        drawn over the same batch.
        """
        with self._context.reading() as connection:
            batch, recorded = recorded_batch(connection, known_id(id, "batch"))
            answer = answer or recorded
            mission = recorded_mission(connection, answer.provenance.mission)
        return star_field_of(batch, mission, self._context.sky, answer)

    def settings_for(self, id: str) -> Choices:
        """The settings that a what-if of a result changes."""
        with self._context.reading() as connection:
            batch, _ = recorded_batch(connection, known_id(id, "batch"))
        return choices_of(batch, mission_named(self._context.missions, batch.spacecraft))

    def spacecraft_of(self, id: str) -> str | None:
        """The spacecraft that a recorded result belongs to; None where there is no such result."""
        if not is_ulid(id):
            return None
        with self._context.reading() as connection:
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
