"""Service that computes, records and reads filtered and smoothed attitudes of days."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Unpack

from sqlalchemy import Connection

from service.app.context import Context, PageOfPeriod, checked_run_name
from service.contract.base import Page
from service.errors import NotFound
from service.features.definitive import period, records
from service.features.definitive.day import definitive_day, window_of
from service.features.definitive.inputs import days_with_batches, inputs_digest, recorded_in
from service.missions.mission import Mission, mission_named
from service.observations.schema import LIVE
from service.storage.archived import holds_any
from service.storage.queries.pages import ResultFilter
from service.storage.recording.ids import Ulids
from service.times import Utc, utc_now


@dataclass
class SmoothProgress:
    """Progress of smoothing the days of a period.

    `total` counts the days with batches; `days` are the current revisions of days with attitudes,
    `new` the ids of revisions recorded now.  `empty` counts days without an attitude to start from,
    and `archived` days that are skipped because their batches are archived.
    """

    total: int
    days: list[records.DefinitiveDayRow] = field(default_factory=list)
    new: set[str] = field(default_factory=set)
    empty: int = 0
    archived: int = 0

    @property
    def done(self) -> int:
        """Number of finished days."""
        return len(self.days) + self.empty + self.archived


class DefinitiveDays:
    """Computes, records and reads filtered and smoothed attitudes of days."""

    def __init__(self, context: Context) -> None:
        self._context = context
        self._ids = Ulids()

    def smooth(
        self,
        name: str,
        *,
        run: str | None = None,
        start: Utc | None = None,
        end: Utc | None = None,
        step: Callable[[SmoothProgress], object] = lambda progress: None,
    ) -> SmoothProgress:
        """Filter and smooth every UTC day of a period that has batches.

        A day is recorded as a new revision if anything that it depends on has changed.  Otherwise
        the old revision stays; it stays too if batches of the day are archived, since the remaining
        ones would give a poorer result.

        Raises `NotFound` if the period has no batch.
        """
        mission = mission_named(self._context.missions, name)
        run = LIVE if run is None else checked_run_name(run)
        with self._context.reading() as connection:
            days = days_with_batches(connection, name, run, start, end)
        if not days:
            raise NotFound(f"{name} has no batch in run {run} in the period")
        progress = SmoothProgress(len(days))
        step(progress)
        for day in days:
            self._smooth_day(mission, records.DayKey(name, run, day), progress)
            step(progress)
        return progress

    def innovations(self, name: str, **asked: Unpack[PageOfPeriod]) -> Page[records.Innovation]:
        """List a page of innovations (measured minus predicted attitudes), earliest first."""
        return self._context.page(period.list_innovations, ResultFilter, name, asked)

    def of_period(
        self, name: str, run: str, start: Utc, end: Utc
    ) -> period.DefinitivePeriod | None:
        """Thinned samples and innovations of a period; None if none are recorded."""
        self._context.mission(name)
        with self._context.reading() as connection:
            return period.definitive_period(connection, name, run, start, end)

    def _smooth_day(self, mission: Mission, key: records.DayKey, progress: SmoothProgress) -> None:
        window = window_of(key.day)
        with self._context.reading() as connection:
            if holds_any(connection, key.spacecraft, key.run, *window):
                progress.archived += 1
                return
            recorded = recorded_in(connection, self._context.sky, key.spacecraft, key.run, *window)
            before = records.current_day(connection, key)
        inputs = inputs_digest(recorded, mission)
        if before is not None and before.inputs == inputs:
            progress.days.append(before)
            return
        computed = definitive_day(recorded, mission, key.day)
        if before is None and not computed.samples:
            progress.empty += 1
            return
        rows = records.rows_of(key, computed, inputs, self._ids.new(), utc_now())

        def change(connection: Connection) -> records.DefinitiveDayRow:
            recorded_day = records.record_day(connection, key, rows)
            # Another process may have recorded the same meanwhile.
            if recorded_day.id == rows[0]["id"]:
                off = self._context.settings.features_off
                period.evaluate_day(connection, mission, key, recorded_day, off)
            return recorded_day

        row = self._context.change(change)
        progress.days.append(row)
        if row.id == rows[0]["id"]:
            progress.new.add(row.id)
