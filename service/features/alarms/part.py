"""Service for limits, alarms and the operators' actions on alarms."""

from collections.abc import Callable, Sequence
from typing import cast

from service.access import Entry
from service.app.context import ALL_RUNS, Context, known_id
from service.app.factory import App
from service.contract.alarms import Alarm, Limit, SeverityName
from service.contract.base import Page
from service.errors import BadBatch, Fault, shown_value
from service.features.alarms import records, state, state_machine
from service.features.alarms.projection import evaluate_by_clock, is_due_by_clock
from service.features.alarms.state import StateFilter, TimeOut, alarm_spans, list_alarms, times_out
from service.features.alarms.windows import (
    Point,
    Preview,
    largest_contribution,
    preview_of,
    preview_of_gaps,
)
from service.missions.mission import Mission, mission_named
from service.observations.schema import LIVE
from service.storage.queries.definitive import rejected_samples
from service.storage.queries.pages import ResultFilter, latest_time
from service.storage.queries.trends import latest_samples, samples_until
from service.storage.sql.columns import Row
from service.times import DAY_S, Utc, shifted, utc_now
from service.trends.limits import Bounds, LimitSettings, Sample, Severity
from service.trends.quantities import (
    REJECTED,
    SILENCE,
    QuantityName,
    limited_trackers,
    subject_of,
    tracker_names,
)


