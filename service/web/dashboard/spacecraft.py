"""The page of one spacecraft: trends over a stretch of time, its worst and its latest batches."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlencode

from fastapi import APIRouter, Path
from fastapi import Query as InQuery
from pydantic import AfterValidator
from starlette.responses import Response

from service.alarms.quantities import OF_A_BATCH, QuantityName
from service.times import DAY_S, HOUR_S, Utc, parse_utc, shifted
from service.web.dashboard.rendering import PageRoute, rendered
from service.web.dashboard.shell import LIVE, AtDesk, Desk, RunQuery
from service.web.queries import End, Start

router = APIRouter(include_in_schema=False, route_class=PageRoute)

Range = Literal["hour", "day", "month", "year"]
RANGES_S: dict[Range, int] = {
    "hour": HOUR_S,
    "day": DAY_S,
    "month": 30 * DAY_S,
    "year": 365 * DAY_S,
}
POINTS = 240
"""Of every curve: as many as a chart has room for, and no page becomes heavy by them."""
WORST, LATEST = 10, 10
FIRST_LOOKED_AT: tuple[QuantityName, ...] = (
    "ambiguous_share",
    "unmatched_share",
    "a_priori_angle_deg",
)


def _of_a_batch(name: QuantityName) -> QuantityName:
    if name not in OF_A_BATCH:
        raise ValueError(f"{name} is none of one batch; {', '.join(OF_A_BATCH)} are")
    return name


class SpacecraftQuery(RunQuery):
    """Which stretch: a range that ends with the latest batch, or bounds of its own."""

    range: Range = "day"
    start: Start = None
    end: End = None
    by: Annotated[QuantityName, AfterValidator(_of_a_batch)] | None = None


@dataclass(frozen=True)
class Stretch:
    """The stretch that is shown; `range` is None where the address names bounds."""

    range: Range | None
    start: Utc
    end: Utc

    @property
    def seconds(self) -> float:
        """How long it is."""
        return (self.end.tai_ns - self.start.tai_ns) / 1e9

    def moved(self, by: float, scale: float = 1.0) -> dict[str, str]:
        """The bounds of a stretch beside it (by parts of its length), longer or shorter."""
        middle_s = self.seconds * (0.5 + by)
        half_s = max(self.seconds * scale, 10.0) / 2
        return {
            "start": shifted(self.start, middle_s - half_s).text,
            "end": shifted(self.start, middle_s + half_s).text,
        }


@router.get("/spacecraft/{name}")
def spacecraft_page(
    name: Annotated[str, Path()], query: Annotated[SpacecraftQuery, InQuery()], desk: AtDesk
) -> Response:
    """Trends of one spacecraft in a run, its worst batches, and its latest ones."""
    state = desk.operations.spacecraft_state(name)
    latest = desk.operations.batches(spacecraft=name, run=query.run, limit=LATEST).items
    stretch = _stretch(query, latest)
    by, worst = _worst(desk, name, query, stretch)
    return rendered(
        "spacecraft.html.jinja",
        desk.shell(query.run, "/"),
        name=name,
        description=state["description"],
        latest=latest,
        attitude=_attitude(desk, latest),
        stretch=stretch,
        ranges=list(RANGES_S),
        by=by,
        quantities=OF_A_BATCH,
        worst=worst,
        limits=desk.operations.limits(name),
        history=lambda **more: stretch and _history_address(name, query.run, stretch, more),
    )


def _stretch(query: SpacecraftQuery, latest: list[dict[str, Any]]) -> Stretch | None:
    """What the address asks for; without any batch there is nothing to be shown of."""
    if not latest:
        return None
    # The latest batch belongs to the stretch, whose end does not.
    end = query.end or shifted(parse_utc(latest[0]["time"]), 0.001)
    start = query.start or shifted(end, -RANGES_S[query.range])
    return Stretch(None if query.start or query.end else query.range, start, end)


def _worst(
    desk: Desk, name: str, query: SpacecraftQuery, stretch: Stretch | None
) -> tuple[QuantityName, list[dict[str, Any]]]:
    """The worst batches and by what: unless asked otherwise, by the first that shows anything."""
    if stretch is None:
        return query.by or FIRST_LOOKED_AT[0], []
    asked = (query.by,) if query.by else FIRST_LOOKED_AT
    found: dict[QuantityName, list[dict[str, Any]]] = {}
    for by in asked:
        found[by] = desk.operations.worst_batches(
            name, by=by, run=query.run, start=stretch.start, end=stretch.end, limit=WORST
        )
        if found[by] and found[by][0]["value"]:
            return by, found[by]
    return asked[0], found[asked[0]]


def _attitude(desk: Desk, latest: list[dict[str, Any]]) -> Any:
    """The attitude of the latest batch, None where that has none, whatever came before."""
    if not latest or latest[0]["status"] is None:
        return None
    return desk.operations.batch(latest[0]["id"])["answer"]["attitude"]


def _history_address(name: str, run: str, stretch: Stretch, more: dict[str, Any]) -> str:
    asked: dict[str, object] = {} if run == LIVE else {"run": run}
    asked |= {"start": stretch.start.text, "end": stretch.end.text, "size": POINTS} | more
    return f"/api/v1/spacecraft/{quote(name)}/history?{urlencode(asked)}"
