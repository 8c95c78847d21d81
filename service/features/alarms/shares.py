"""Evaluation of limits on a quantity of a whole UTC day, when the day is recorded."""

from sqlalchemy import Connection

from service.features.alarms.projection import ActiveAlarms
from service.features.alarms.state import limits_of
from service.features.alarms.windows import Point, preview_of
from service.missions.mission import Mission
from service.times import shifted
from service.trends.limits import SampledDay


def evaluate_day(connection: Connection, mission: Mission, day: SampledDay) -> None:
    """Evaluate the limits of a quantity against the samples of a newly recorded day.

    Samples are evaluated in order of time, like arriving batches: an excursion within the day
    raises an alarm that returns.  For a later revision of the day only the state at its end counts.
    """
    limits = limits_of(connection, mission)[day.quantity]
    samples, start = day.samples, day.start
    if len(samples) < limits.minimum_count:
        return
    active = ActiveAlarms(connection, mission.name, day.run)
    excursions = preview_of(samples, limits).excursions

    def at(time_ns: int, value: float | None = None) -> Point:
        """Point of a value at a time (TAI, ns); by default the mean over the latest samples."""
        if value is None:
            parts = [part for at_ns, part, _ in samples if at_ns <= time_ns]
            value = sum(parts[-limits.minimum_count :]) / limits.minimum_count
        return Point(value, shifted(start, (time_ns - start.tai_ns) * 1e-9).text, None)

    for each in excursions:
        if day.revision > 1 and each.end_ns is not None:
            continue
        worst = at(each.start_ns, each.worst)
        active.observe(day.quantity, each.severity, limits, worst, day.created, worst)
        if each.end_ns is not None:
            active.observe(day.quantity, None, limits, at(each.end_ns), day.created)
    if not excursions or excursions[-1].end_ns is not None:
        active.observe(day.quantity, None, limits, at(samples[-1][0]), day.created)
    active.save()
