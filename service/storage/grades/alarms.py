"""The alarm quantity of smoothed days: the share of attitudes that the filter rejects."""

import numpy as np
from sqlalchemy import Connection, select

from service.alarms.preview import preview_of
from service.alarms.quantities import REJECTED
from service.alarms.window import Point, Sample
from service.filtering.state import Outcome
from service.grades.day import day_bounds
from service.missions.mission import Mission
from service.storage.grades.days import DayKey
from service.storage.grades.models import GradedDayRow
from service.storage.grades.period import latest_innovations
from service.storage.projections.alarms import ActiveAlarms, runs_with_alarms
from service.storage.queries.limits import limits_of
from service.storage.queries.pages import ResultFilter
from service.storage.sql.grade_tables import graded_days
from service.times import shifted

_COUNTED = (Outcome.ACCEPTED, Outcome.REJECTED, Outcome.STARTED)


def rejected_samples(connection: Connection, selected: ResultFilter) -> list[Sample]:
    """What each measured attitude of a period adds to the share, in order of time."""
    found: list[Sample] = []
    for part in latest_innovations(connection, selected):
        counted = np.isin(part.outcome, _COUNTED)
        rejected = part.outcome[counted] == Outcome.REJECTED
        times = part.tai_ns[counted].tolist()
        found += [(at, float(is_one), 1.0) for at, is_one in zip(times, rejected, strict=True)]
    return sorted(found)


def evaluate_day(connection: Connection, mission: Mission, key: DayKey, row: GradedDayRow) -> None:
    """Evaluate the limits of the share for a day that was recorded now.

    Its measurements are evaluated in the order of their time, as batches that arrive are: what
    was out of limits within the day raises an alarm, and returns.  Of a later revision of the
    day the state at its end counts alone.  Days before the latest one raise nothing, and neither
    do runs without alarms.
    """
    if key.run not in runs_with_alarms(connection, {key.run}) or not _is_latest(connection, key):
        return
    start, end = day_bounds(key.day)
    samples = rejected_samples(connection, ResultFilter(key.run, key.spacecraft, start, end))
    limits = limits_of(connection, mission)[REJECTED]
    if len(samples) < limits.minimum_count:
        return
    active = ActiveAlarms(connection, key.spacecraft, key.run)
    excursions = preview_of(samples, limits).excursions
    last_ns = samples[-1][0]

    def at(time_ns: int, value: float | None = None) -> Point:
        """The value at a time; by default the share over the latest until then."""
        if value is None:
            parts = [part for at_ns, part, _ in samples if at_ns <= time_ns]
            value = sum(parts[-limits.minimum_count :]) / limits.minimum_count
        return Point(value, shifted(start, (time_ns - start.tai_ns) * 1e-9).text, None)

    for each in excursions:
        if row.revision > 1 and each.end_ns is not None:
            continue
        worst = at(each.start_ns, each.worst)
        active.observe(REJECTED, each.severity, limits, worst, row.created, worst)
        if each.end_ns is not None:
            active.observe(REJECTED, None, limits, at(each.end_ns), row.created)
    if not excursions or excursions[-1].end_ns is not None:
        active.observe(REJECTED, None, limits, at(last_ns), row.created)
    active.save()


def _is_latest(connection: Connection, key: DayKey) -> bool:
    c = graded_days.c
    later = select(c.id).where(
        c.spacecraft == key.spacecraft, c.run == key.run, c.current, c.day > key.day
    )
    return connection.execute(later.limit(1)).first() is None
