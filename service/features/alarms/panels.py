"""Limits and violations drawn on the charts of a spacecraft."""

from collections.abc import Iterator

from msgspec import structs

from service.features.alarms.part import Alarms
from service.trends.quantities import limited_trackers
from service.web.console.page import PageContext
from service.web.console.pages.spacecraft import DrawnLimits, ShownPeriod


def limits_of_charts(
    context: PageContext, name: str, run: str, tracker: str | None, shown: ShownPeriod | None
) -> Iterator[DrawnLimits]:
    """Limits of a spacecraft or tracker, and intervals in which alarms were out of limits.

    For a tracker, its own alarms and alarms of all trackers are included.
    """
    alarms, limited = context.app.part(Alarms), limited_trackers(context.app.context.known[name])
    limits = alarms.limits.all(name, tracker if tracker in limited else None)
    out = []
    if shown is not None:
        out = [
            structs.asdict(each)
            for each in alarms.of_period(name, run, shown.start, shown.end)
            if tracker is None or each.tracker in (None, tracker)
        ]
    yield DrawnLimits(limits, out)


PANELS = {"spacecraft_page": limits_of_charts}
