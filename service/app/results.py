"""Recorded results: single ones, pages of lists, what-ifs, and comparisons of options."""

import json
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial

from msgspec import structs

from service.access import Entry
from service.acquire.choices import Choices, choices_of, refuse_idle_options
from service.app.context import ALL_RUNS, Context, known_id
from service.contract.answers import Answer, Neighbours, Replacement, Result, Signature, Summary
from service.contract.base import Page
from service.contract.runs import Comparison
from service.errors import Busy, NotFound
from service.ingest.compare_options import ComparedSample, Pair, RunManyAgain, compare
from service.ingest.solver_pool import mission_in_input
from service.ingest.submit import SubmissionService
from service.missions.mission import Mission, mission_named
from service.observations.schema import LIVE, OptionsIn, submission_from_json
from service.storage.queries import results
from service.storage.queries.pages import ResultFilter
from service.storage.queries.period import PeriodStars, period_stars, sample_period
from service.storage.queries.results import (
    OutcomeName,
    ResultPlace,
    StatusName,
    batch_with_options,
    merged_options,
    neighbours,
    place_of,
    recorded_batch,
    recorded_mission,
    sample_batches,
)
from service.storage.queries.star_field import StarField, star_field_of, tracker_comparison
from service.storage.queries.time_buckets import BucketFilter
from service.storage.recording.ids import is_ulid
from service.storage.recording.signatures import signatures_of
from service.storage.recording.unsaved_result import Answered
from service.storage.sql.columns import Row
from service.times import Utc, utc_now

MOST_ADOPTED = 20


