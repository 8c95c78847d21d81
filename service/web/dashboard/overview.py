"""The first page: how every spacecraft stands, a row each."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter
from fastapi import Query as InQuery
from starlette.responses import Response

from service.times import DAY_S, parse_utc, shifted
from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import AtDesk, RunQuery
from service.web.dashboard.sparkline import Sparkline, sparkline

router = APIRouter(include_in_schema=False, route_class=PageRoute)

STALE_AFTER_S = 3600.0
"""A spacecraft that is this far behind the latest batch of its run is told so in words."""


@dataclass(frozen=True)
class Window:
    """An hour or a day before the run's latest batch: sums and their course."""

    sums: Mapping[str, Any]
    spark: Sparkline | None


@dataclass(frozen=True)
class Line:
    """One spacecraft's row."""

    item: Mapping[str, Any]
    windows: tuple[tuple[str, Window], ...]

    @property
    def last_day(self) -> tuple[str, str]:
        """The bounds of the day that ends with the spacecraft's latest batch."""
        # The latest batch belongs to it, and the end of a stretch does not.
        end = shifted(parse_utc(self.item["latest_batch"]["time"]), 0.001)
        return shifted(end, -DAY_S).text, end.text

    @property
    def is_stale(self) -> bool:
        """Whether it has fallen behind the run."""
        age_s = self.item["age_s"]
        return age_s is not None and age_s > STALE_AFTER_S


@router.get("/")
def overview_page(query: Annotated[RunQuery, InQuery()], desk: AtDesk) -> Response:
    """State, attitude, shares, alarms and age of every spacecraft in a run."""
    overview = desk.operations.overview(query.run)
    lines = [
        Line(item, (("last hour", _window(item, "hour")), ("last day", _window(item, "day"))))
        for item in overview["items"]
        if desk.caller.may_see(item["name"])
    ]
    return rendered(
        "overview.html.jinja",
        desk.shell(query.run, "/"),
        overview=overview,
        lines=sorted(lines, key=lambda line: line.item["latest_batch"] is None),
        any_batch=any(line.item["latest_batch"] for line in lines),
    )


def _window(item: Mapping[str, Any], name: str) -> Window:
    sums, series = item[f"last_{name}"], item[f"sparkline_{name}"]
    if not sums or not sums["batches"]:
        return Window(sums or {}, None)
    start_s, end_s = (_unix_s(sums[bound]) for bound in ("start", "end"))
    return Window(sums, sparkline(series, start_s, end_s))


def _unix_s(text: str) -> float:
    """POSIX seconds; within a leap second those of the second before."""
    return datetime.fromisoformat(text.replace(":60", ":59")).timestamp()
