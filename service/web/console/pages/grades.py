"""The page of grades: attitude over time, its sigmas, what the filter met, and the gyro's bias."""

from dataclasses import dataclass

from starlette.responses import Response

from service.products.formats import attitude_formats
from service.storage.grades.period import MOST_BLOCKS, GradesOfPeriod
from service.web.console.charts.grades import grade_charts, innovation_charts
from service.web.console.charts.panels import GradeChart, Strip, TimeAxis, strips
from service.web.console.page import ContextDep, FromQuery, console_page
from service.web.console.pages.spacecraft import RANGES_S, SpacecraftQuery, shown_period
from service.web.requests.access import Policy

JOBS = 8
"""The latest that the page lists."""


@dataclass(frozen=True)
class Drawn:
    """The drawings of a period."""

    found: GradesOfPeriod
    charts: list[GradeChart]
    innovations: list[GradeChart]
    strips: list[Strip]
    ticks: list[tuple[float, str]]
    """The ticks of the time axis: percent from the left, and their text."""


@console_page(
    "/spacecraft/{name}/grades", "Definitive attitude", Policy("read", "path"), section="/"
)
def grades_page(name: str, query: FromQuery[SpacecraftQuery], context: ContextDep) -> Response:
    """Filtered and smoothed attitudes of one spacecraft, and what they were made of."""
    mission = context.app.context.mission(name)
    latest = context.app.results.page(spacecraft=name, run=query.run, limit=1).items
    shown = shown_period(context, name, query, latest)
    drawn = None
    if shown is not None:
        found = context.app.grades.of_period(name, query.run, shown.start, shown.end)
        if found is not None:
            axis = TimeAxis(shown.start, shown.end)
            met = found.innovations
            drawn = Drawn(
                found,
                grade_charts(found, axis, mission.trackers[0]),
                [] if met is None else innovation_charts(met, axis),
                strips(found, axis),
                axis.ticks(),
            )
    return context.rendered(
        "grades.html.jinja",
        query.run,
        name=name,
        has_gyro=mission.gyro is not None,
        stretch=shown,
        ranges=list(RANGES_S),
        drawn=drawn,
        most_blocks=MOST_BLOCKS,
        attitude_formats=attitude_formats(),
        jobs=context.app.definitive.all(name)[:JOBS],
    )