class Results:
    """Service that reads recorded results, their charts, and their what-ifs."""

    def __init__(self, context: Context, submissions: SubmissionService) -> None:
        self._context = context
        self._submissions = submissions

    def get(self, id: str) -> Result:
        """Read a result with its answer and input, and the what-ifs of its batch."""
        with self._context.reading_batch(known_id(id, "batch")) as (connection, archived):
            record = results.read_record(connection, id, archived=archived)
            current = None if record.current else results.current_of(connection, id)
        if record.parent is None and current is None:
            return record
        replacing = {} if current is None else {current.id: current.parent_id}
        signatures = self.signatures({id: record.parent} | replacing)
        if record.parent is not None:
            record = structs.replace(record, signature=signatures.get(id))
        if current is not None and current.parent_id is not None:
            replaced_by = Replacement(result=current.id, signature=signatures.get(current.id))
            record = structs.replace(record, replaced_by=replaced_by)
        return record

    def signatures(self, parents: Mapping[str, str | None]) -> dict[str, Signature]:
        """Signatures on what-ifs by id, from the ids of their parents; see `signatures_of`."""
        what_ifs = {id: parent for id, parent in parents.items() if parent is not None}
        if not what_ifs:
            return {}
        with self._context.reading() as connection:
            return signatures_of(connection, what_ifs)

    def adopted(
        self, spacecraft: str, run: str, start: Utc, end: Utc
    ) -> list[tuple[Row, Signature | None]]:
        """Adopted what-ifs of a period, the last adopted first, with their signatures.

        See `results.adopted_what_ifs` for the columns; at most `MOST_ADOPTED` are read.
        """
        selected = ResultFilter(run, spacecraft, start, end)
        with self._context.reading() as connection:
            found = results.adopted_what_ifs(connection, selected, MOST_ADOPTED)
        signatures = self.signatures({each["id"]: each["parent_id"] for each in found})
        return [(each, signatures.get(each["id"])) for each in found]

    def latest(self, spacecraft: str, run: str | None = None) -> Result:
        """Read the newest current result of a spacecraft in a run, by batch time, as `get` does.

        A live batch that is dated far in the future counts only if there is no other.
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
        adopted: bool = False,
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[Summary]:
        """Page of current results, newest batch time first; see `results.list_batches`.

        The run `*` stands for every run, live batches included.  `batch` is a batch id, which
        occurs once in each run of a spacecraft.  Raises `BadBatch` for a spacecraft that has
        neither batches nor a mission.
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
                adopted=adopted,
                limit=limit,
                cursor=cursor,
            )
        if spacecraft is not None and not page.items and page.next_cursor is None:
            # A misspelt name must not look like a spacecraft without data.
            mission_in_input(self._context.known, spacecraft)
        return page

    def neighbours(self, id: str) -> Neighbours:
        """Results before and after a result in time: `earlier` and `later`, or None."""
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            place = place_of(connection, id)
        with self._context.reading_record() as connection:
            return neighbours(connection, self._context.store.archive, place)

    def around(self, moment: Utc, run: str, spacecraft: str | None = None) -> Neighbours:
        """Latest result of a run up to a time, and the first one after that time."""
        # One nanosecond later, so that a batch at the time itself is `earlier`.
        place = ResultPlace(spacecraft, run, moment.tai_ns + 1, None)
        with self._context.reading_record() as connection:
            return neighbours(connection, self._context.store.archive, place)

    def star_field(self, id: str, answer: Answer | None = None) -> StarField:
        """Data for the star charts of a result; see `star_field.star_field_of`.

        An `answer` in place of the recorded one, such as that of a what-if, is drawn over the same
        batch.
        """
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            batch, recorded = recorded_batch(connection, id)
            answer = answer or recorded
            mission = recorded_mission(connection, answer.provenance.mission)
        return star_field_of(batch, mission, self._context.sky, answer)

    def trackers(self, id: str, answer: Answer | None = None) -> list[Row]:
        """Values of a result's trackers for a comparison; see `tracker_comparison`.

        Empty for a result of one tracker.  An `answer` in place of the recorded one, such as that
        of a what-if, is compared over the same batch.
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
        """Stars and attitudes of a period, from a sample of its batches if there are many.

        See `period.sample_period`, which also bounds the number of batches read.
        """
        self._context.mission(spacecraft)
        span = BucketFilter(spacecraft, run or LIVE, start, end)
        with self._context.reading() as connection:
            sample = sample_period(connection, span)
        return period_stars(sample, self._context.sky)

    def settings_for(self, id: str) -> Choices:
        """Settings of a result that a what-if can change."""
        with self._context.reading_batch(known_id(id, "batch")) as (connection, _):
            batch, _ = recorded_batch(connection, id)
        return choices_of(batch, self._context.mission(batch.spacecraft))

    def spacecraft_of(self, id: str) -> str | None:
        """Spacecraft of a recorded result; None for an unknown result."""
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
        """Process a recorded batch again; `options` override those of its result.

        The answer names its parent.  It is stored only if `record` or `adopt` is set; an adopted
        one appears in lists, histories and rates.  `entry` goes to the audit list with it.
        """
        known = known_id(id, "batch")
        self._submissions.require_kernels()
        return self._submissions.what_if(known, options, record=record, adopt=adopt, entry=entry)


COMPARE_SAMPLE, COMPARE_RETRY_S = 100, 10


@dataclass(frozen=True)
class Stretch:
    """Batches to compare: those of a spacecraft in a period, at most `sample` of them."""

    spacecraft: str
    run: str | None = None
    start: Utc | None = None
    end: Utc | None = None
    sample: int = COMPARE_SAMPLE


class Comparisons:
    """Service that compares two sets of options or settings, for one caller at a time."""

    def __init__(self, context: Context, submissions: SubmissionService) -> None:
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
        """Run recorded batches again with two sets of options, and list the differences.

        Raises `BadBatch` for a setting that changes nothing for any batch.  At most `sample`
        batches of the period are compared, fewer where `limit_s` seconds run out.  Settings that
        the options do not name stay as they were for a batch.  Raises `Busy` while the service is
        computing another comparison.
        """
        mission = mission_named(self._context.missions, name)
        again = self._submissions.run_again_many
        # Cached, since most batches have the same options.
        merged = cache(lambda own, side: merged_options(json.loads(own), (a, b)[side]).to_options())

        def pair_of(row: Row) -> Pair:
            sent = submission_from_json(row["input"]).batch
            if sent.measurement is not None:
                # A measured attitude has no stars to identify: options do not change its answer.
                return Pair(row["id"], sent, sent)
            options = (merged(row["options"], side) for side in (0, 1))
            return Pair(row["id"], *(structs.replace(sent, options=each) for each in options))

        def check(pairs: Sequence[Pair]) -> None:
            of_stars = [each for each in pairs if each.a.measurement is None]
            refuse_idle_options(a, [each.a for each in of_stars], mission, "a")
            refuse_idle_options(b, [each.b for each in of_stars], mission, "b")

        stretch = Stretch(name, run, start, end, sample)
        option_sets = tuple(each.model_dump(mode="json", exclude_none=True) for each in (a, b))
        return self._compared(
            stretch, pair_of, (again, again), (option_sets[0], option_sets[1]), limit_s, check
        )

    def of_missions(
        self, stretch: Stretch, a: Mission, b: Mission, limit_s: float = math.inf
    ) -> Comparison:
        """Run recorded batches again with two settings of the mission; see `of_options`."""

        def pair_of(row: Row) -> Pair:
            batch = batch_with_options(row["input"], row["options"])
            return Pair(row["id"], batch, batch)

        again = self._submissions.run_again_many
        sides = partial(again, mission=a), partial(again, mission=b)
        return self._compared(stretch, pair_of, sides, ({}, {}), limit_s)

    def _compared(
        self,
        stretch: Stretch,
        pair_of: Callable[[Row], Pair],
        sides: tuple[RunManyAgain, RunManyAgain],
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
