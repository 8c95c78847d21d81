"""The page of one spacecraft: trends over a period, its worst and its latest batches."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import quote, urlencode

from fastapi import Path
from fastapi import Query as InQuery
from msgspec import structs
from pydantic import Field, ValidationInfo, field_validator
from starlette.responses import Response

from service.alarms.quantities import QUANTITIES, RankedName, ranked_names, trend_names
from service.alarms.subjects import limited_trackers
from service.app.products import TABLE_KINDS
from service.observations.schema import Key
from service.products.formats import attitude_formats, table_formats
from service.storage.models.annotations import Annotation
from service.storage.models.answers import Summary
from service.storage.models.base import Page
from service.storage.models.trends import Ranking
from service.times import DAY_S, HOUR_S, Utc, parse_utc, recorded_utc, shifted
from service.web.console.page_context import LIVE, ContextDep, PageContext, PageQuery
from service.web.console.registry import console_page
from service.web.console.rendering import rendered
from service.web.requests.access import Policy
from service.web.requests.query_parameters import End, Start

RANGES_S: dict[str, int] = {
    "hour": HOUR_S,
    "day": DAY_S,
    "week": 7 * DAY_S,
    "month": 30 * DAY_S,
    "year": 365 * DAY_S,
}
UNITS_S = {"min": 60, "h": HOUR_S, "d": DAY_S, "w": 7 * DAY_S}
Range = Annotated[
    str, Field(pattern=rf"^({'|'.join(RANGES_S)}|[1-9][0-9]{{0,3}}({'|'.join(UNITS_S)}))$")
]
"""The length of a period that ends with the latest batch: by its name, or such as `6h`."""
POINTS = 240
"""The most points of a curve: as many as a chart can show."""
WORST, LATEST = 10, 10
ANNOTATIONS = 100
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
    ("scale", "Scale offset, observed over catalog", ("scale_offset_ppm",)),
    ("alignment", "Angle between trackers, observed minus catalog", ("alignment_offset_arcsec",)),
    ("a-priori", "Angle from the a priori attitude", ("a_priori_angle_deg",)),
    ("rate", "Batches per hour", ("batches_per_hour",)),
)
"""Id, title and quantities of the charts; every other quantity gets one of its own."""
UNITS = {"arcsec": "″", "deg": "°", "mag": " mag", "ppm": " ppm"}


TRACKER_CHARTS = {"batches": "Batches in which the tracker disagrees with the others"}
"""Titles that differ for the quantities of one tracker."""


def charts(tracker: str | None = None) -> list[dict[str, Any]]:
    """The charts of every quantity that has a history, or that a tracker has."""
    shown = {name for _, _, names in CHARTS for name in names}
    others = [
        (name.replace("_", "-"), QUANTITIES[name].label.capitalize(), (name,))
        for name in trend_names()
        if name not in shown
    ]
    if tracker is None:
        return [_chart(*each) for each in (*CHARTS, *others)]
    of_tracker = [
        (id, TRACKER_CHARTS.get(id, title), [name for name in names if QUANTITIES[name].by_tracker])
        for id, title, names in (*CHARTS, *others)
    ]
    return [_chart(*each) for each in of_tracker if each[-1]]


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
    """Which period: a range that ends with the latest batch, or explicit bounds.

    Without any, a day of live batches, and of a named run the shortest range that holds it.
    """

    range: Range | None = None
    start: Start = None
    end: End = None
    by: RankedName | None = None
    tracker: Key | None = None

    @field_validator("start", "end", "range", mode="before")
    @classmethod
    def _without_empty_fields(cls, value: object, info: ValidationInfo) -> object:
        """A field of the form that was left empty counts as not given."""
        default = cls.model_fields[info.field_name or ""].default
        return default if value == "" else value


def range_s(text: str) -> int:
    """The length of a range."""
    if text in RANGES_S:
        return RANGES_S[text]
    number = text.rstrip("".join(UNITS_S))
    return int(number) * UNITS_S[text.removeprefix(number)]


@dataclass(frozen=True)
class ShownPeriod:
    """The shown period; `range` is None where the address has explicit bounds."""

    range: str | None
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
    state = context.app.spacecraft.state(name, query.run)
    latest = context.app.results.page(spacecraft=name, run=query.run, limit=LATEST).items
    stretch = shown_period(context, name, query, latest)
    mission, trackers = context.app.context.known[name], context.app.context.trackers(name)
    ranking = _worst(context, name, query, stretch)
    notes = _annotations(context, name, stretch)
    ranked = [each for each in ranked_names() if not query.tracker or QUANTITIES[each].by_tracker]
    return rendered(
        "spacecraft.html.jinja",
        context.layout(query.run),
        name=name,
        description=state.description,
        retired=state.retired,
        latest=latest,
        tracking=state.tracking,
        attitude=_attitude(context, latest),
        stretch=stretch,
        ranges=list(RANGES_S),
        by=ranking.by,
        trackers=trackers,
        tracker=query.tracker,
        not_split=ranking.not_split is True,
        quantities=ranked,
        charts=charts(query.tracker),
        alarms=_alarms(context, name, query, stretch),
        worst=ranking.items,
        limits=context.app.limits.all(
            name, query.tracker if query.tracker in limited_trackers(mission) else None
        ),
        formats=table_formats(),
        attitude_formats=attitude_formats(),
        table_kinds=TABLE_KINDS,
        file=lambda product, format: (
            stretch and _file_address(name, query, stretch, product, format)
        ),
        annotations=sorted(notes.items, key=lambda each: recorded_utc(each.start).tai_ns),
        more_annotations=notes.next_cursor is not None,
        may_write="operate" in context.caller.scopes,
        may_write_of_all=context.caller.spacecraft is None,
        history=lambda **more: stretch and _history_address(name, query, stretch, more),
    )


def shown_period(
    context: PageContext, name: str, query: SpacecraftQuery, latest: list[Summary]
) -> ShownPeriod | None:
    """The period that the address names; None without any batch."""
    if not latest:
        return None
    # The latest batch belongs to the stretch, whose end does not.
    end = query.end or shifted(parse_utc(latest[0].time), 0.001)
    if query.start or query.end:
        start = query.start or shifted(end, -range_s(query.range or "day"))
        return ShownPeriod(None, start, end)
    chosen = query.range or _fitting_range(context, name, query.run, end)
    return ShownPeriod(chosen, shifted(end, -range_s(chosen)), end)


def _fitting_range(context: PageContext, name: str, run: str, end: Utc) -> Range:
    """The range to show first: the shortest that holds the attitudes of a named run."""
    if run == LIVE:
        return "day"
    first = context.app.spacecraft.attitudes(name, run=run, limit=1).items
    if not first:
        return "day"
    length_s = (end.tai_ns - parse_utc(first[0].time).tai_ns) / 1e9
    return next((each for each, width_s in RANGES_S.items() if width_s >= length_s), "year")


def _worst(
    context: PageContext, name: str, query: SpacecraftQuery, stretch: ShownPeriod | None
) -> Ranking:
    """The worst batches by a quantity: by default the first one with a value above zero."""
    asked = (query.by,) if query.by else FIRST_LOOKED_AT
    if query.tracker and not query.by:
        asked = tuple(by for by in FIRST_LOOKED_AT if QUANTITIES[by].by_tracker)
    if stretch is None:
        return Ranking(by=asked[0], items=[])
    found = []
    for by in asked:
        found.append(
            context.app.spacecraft.ranking(
                name,
                by=by,
                run=query.run,
                start=stretch.start,
                end=stretch.end,
                limit=WORST,
                tracker=query.tracker,
            )
        )
        if found[-1].items and found[-1].items[0].value:
            return found[-1]
    return found[0]


def _alarms(
    context: PageContext, name: str, query: SpacecraftQuery, stretch: ShownPeriod | None
) -> list[dict[str, Any]]:
    """When alarms were out of their limits; with a tracker, its own and those of all trackers."""
    if stretch is None:
        return []
    found = context.app.alarms.of_period(name, query.run, stretch.start, stretch.end)
    return [
        structs.asdict(each)
        for each in found
        if query.tracker is None or each.tracker in (None, query.tracker)
    ]


def _attitude(context: PageContext, latest: list[Summary]) -> Any:
    """The attitude of the latest batch; None where it has none, even if an earlier one has."""
    if not latest or latest[0].status is None:
        return None
    return context.app.results.get(latest[0].id).answer.attitude


def _annotations(context: PageContext, name: str, stretch: ShownPeriod | None) -> Page[Annotation]:
    """The annotations that touch the shown period."""
    if stretch is None:
        return Page([], None)
    return context.app.annotations.page(
        spacecraft=name, start=stretch.start, end=stretch.end, limit=ANNOTATIONS
    )


def _history_address(
    name: str, query: SpacecraftQuery, stretch: ShownPeriod, more: dict[str, Any]
) -> str:
    asked: dict[str, object] = {} if query.run == LIVE else {"run": query.run}
    if query.tracker:
        asked["tracker"] = query.tracker
    asked |= {"start": stretch.start.text, "end": stretch.end.text, "size": POINTS} | more
    return f"/api/v1/spacecraft/{quote(name)}/history?{urlencode(asked)}"


def _file_address(
    name: str, query: SpacecraftQuery, stretch: ShownPeriod, product: str, format: str
) -> str:
    """The address of a product of the shown period as a file."""
    asked = {
        "run": query.run,
        "start": stretch.start.text,
        "end": stretch.end.text,
        "format": format,
    }
    return f"/api/v1/spacecraft/{quote(name)}/{product}?{urlencode(asked)}"
