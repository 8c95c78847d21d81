"""Limits of quantities: those that hold, their history, and new ones."""

from collections.abc import Callable
from typing import cast

from service.access.audit import Entry
from service.alarms.limits import LimitSettings
from service.alarms.preview import Preview, preview_of, preview_of_gaps
from service.alarms.quantities import REJECTED, SILENCE, QuantityName, tracker_names
from service.alarms.subjects import limited_trackers, subject_of
from service.alarms.window import Sample
from service.app.context import Context
from service.errors import BadBatch, Fault, shown_value
from service.missions.mission import Mission, mission_named
from service.storage.grades.period import rejected_samples
from service.storage.models.alarms import (
    Limit,
    LimitExcursion,
    LimitHistory,
    LimitPreview,
    LimitTrial,
    SeverityName,
)
from service.storage.queries import limits
from service.storage.queries.pages import ResultFilter
from service.storage.recording.unsaved_result import LIVE
from service.times import DAY_S, shifted, utc_now

PREVIEW_DAYS = 7
MOST_PREVIEWED = 50_000
"""Batches of one preview: to read them takes about a second."""
MOST_EXCURSIONS = 50


class Limits:
    """Reads and sets the limits of spacecraft."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def all(self, name: str, tracker: str | None = None) -> list[Limit]:
        """The limit of every quantity of a spacecraft, or of one of its trackers."""
        mission = self._context.mission(name)
        own = _checked_tracker(mission, tracker)
        with self._context.reading() as connection:
            return limits.list_limits(connection, mission, own)

    def get(self, name: str, quantity: QuantityName, tracker: str | None = None) -> LimitHistory:
        """The limit of one quantity, the shipped limit, and the history of changes."""
        mission = self._context.mission(name)
        own = _checked_tracker(mission, tracker, quantity)
        with self._context.reading() as connection:
            return limits.limit_history(connection, mission, quantity, own)

    def set(
        self,
        name: str,
        quantity: QuantityName,
        settings: LimitSettings | None,
        *,
        who: str,
        comment: str | None = None,
        entry: Entry | None = None,
        tracker: str | None = None,
    ) -> Limit:
        """Set a limit, which holds from the next batch on; None restores the shipped one.

        `entry` goes to the audit list with the change.
        """
        mission, moment = mission_named(self._context.missions, name), utc_now().text
        own = _checked_tracker(mission, tracker, quantity)
        return self._context.change_audited(
            lambda connection: limits.set_limit(
                connection,
                mission,
                quantity,
                settings,
                who=who,
                comment=comment,
                now=moment,
                tracker=own,
            ),
            entry,
        )

    def preview(
        self,
        name: str,
        quantity: QuantityName,
        settings: LimitSettings,
        *,
        run: str | None = None,
        days: int = PREVIEW_DAYS,
        tracker: str | None = None,
    ) -> LimitPreview:
        """How a limit and the one in force evaluate the days up to the run's latest batch.

        Of more than `MOST_PREVIEWED` batches it takes the latest ones.  They are evaluated in the
        order of their time, whenever they came.
        """
        mission = self._context.mission(name)
        own = _checked_tracker(mission, tracker, quantity)
        subject = subject_of(quantity, own)
        with self._context.reading() as connection:
            in_force = limits.limits_of(connection, mission)[subject]
            last = limits.latest_time(connection, ResultFilter(run or LIVE, name), utc_now())
            time_ns: list[int] = []
            samples: list[Sample] = []
            if last is not None:
                # The latest batch belongs to the period.
                start, end = shifted(last, -DAY_S * days), shifted(last, 0.001)
                period = ResultFilter(run or LIVE, name, start, end)
                if quantity == REJECTED:
                    samples = rejected_samples(connection, period)[-MOST_PREVIEWED:]
                    time_ns = [at_ns for at_ns, _, _ in samples]
                else:
                    time_ns, samples = limits.latest_samples(
                        connection, period, subject, MOST_PREVIEWED
                    )

        def moment(at_ns: int) -> str:
            assert last is not None
            return shifted(last, (at_ns - last.tai_ns) / 1e9).text

        def trial(tried: LimitSettings) -> LimitTrial:
            of_gaps = quantity == SILENCE
            found = preview_of_gaps(time_ns, tried) if of_gaps else preview_of(samples, tried)
            return _trial(found, tried, moment)

        return LimitPreview(
            spacecraft=name,
            run=run or LIVE,
            quantity=quantity,
            tracker=own or None,
            start=moment(time_ns[0]) if time_ns else None,
            end=moment(time_ns[-1]) if time_ns else None,
            batches=len(time_ns),
            is_cut=len(time_ns) == MOST_PREVIEWED,
            proposed=trial(settings),
            in_force=trial(in_force),
        )


def _trial(found: Preview, tried: LimitSettings, moment: Callable[[int], str]) -> LimitTrial:
    """A preview as the interface shows it; `moment` gives the text of a time in TAI ns."""
    return LimitTrial(
        settings=tried.model_dump(mode="json"),
        evaluated=found.evaluated,
        beyond={
            cast(SeverityName, severity.word): count for severity, count in found.beyond.items()
        },
        alarms=len(found.excursions),
        excursions=[
            LimitExcursion(
                severity=cast(SeverityName, each.severity.word),
                start=moment(each.start_ns),
                end=None if each.end_ns is None else moment(each.end_ns),
                worst=each.worst,
                bound=each.bound,
            )
            for each in found.excursions[-MOST_EXCURSIONS:]
        ],
    )


def _checked_tracker(
    mission: Mission, tracker: str | None, quantity: QuantityName | None = None
) -> str:
    """The tracker whose limits are meant; empty for those of the spacecraft.

    Raises `BadInput` for one that has none of its own, and for a quantity that no tracker has.
    """
    if tracker is None:
        return ""
    mission.tracker(tracker, "tracker")
    if tracker not in limited_trackers(mission):
        message = f"{mission.name} has one tracker; its limits are those of the spacecraft"
        raise BadBatch(Fault("tracker", message, shown_value(tracker)))
    if quantity is not None and quantity not in tracker_names():
        known = ", ".join(tracker_names())
        raise BadBatch(Fault("tracker", f"a tracker has {known} only", shown_value(quantity)))
    return tracker
