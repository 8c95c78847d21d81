"""Pages for a period of a spacecraft: stars and attitudes, and the definitive attitude."""

from dataclasses import dataclass

from starlette.responses import Response

from service.storage.queries.period import TrackerStarsOfPeriod
from service.web.console.charts.all_sky import all_sky_chart
from service.web.console.charts.attitude import attitude_charts
from service.web.console.charts.focal_plane import FocalPlaneMap, focal_plane_map
from service.web.console.charts.histogram import (
    Histogram,
    MagnitudeChart,
    magnitude_chart,
    residual_histogram,
)
from service.web.console.page import ContextDep, FromQuery, PageContext, console_page
from service.web.console.pages.spacecraft_page import (
    RANGES_S,
    ShownPeriod,
    SpacecraftQuery,
    shown_period,
)
from service.web.requests.access import Policy


@dataclass(frozen=True)
class TrackerCharts:
    """Charts of one tracker; None for each without data."""

    tracker: str
    sigma_arcsec: float
    focal_plane: FocalPlaneMap | None
    histogram: Histogram | None
    magnitudes: MagnitudeChart | None


@console_page(
    "/spacecraft/{name}/period", "Sky, residuals, rates", Policy("read", "path"), section="/"
)
def period_page(name: str, query: FromQuery[SpacecraftQuery], context: ContextDep) -> Response:
    """Page with pointing of each tracker, fit of its stars, and rates of the spacecraft."""
    mission = context.app.context.mission(name)
    retired = context.app.context.retired.trackers.get(name, ())
    if query.tracker is not None and query.tracker not in retired:
        mission.tracker(query.tracker, "tracker")
    shown = shown_period(context, name, query)
    found, trackers = None, list[TrackerStarsOfPeriod]()
    if shown is not None:
        found = context.app.results.period(name, run=query.run, start=shown.start, end=shown.end)
        trackers = [each for each in found.trackers if query.tracker in (None, each.tracker)]
    is_any = found is not None and found.read > 0
    return context.rendered(
        "period.html.jinja",
        query.run,
        name=name,
        tracker=query.tracker,
        tracker_names=[*(each.name for each in mission.trackers), *retired],
        stretch=shown,
        ranges=list(RANGES_S),
        found=found,
        panels=context.panels("period_page", name, query.run, shown, found)
        if is_any and found and shown
        else [],
        sky=all_sky_chart(found, trackers) if is_any and found else None,
        trackers=[_tracker_charts(each) for each in trackers],
        attitude=attitude_charts(found.attitudes, shown.start, shown.end)
        if found and shown
        else [],
    )


def _tracker_charts(tracker: TrackerStarsOfPeriod) -> TrackerCharts:
    return TrackerCharts(
        tracker=tracker.tracker,
        sigma_arcsec=tracker.sigma_arcsec,
        focal_plane=focal_plane_map(tracker),
        histogram=residual_histogram(tracker),
        magnitudes=magnitude_chart(tracker),
    )


def without_gyro(context: PageContext, name: str, run: str, shown: ShownPeriod) -> str:
    """Sentences that no gyro data exist in a period, and on the effect; empty if there are any."""
    if context.app.gyro.page(name, run=run, start=shown.start, end=shown.end, limit=1).items:
        return ""
    mission = context.app.context.known[name]
    told = "" if mission.gyro else ", and the mission file has no table [gyro]"
    return (
        f"There are no gyro data in this period{told}. Without them the filter takes the rate for "
        "constant: where the spacecraft turns, or batches are far apart, none of its attitudes is "
        "good. The raw attitudes, one for each batch, do not need a gyro."
    )
