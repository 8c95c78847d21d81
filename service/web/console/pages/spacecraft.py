"""The page of one spacecraft: trends over a period, its worst and its latest batches."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlencode

from fastapi import Path
from fastapi import Query as InQuery
from starlette.responses import Response

from service.alarms.quantities import QUANTITIES, RankedName, ranked_names, trend_names
from service.app.output_formats import OUTPUT_FORMATS
from service.storage.models.answers import Summary
from service.storage.models.trends import RankedBatch
from service.times import DAY_S, HOUR_S, Utc, parse_utc, shifted
from service.web.console.page_context import LIVE, ContextDep, PageContext, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy
from service.web.requests.query_parameters import End, Start

Range = Literal["hour", "day", "month", "year"]
RANGES_S: dict[Range, int] = {
    "hour": HOUR_S,
    "day": DAY_S,
    "month": 30 * DAY_S,
    "year": 365 * DAY_S,
}
POINTS = 240
"""The most points of a curve: as many as a chart can show."""
WORST, LATEST = 10, 10
FIRST_LOOKED_AT: tuple[RankedName, ...] = (
    "ambiguous_share",
    "unmatched_share",
    "a_priori_angle_deg",
)


CHARTS: Sequence[tuple[str, str, tuple[str, ...]]] = (
    ("stars", "Ambiguous and unmatched stars", ("ambiguous_share", "unmatched_share")),
    (
        "batches",
        "Batches without an attitude, or with a suspect one",
        ("no_attitude_share", "suspect_share"),
    ),
    (
        "residual",
        "Residual rms and predicted rms",
        ("residual_rms_arcsec", "predicted_rms_arcsec"),
    ),
    ("magnitude", "Magnitude offset, observed minus catalog", ("magnitude_offset_mag",)),
    ("a-priori", "Angle from the a priori attitude", ("a_priori_angle_deg",)),
    ("rate", "Batches per hour", ("batches_per_hour",)),
)
"""Id, title and quantities of the charts; every other quantity gets one of its own."""
UNITS = {"arcsec": "″", "deg": "°", "mag": " mag"}


def charts() -> list[dict[str, Any]]:
    """The charts of every quantity that has a history."""
    shown = {name for _, _, names in CHARTS for name in names}
    others = [
        (name.replace("_", "-"), QUANTITIES[name].label.capitalize(), (name,))
        for name in trend_names()
        if name not in shown
    ]
    return [_chart(*each) for each in (*CHARTS, *others)]


def _chart(id: str, title: str, names: Sequence[str]) -> dict[str, Any]:
    first = QUANTITIES[names[0]]
    return {
        "id": id,
        "title": title,
        "percent": first.is_share,
        "unit": " %" if first.is_share else UNITS.get(first.unit, ""),
        "quantities": [{"name": name, "label": QUANTITIES[name].label} for name in names],
    }


class SpacecraftQuery(PageQuery):
    """Which period: a range that ends with the latest batch, or explicit bounds."""

    range: Range = "day"
    start: Start = None
    end: End = None
    by: RankedName | None = None


@dataclass(frozen=True)
class ShownPeriod:
    """The shown period; `range` is None where the address has explicit bounds."""

    range: Range | None
    start: Utc
    end: Utc

    @property
    def seconds(self) -> float:
        """Its length."""
        return (self.end.tai_ns - self.start.tai_ns) / 1e9

    def moved(self, by: float, scale: float = 1.0) -> dict[str, str]:
        """The bounds of a period moved by parts of its length, longer or shorter."""
        middle_s = self.seconds * (0.5 + by)
        half_s = max(self.seconds * scale, 10.0) / 2
        return {
            "start": shifted(self.start, middle_s - half_s).text,
            "end": shifted(self.start, middle_s + half_s).text,
        }


@console_page("/spacecraft/{name}", "Spacecraft", Policy("read", "path"), section="/")
def spacecraft_page(
    name: Annotated[str, Path()], query: Annotated[SpacecraftQuery, InQuery()], context: ContextDep
) -> Response:
    """Trends of one spacecraft in a run, its worst batches, and its latest ones."""
    state = context.app.spacecraft.state(name)
    latest = context.app.results.page(spacecraft=name, run=query.run, limit=LATEST).items
    stretch = _shown_period(query, latest)
    by, worst = _worst(context, name, query, stretch)
    return rendered(
        "spacecraft.html.jinja",
        context.layout(query.run),
        name=name,
        description=state.description,
        latest=latest,
        attitude=_attitude(context, latest),
        stretch=stretch,
        ranges=list(RANGES_S),
        by=by,
        quantities=ranked_names(),
        charts=charts(),
        worst=worst,
        limits=context.app.limits.all(name),
        formats=OUTPUT_FORMATS,
        history=lambda **more: stretch and _history_address(name, query.run, stretch, more),
    )


def _shown_period(query: SpacecraftQuery, latest: list[Summary]) -> ShownPeriod | None:
    """The period that the address names; None without any batch."""
    if not latest:
        return None
    # The latest batch belongs to the stretch, whose end does not.
    end = query.end or shifted(parse_utc(latest[0].time), 0.001)
    start = query.start or shifted(end, -RANGES_S[query.range])
    return ShownPeriod(None if query.start or query.end else query.range, start, end)


def _worst(
    context: PageContext, name: str, query: SpacecraftQuery, stretch: ShownPeriod | None
) -> tuple[RankedName, list[RankedBatch]]:
    """The worst batches and their quantity: by default the first one with a value above zero."""
    if stretch is None:
        return query.by or FIRST_LOOKED_AT[0], []
    asked = (query.by,) if query.by else FIRST_LOOKED_AT
    found: dict[RankedName, list[RankedBatch]] = {}
    for by in asked:
        found[by] = context.app.spacecraft.worst_batches(
            name, by=by, run=query.run, start=stretch.start, end=stretch.end, limit=WORST
        )
        if found[by] and found[by][0].value:
            return by, found[by]
    return asked[0], found[asked[0]]


def _attitude(context: PageContext, latest: list[Summary]) -> Any:
    """The attitude of the latest batch; None where it has none, even if an earlier one has."""
    if not latest or latest[0].status is None:
        return None
    return context.app.results.get(latest[0].id).answer.attitude


def _history_address(name: str, run: str, stretch: ShownPeriod, more: dict[str, Any]) -> str:
    asked: dict[str, object] = {} if run == LIVE else {"run": run}
    asked |= {"start": stretch.start.text, "end": stretch.end.text, "size": POINTS} | more
    return f"/api/v1/spacecraft/{quote(name)}/history?{urlencode(asked)}"
