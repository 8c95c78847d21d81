"""Page of one spacecraft: trends over a period, and its worst batches."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlencode

from pydantic import Field, ValidationInfo, field_validator
from starlette.responses import Response

from service.contract.alarms import Alarm, Annotation, Limit
from service.contract.answers import Summary
from service.contract.base import Page
from service.contract.spacecraft import MissionThen, Ranking
from service.observations.schema import LIVE, Key
from service.storage.queries.fleet_rows import out_of_limits
from service.times import (
    DAY_S,
    HOUR_S,
    Utc,
    parse_utc,
    recorded_utc,
    shifted,
)
from service.trends.quantities import (
    QUANTITIES,
    RankedName,
    ranked_names,
    trend_names,
)
from service.web.console.formatting import completed_utc, second_after
from service.web.console.page import ContextDep, FromQuery, PageContext, PageQuery, console_page
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
"""Length of a period that ends with the latest batch: by name, or such as `6h`."""
BEFORE_S = {"day": DAY_S, "week": 7 * DAY_S}
"""Offsets in seconds of an earlier period for comparison, by name."""
WORST = 10
MOST_BESIDE = 4
Vertical = Literal["robust", "all", "log"]
VERTICAL: dict[Vertical, str] = {
    "robust": "robust, outliers at the edge",
    "all": "all values",
    "log": "logarithmic",
}
ANNOTATIONS = 100
FIRST_LOOKED_AT = "ambiguous_share", "unmatched_share"


class SpacecraftQuery(PageQuery):
    """Query that selects a period: a range before the latest batch, or explicit bounds.

    By default it is a day of live batches, or the shortest range that contains a named run.
    """

    range: Range | None = None
    start: Start = None
    end: End = None
    by: RankedName | None = None
    tracker: Key | None = None
    y: Vertical = "robust"
    beside: list[Annotated[str, Field(max_length=300)]] = Field(default_factory=list)
    """Other spacecraft in the same charts; one text may name several, separated by commas."""
    before: Literal["", "day", "week"] = ""
    """Offset of the earlier period that charts draw in grey."""

    @property
    def others(self) -> list[str]:
        """Other spacecraft, as many as charts can distinguish."""
        names = (name.strip() for name in ",".join(self.beside).split(","))
        return list(dict.fromkeys(filter(None, names)))[:MOST_BESIDE]

    @property
    def kept(self) -> dict[str, str | None]:
        """Query parameters that stay in the address while the period changes."""
        return {
            "by": self.by,
            "tracker": self.tracker,
            "y": self.y if self.y != "robust" else None,
            "beside": ",".join(self.others) or None,
            "before": self.before or None,
        }

    @field_validator("start", "end", "range", mode="before")
    @classmethod
    def _without_empty_fields(cls, value: object, info: ValidationInfo) -> object:
        """Treat an empty field of the form as missing."""
        is_time = info.field_name != "range" and isinstance(value, str) and value
        return completed_utc(str(value)) if is_time else value or None


def range_s(text: str) -> int:
    """Length in seconds of a period given by name, or such as `6h`."""
    if text in RANGES_S:
        return RANGES_S[text]
    number = text.rstrip("".join(UNITS_S))
    return int(number) * UNITS_S[text.removeprefix(number)]


@dataclass(frozen=True)
class ShownPeriod:
    """Period shown on a page; `range` is None if the address has explicit bounds."""

    range: str | None
    start: Utc
    end: Utc

    @property
    def seconds(self) -> float:
        """Length of the period in seconds."""
        return (self.end.tai_ns - self.start.tai_ns) / 1e9

    @property
    def address(self) -> dict[str, str]:
        """Query parameters that select the period."""
        if self.range:
            return {"range": self.range}
        return {"start": self.start.text, "end": self.end.text}

    def moved(self, by: float, scale: float = 1.0) -> dict[str, str]:
        """Bounds of a period moved by parts of its length, longer or shorter."""
        middle_s = self.seconds * (0.5 + by)
        half_s = max(self.seconds * scale, 10.0) / 2
        return {
            "start": shifted(self.start, middle_s - half_s).text,
            "end": shifted(self.start, middle_s + half_s).text,
        }


@dataclass(frozen=True)
class DrawnLimits:
    """Limits for charts, and the periods in which quantities were out of them."""

    limits: list[Limit]
    out: list[dict[str, Any]]


@console_page("/spacecraft/{name}", "Spacecraft", Policy("read", "path"), section="/")
def spacecraft_page(name: str, query: FromQuery[SpacecraftQuery], context: ContextDep) -> Response:
    """Page of one spacecraft in a run: trends, and worst batches."""
    state = context.app.spacecraft.state(name, query.run, context.caller.spacecraft)
    latest = context.app.results.page(spacecraft=name, run=query.run, limit=1).items
    stretch = shown_period(context, name, query, latest)
    trackers = context.app.context.trackers(name)
    ranking = _worst(context, name, query, stretch)
    notes = _annotations(context, name, stretch)
    ranked = [each for each in ranked_names() if not query.tracker or QUANTITIES[each].by_tracker]
    drawn_limits: list[DrawnLimits] = context.panels(
        "spacecraft_page", name, query.run, query.tracker, stretch
    )
    before = _before(name, query, stretch)
    return context.rendered(
        "spacecraft.html.jinja",
        query.run,
        name=name,
        state=state,
        out_now=_alarms_now(context, name, query),
        latest=latest,
        stretch=stretch,
        ranges=list(RANGES_S),
        by=ranking.by,
        trackers=trackers,
        tracker=query.tracker,
        not_split=ranking.not_split is True,
        quantities=ranked,
        charts=charts(query.tracker),
        alarms=[span for drawn in drawn_limits for span in drawn.out],
        worst=ranking.items,
        limits=[limit for drawn in drawn_limits for limit in drawn.limits],
        query=query,
        before=before,
        why=context.panels("ambiguity", name, query.run, stretch, before) if before else [],
        vertical=VERTICAL,
        others=_others(context, query, stretch),
        spacecraft=sorted(
            set(context.spacecraft) - {name}, key=lambda each: (each not in query.others, each)
        ),
        most_beside=MOST_BESIDE,
        changes=_changes(context, name, state.history, query, stretch),
        annotations=sorted(notes.items, key=lambda each: recorded_utc(each.start).tai_ns),
        more_annotations=notes.next_cursor is not None,
        may_write=context.may_operate,
        may_write_of_all=context.caller.spacecraft is None,
        history=lambda **more: (
            stretch
            and history_address(name, query.run, query.tracker, stretch.start, stretch.end, **more)
        ),
    )


def _alarms_now(context: PageContext, name: str, query: SpacecraftQuery) -> list[Alarm]:
    """Alarms out of limits and not shelved, the worst first; those of the shown tracker before."""
    found = out_of_limits(context.app.spacecraft.alarms(query.run))
    own = [each for each in found if each.spacecraft == name]
    return sorted(own, key=lambda each: query.tracker not in (None, each.tracker))


def shown_period(
    context: PageContext, name: str, query: SpacecraftQuery, latest: list[Summary] | None = None
) -> ShownPeriod | None:
    """Period that the address selects; None without any batch.

    It ends with the first of the `latest` batches, which are read if not given.
    """
    if latest is None:
        latest = context.app.results.page(spacecraft=name, run=query.run, limit=1).items
    if not latest:
        return None
    if query.range and query.start and query.end:
        # A length that is typed beside both ends replaces them.
        query = query.model_copy(update={"start": None, "end": None})
    end = query.end or second_after(latest[0].time)
    if query.start or query.end:
        start = query.start or shifted(end, -range_s(query.range or "day"))
        return ShownPeriod(None, start, end)
    chosen = query.range or _fitting_range(context, name, query.run, end)
    return ShownPeriod(chosen, shifted(end, -range_s(chosen)), end)


def _fitting_range(context: PageContext, name: str, run: str, end: Utc) -> Range:
    """Range to show first: the shortest that contains the attitudes of a named run."""
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
    """Worst batches by a quantity: by default the first one whose worst value is not zero."""
    asked = (query.by,) if query.by else FIRST_LOOKED_AT
    if stretch is None:
        return Ranking(by=asked[0], items=[])
    found = []
    for by in asked:
        ranking = context.app.spacecraft.ranking(
            name,
            by=by,
            run=query.run,
            start=stretch.start,
            end=stretch.end,
            limit=WORST,
            tracker=query.tracker,
        )
        if ranking.items and ranking.items[0].value:
            return ranking
        found.append(ranking)
    return found[0]


def _others(context: PageContext, query: SpacecraftQuery, stretch: ShownPeriod | None) -> list[str]:
    """Addresses of the histories of other spacecraft; raises for an unknown one."""
    for other in query.others:
        context.caller.require(other)
        context.app.context.mission(other)
    if stretch is None:
        return []
    return [
        history_address(other, query.run, None, stretch.start, stretch.end)
        for other in query.others
    ]


@dataclass(frozen=True)
class PeriodBefore:
    """History of an earlier period of equal length, and the offset in time."""

    history: str
    shift_s: int


def _before(name: str, query: SpacecraftQuery, shown: ShownPeriod | None) -> PeriodBefore | None:
    if shown is None or not query.before:
        return None
    shift_s = BEFORE_S[query.before]
    start, end = (shifted(each, -float(shift_s)) for each in (shown.start, shown.end))
    return PeriodBefore(history_address(name, query.run, query.tracker, start, end), shift_s)


@dataclass(frozen=True)
class Change:
    """Change within the shown period: settings in force, or a result; with the page about it."""

    since: str
    text: str
    title: str
    path: str
    query: Mapping[str, str] = field(default_factory=dict)


def _changes(
    context: PageContext,
    name: str,
    history: Sequence[MissionThen],
    query: SpacecraftQuery,
    stretch: ShownPeriod | None,
) -> list[Change]:
    """Changes of settings of live batches, and adopted results, in a period and the one before."""
    if stretch is None:
        return []
    earliest = shifted(stretch.start, -float(BEFORE_S.get(query.before, 0)))
    found = []
    for row, signature in context.app.results.adopted(name, query.run, earliest, stretch.end):
        what = f"What-if of batch {row['batch']} adopted"
        if signature is not None:
            what += f" by {signature.who}" + (f": {signature.comment}" if signature.comment else "")
        found.append(Change(row["time"], what, "batch", f"/batches/{row['id']}"))
    if query.run == LIVE:
        found += _changes_of_settings(context, name, history, earliest, stretch.end)
    return sorted(found, key=lambda each: recorded_utc(each.since).tai_ns)


def _changes_of_settings(
    context: PageContext, name: str, history: Sequence[MissionThen], start: Utc, end: Utc
) -> Iterator[Change]:
    adopted = {each.adopted[:19]: each for each in context.app.adoptions.in_force(name).history}
    for each in history[1:]:
        if not start.tai_ns <= recorded_utc(each.since).tai_ns < end.tai_ns:
            continue
        adoption = adopted.get(each.since[:19])
        what = "Settings changed with the mission file"
        if adoption is not None:
            version = adoption.version
            what = "The mission file" if version is None else f"Calibration version {version}"
            what += f" adopted by {adoption.who}"
            what += f": {adoption.note}" if adoption.note else ""
        yield Change(each.since, what, "settings", "/missions", {"spacecraft": name})


def _annotations(context: PageContext, name: str, stretch: ShownPeriod | None) -> Page[Annotation]:
    """Annotations that touch the shown period."""
    if stretch is None:
        return Page([], None)
    return context.app.annotations.page(
        spacecraft=name, start=stretch.start, end=stretch.end, limit=ANNOTATIONS
    )


POINTS = 240
"""Greatest number of points of a curve: as many as a chart can show."""
CHARTS: Sequence[tuple[str, str, tuple[str, ...]]] = (
    ("stars", "Ambiguous and unmatched stars", ("ambiguous_share", "unmatched_share")),
    (
        "batches",
        "Batches without an attitude, or with a suspect one",
        ("no_attitude_share", "suspect_share"),
    ),
    ("residual", "Residual rms and predicted rms", ("residual_rms_arcsec", "predicted_rms_arcsec")),
    ("magnitude", "Magnitude offset, observed minus catalog", ("magnitude_offset_mag",)),
    ("scale", "Scale offset, observed over catalog", ("scale_offset_ppm",)),
    ("alignment", "Angle between trackers, observed minus catalog", ("alignment_offset_arcsec",)),
    ("a-priori", "Angle from the a priori attitude", ("a_priori_angle_deg",)),
    ("rate", "Batches per hour", ("batches_per_hour",)),
)
"""Id, title and quantities of the charts; every other quantity has a chart of its own."""
UNITS = {"1": "", "arcsec": "″", "deg": "°", "mag": " mag", "ppm": " ppm"}


TRACKER_CHARTS = {"batches": "Batches in which the tracker disagrees with the others"}
"""Chart titles that differ for the quantities of one tracker."""


def charts(tracker: str | None = None) -> list[dict[str, Any]]:
    """Charts of all quantities with a history or, for a tracker, of those that trackers have."""
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


def charts_by_quantity() -> dict[str, dict[str, Any]]:
    """Chart of each quantity that has a history."""
    return {
        quantity["name"]: chart
        | {"title": quantity["label"].capitalize(), "quantities": [quantity]}
        for chart in charts()
        for quantity in chart["quantities"]
    }


def _chart(id: str, title: str, names: Sequence[str]) -> dict[str, Any]:
    first = QUANTITIES[names[0]]
    return {
        "id": id,
        "title": title,
        "percent": first.is_share,
        "unit": " %" if first.is_share else UNITS.get(first.unit, f" {first.unit}"),
        "quantities": [{"name": name, "label": QUANTITIES[name].label} for name in names],
    }


def history_address(
    name: str, run: str, tracker: str | None, start: Utc, end: Utc, **more: object
) -> str:
    """Address from which the charts read the history of a period."""
    asked: dict[str, object] = {} if run == LIVE else {"run": run}
    if tracker:
        asked["tracker"] = tracker
    asked |= {"start": start.text, "end": end.text, "size": POINTS} | more
    return f"/api/v1/spacecraft/{quote(name)}/history?{urlencode(asked)}"
