"""Alarms: lists, one with its history, and what operators do about them."""

from collections.abc import Callable, Sequence

from service.access.audit import Entry
from service.alarms import state_machine
from service.alarms.subjects import limited_trackers
from service.app.context import ALL_RUNS, Context, known_id
from service.storage.models.alarms import Alarm, AlarmSpan, AlarmWithActions
from service.storage.models.base import Page
from service.storage.projections.alarms import evaluate_by_clock, is_due_by_clock
from service.storage.queries import alarms
from service.storage.queries.alarms import TimeOut, alarm_spans, times_out
from service.storage.recording.unsaved_result import LIVE
from service.storage.sql.columns import Row
from service.times import Utc, shifted, utc_now


class Alarms:
    """Reads alarms and changes their state.  `entry` goes to the audit list with a change."""

    def __init__(self, context: Context) -> None:
        self._context = context

    def page(
        self,
        *,
        run: str | None = None,
        spacecraft: str | None = None,
        state: alarms.StateFilter = "active",
        limit: int = 100,
        cursor: str | None = None,
    ) -> Page[Alarm]:
        """Alarms, newest first; the run `*` stands for every run."""
        with self._context.reading() as connection:
            return alarms.list_alarms(
                connection,
                run=None if run == ALL_RUNS else run or LIVE,
                spacecraft=spacecraft,
                state=state,
                limit=limit,
                cursor=cursor,
                now=utc_now().text,
            )

    def active(self, run: str = LIVE) -> list[Alarm]:
        """Every alarm of a run that is not cleared, the worst first."""
        with self._context.reading() as connection:
            return alarms.active_alarms(connection, run, utc_now().text)

    def of_period(self, spacecraft: str, run: str, start: Utc, end: Utc) -> list[AlarmSpan]:
        """When alarms of a spacecraft were out of their limits; see `alarm_spans`."""
        with self._context.reading() as connection:
            return alarm_spans(connection, run, spacecraft, start, end)

    def times_out(self, found: Sequence[Alarm]) -> list[list[TimeOut]]:
        """For each alarm, when it was out of its limits; see `period.alarms.times_out`."""
        with self._context.reading() as connection:
            return times_out(connection, found)

    def get(self, id: str) -> AlarmWithActions:
        """One alarm with its history."""
        with self._context.reading() as connection:
            return alarms.read_alarm(connection, known_id(id, "alarm"), utc_now().text)

    def is_retired(self, spacecraft: str, tracker: str | None) -> bool:
        """Whether no mission file has the spacecraft, or the tracker with limits of its own."""
        mission = self._context.missions.get(spacecraft)
        return mission is None or bool(tracker and tracker not in limited_trackers(mission))

    def acknowledge(
        self, id: str, who: str, comment: str | None = None, entry: Entry | None = None
    ) -> AlarmWithActions:
        """Acknowledge an alarm; with the quantity back in limits, or retired, it is cleared."""
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
    ) -> AlarmWithActions:
        """Shelve an alarm for some minutes."""
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
    ) -> AlarmWithActions:
        """End the shelving of an alarm."""
        return self._act(id, state_machine.unshelved, who, comment, utc_now().text, entry)

    def comment(
        self, id: str, who: str, comment: str, entry: Entry | None = None
    ) -> AlarmWithActions:
        """Comment on an alarm, cleared ones included."""
        return self._act(id, lambda _: ({}, ["commented"]), who, comment, utc_now().text, entry)

    def evaluate_by_clock(self) -> bool:
        """Raise alarms of silent spacecraft and end expired shelving; whether there was any."""
        moment = utc_now()
        with self._context.reading() as connection:
            due = is_due_by_clock(connection, self._context.missions, moment)
        if due:
            self._context.store.writer.project(
                lambda connection: evaluate_by_clock(connection, self._context.missions, moment)
            ).result()
        return due

    def _act(
        self,
        id: str,
        step: Callable[[Row], state_machine.AlarmUpdate],
        who: str,
        comment: str | None,
        moment: str,
        entry: Entry | None,
    ) -> AlarmWithActions:
        known = known_id(id, "alarm")
        return self._context.change_audited(
            lambda connection: alarms.act(
                connection, known, step, who=who, comment=comment, now=moment
            ),
            entry,
        )
