"""The first page: the state of every spacecraft, a row each."""

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated

from fastapi import Query as InQuery
from starlette.responses import Response

from service.storage.models.overview import OverviewRow
from service.storage.models.overview import WindowCounts as Sums
from service.times import DAY_S, parse_utc, shifted
from service.web.console.charts.sparkline import SparklineDrawing, sparkline
from service.web.console.page_context import ContextDep, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy

STALE_AFTER_S = 3600.0
"""A spacecraft this far behind the latest batch of its run is marked as stale."""


@dataclass(frozen=True)
class OverviewWindow:
    """The hour or day before the run's latest batch: sums and a sparkline."""

    sums: Sums | None
    spark: SparklineDrawing | None


@dataclass(frozen=True)
class OverviewLine:
    """One spacecraft's row."""

    item: OverviewRow
    windows: tuple[tuple[str, OverviewWindow], ...]

    @property
    def last_day(self) -> tuple[str, str]:
        """The bounds of the day that ends with the spacecraft's latest batch."""
        latest = self.item.latest_batch
        assert latest is not None
        # The latest batch belongs to it, and the end of a stretch does not.
        end = shifted(parse_utc(latest.time), 0.001)
        return shifted(end, -DAY_S).text, end.text

    @property
    def is_stale(self) -> bool:
        """Whether it has fallen behind the run."""
        age_s = self.item.age_s
        return age_s is not None and age_s > STALE_AFTER_S


@console_page("/", "Overview", Policy("read", "nothing"), position=10)
def overview_page(query: Annotated[PageQuery, InQuery()], context: ContextDep) -> Response:
    """State, attitude, shares, alarms and age of every spacecraft in a run."""
    overview = context.app.spacecraft.overview(query.run)
    lines = [
        OverviewLine(
            item, (("last hour", _window(item, "hour")), ("last day", _window(item, "day")))
        )
        for item in overview.items
        if context.caller.may_see(item.name)
    ]
    return rendered(
        "overview.html.jinja",
        context.layout(query.run),
        overview=overview,
        lines=sorted(lines, key=lambda line: line.item.latest_batch is None),
        any_batch=any(line.item.latest_batch for line in lines),
    )


def _window(item: OverviewRow, name: str) -> OverviewWindow:
    sums, series = getattr(item, f"last_{name}"), getattr(item, f"sparkline_{name}")
    if not sums or not sums.batches:
        return OverviewWindow(sums, None)
    return OverviewWindow(sums, sparkline(series, _unix_s(sums.start), _unix_s(sums.end)))


def _unix_s(text: str) -> float:
    """POSIX seconds; within a leap second those of the second before."""
    return datetime.fromisoformat(text.replace(":60", ":59")).timestamp()