class Alarms:
    """Service that reads alarms and changes their state. `entry` is the audit entry written with a
    change.

    `limits` manages the limits that raise alarms.
    """

    def __init__(self, context: Context) -> None:
        self._context = context
        self.limits = Limits(context)

    def close(self) -> None:
        """Do nothing on closing: this part has no thread and no file."""

    def page(
        self,
        *,
        run: str | None = None,
        spacecraft: str | None = None,
        state: StateFilter = "active",
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[Alarm]:
        """One page of alarms, newest first; the run `*` selects all runs."""
        with self._context.reading() as connection:
            return list_alarms(
                connection,
                run=None if run == ALL_RUNS else run or LIVE,
                spacecraft=spacecraft,
                state=state,
                limit=limit,
                cursor=cursor,
                now=utc_now().text,
            )

    def active(self, run: str = LIVE) -> list[Alarm]:
        """Alarms of a run that are not cleared, sorted by present severity, the worst first."""
        with self._context.reading() as connection:
            return state.active_alarms(connection, run, utc_now().text)

    def of_period(self, spacecraft: str, run: str, start: Utc, end: Utc) -> list[records.AlarmSpan]:
        """Intervals in which alarms of a spacecraft were out of limits; see `alarm_spans`."""
        with self._context.reading() as connection:
            return alarm_spans(connection, run, spacecraft, start, end)

    def times_out(self, found: Sequence[Alarm]) -> list[list[TimeOut]]:
        """Intervals in which each alarm was out of limits; see `state.times_out`."""
        with self._context.reading() as connection:
            return times_out(connection, found)

    def get(self, id: str) -> records.AlarmWithActions:
        """An alarm with the actions recorded for it."""
        with self._context.reading() as connection:
            return state.read_alarm(connection, known_id(id, "alarm"), utc_now().text)

    def present_bounds(self, found: Sequence[Alarm]) -> list[float]:
        """Bound of the present severity of each alarm; of the worst one where that is not known."""
        missions = self._context.missions
        eased = {a.spacecraft for a in found if a.current_severity not in (None, a.severity)}
        with self._context.reading() as connection:
            limits = {
                name: state.limits_of(connection, missions[name])
                for name in eased & missions.keys()
            }
        return [_present_bound(alarm, limits.get(alarm.spacecraft, {})) for alarm in found]

    def largest_contributions(self, alarm: Alarm, limits: LimitSettings) -> dict[str, str]:
        """Ids of the batches that contributed most to the raised, worst and latest mean."""
        subject, count = subject_of(alarm.quantity, alarm.tracker or ""), limits.minimum_count
        found = {}
        with self._context.reading() as connection:
            for which in ("raised", "worst", "latest"):
                value = getattr(alarm, which)
                if value.batch_id is None or count == 1:
                    continue
                point = Point(value.value, value.time, value.batch_id)
                # Batches without a value are not part of a window.
                recorded = samples_until(connection, value.batch_id, subject, 10 * count)
                if batch_id := largest_contribution(point, recorded, limits):
                    found[which] = batch_id
        return found

    def is_retired(self, spacecraft: str, tracker: str | None) -> bool:
        """True if no loaded mission has the spacecraft, or the tracker with its own limits."""
        mission = self._context.missions.get(spacecraft)
        return mission is None or bool(tracker and tracker not in limited_trackers(mission))

    def acknowledge(
        self, id: str, who: str, comment: str | None = None, entry: Entry | None = None
    ) -> records.AlarmWithActions:
        """Acknowledge an alarm; clear it if back in limits, or if its subject is retired."""
        moment = utc_now().text
        return self._act(
            id,
            lambda alarm: state_machine.acknowledged(
                alarm,
                who,
                moment,
                is_retired=self.is_retired(alarm["spacecraft"], alarm["tracker"]),
            ),
            who,
            comment,
            moment,
            entry,
        )

    def shelve(
        self,
        id: str,
        who: str,
        minutes: int,
        comment: str | None = None,
        entry: Entry | None = None,
    ) -> records.AlarmWithActions:
        """Hide an alarm for a number of minutes (shelving)."""
        now = utc_now()
        until = shifted(now, 60.0 * minutes).text
        return self._act(
            id,
            lambda alarm: state_machine.shelved(alarm, who, until, now.text),
            who,
            comment,
            now.text,
            entry,
        )

    def unshelve(
        self, id: str, who: str, comment: str | None = None, entry: Entry | None = None
    ) -> records.AlarmWithActions:
        """End the shelving of an alarm."""
        return self._act(id, state_machine.unshelved, who, comment, utc_now().text, entry)

    def comment(
        self, id: str, who: str, comment: str, entry: Entry | None = None
    ) -> records.AlarmWithActions:
        """Add a comment to an alarm, also to a cleared one."""
        return self._act(id, lambda _: ({}, ["commented"]), who, comment, utc_now().text, entry)

    def evaluate_by_clock(self) -> bool:
        """Raise alarms of silent spacecraft and end expired shelving; True if any was due."""
        moment = utc_now()
        with self._context.reading() as connection:
            due = is_due_by_clock(connection, self._context.missions, moment)
        if due:
            with self._context.store.writer.projection() as connection:
                evaluate_by_clock(connection, self._context.missions, moment)
        return due

    def _act(
        self,
        id: str,
        step: Callable[[Row], state_machine.AlarmUpdate],
        who: str,
        comment: str | None,
        moment: str,
        entry: Entry | None,
    ) -> records.AlarmWithActions:
        known = known_id(id, "alarm")
        return self._context.change_audited(
            lambda connection: state.act(
                connection, known, step, who=who, comment=comment, now=moment
            ),
            entry,
        )


def _present_bound(alarm: Alarm, limits: state.LimitsInForce) -> float:
    settings = limits.get(subject_of(alarm.quantity, alarm.tracker or ""))
    if settings is None or alarm.current_severity in (None, alarm.severity):
        return alarm.raised.bound
    severity = Severity[alarm.current_severity.upper()]
    # The limits may have been changed since: then the severity may have no bound.
    has_bound = settings.bounds(severity) != Bounds()
    return settings.bound(severity, alarm.latest.value) if has_bound else alarm.raised.bound


PREVIEW_DAYS = 7
MOST_PREVIEWED = 50_000
"""Greatest number of batches in one preview of a limit; reading them takes about a second."""


class Limits:
    """Service that reads and sets the limits of spacecraft."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def all(self, name: str, tracker: str | None = None) -> list[Limit]:
        """Limits of all quantities of a spacecraft, or of one of its trackers."""
        mission = self._context.mission(name)
        own = _checked_tracker(mission, tracker)
        with self._context.reading() as connection:
            return state.list_limits(connection, mission, own)

    def get(
        self, name: str, quantity: QuantityName, tracker: str | None = None
    ) -> records.LimitHistory:
        """Limit of one quantity, with its shipped default and the history of changes."""
        mission = self._context.mission(name)
        own = _checked_tracker(mission, tracker, quantity)
        with self._context.reading() as connection:
            return state.limit_history(connection, mission, quantity, own)

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
        """Set a limit, in force from the next batch on; None restores the shipped default.

        `entry` is the audit entry written with the change.
        """
        mission, moment = mission_named(self._context.missions, name), utc_now().text
        own = _checked_tracker(mission, tracker, quantity)
        return self._context.change_audited(
            lambda connection: state.set_limit(
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
    ) -> records.LimitPreview:
        """Compare a proposed limit with the one in force over recorded batches of the latest days.

        The period ends at the latest batch of the run; at most `MOST_PREVIEWED` batches are
        evaluated, the latest ones, in order of batch time rather than arrival.
        """
        mission = self._context.mission(name)
        own = _checked_tracker(mission, tracker, quantity)
        subject = subject_of(quantity, own)
        with self._context.reading() as connection:
            in_force = state.limits_of(connection, mission)[subject]
            last = latest_time(connection, ResultFilter(run or LIVE, name), utc_now())
            time_ns: list[int] = []
            samples: list[Sample] = []
            if last is not None:
                # The end of the period is excluded, so it lies after the latest batch.
                start, end = shifted(last, -DAY_S * days), shifted(last, 0.001)
                period = ResultFilter(run or LIVE, name, start, end)
                if quantity == REJECTED:
                    samples = rejected_samples(connection, period)[-MOST_PREVIEWED:]
                    time_ns = [at_ns for at_ns, _, _ in samples]
                else:
                    time_ns, samples = latest_samples(connection, period, subject, MOST_PREVIEWED)

        def moment(at_ns: int) -> str:
            assert last is not None
            return shifted(last, (at_ns - last.tai_ns) / 1e9).text

        def trial(tried: LimitSettings) -> records.LimitTrial:
            of_gaps = quantity == SILENCE
            found = preview_of_gaps(time_ns, tried) if of_gaps else preview_of(samples, tried)
            return _trial(found, tried, moment)

        return records.LimitPreview(
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


def _trial(
    found: Preview, tried: LimitSettings, moment: Callable[[int], str]
) -> records.LimitTrial:
    """Convert the preview of a limit to an API record; `moment` formats TAI nanoseconds."""
    return records.LimitTrial(
        settings=tried.model_dump(mode="json"),
        evaluated=found.evaluated,
        beyond={
            cast(SeverityName, severity.word): count for severity, count in found.beyond.items()
        },
        alarms=len(found.excursions),
        excursions=[
            records.LimitExcursion(
                severity=cast(SeverityName, each.severity.word),
                start=moment(each.start_ns),
                end=None if each.end_ns is None else moment(each.end_ns),
                worst=each.worst,
                bound=each.bound,
            )
            for each in found.excursions[-50:]
        ],
    )


def _checked_tracker(
    mission: Mission, tracker: str | None, quantity: QuantityName | None = None
) -> str:
    """Name of the tracker whose limits are asked, checked; empty for those of the spacecraft.

    Raises `BadInput` for a tracker without limits of its own, and for a quantity that trackers do
    not have.
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


def open_part(app: App) -> Alarms:
    """Create the service for alarms and limits of an open app."""
    return Alarms(app.context)
