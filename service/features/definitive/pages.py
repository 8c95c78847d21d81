"""Console page for the definitive attitude of a spacecraft."""

from dataclasses import dataclass

from starlette.responses import Response

from service.features.definitive.chart_panels import Chart, Strip, strips
from service.features.definitive.charts import definitive_charts, innovation_charts
from service.features.definitive.part import Definitive
from service.features.definitive.period import DefinitivePeriod
from service.storage.queries.definitive import MOST_BLOCKS
from service.times import DAY_S, Utc, bucket_start, shifted
from service.web.console.charts.panels import TimeAxis
from service.web.console.page import ContextDep, FromQuery, console_page
from service.web.console.pages.period import without_gyro
from service.web.console.pages.spacecraft_page import (
    RANGES_S,
    ShownPeriod,
    SpacecraftQuery,
    shown_period,
)
from service.web.requests.access import Policy

JOBS = 8
"""Number of latest jobs listed on the page."""


@dataclass(frozen=True)
class Drawn:
    """Charts and strips of a period, ready to be drawn."""

    found: DefinitivePeriod
    charts: list[Chart]
    innovations: list[Chart]
    strips: list[Strip]
    ticks: list[tuple[float, str]]
    """Tick marks of the time axis: percent from the left, and text."""


@console_page(
    "/spacecraft/{name}/grades", "Definitive attitude", Policy("read", "path"), section="/"
)
def definitive_page(name: str, query: FromQuery[SpacecraftQuery], context: ContextDep) -> Response:
    """Console page with filtered and smoothed attitudes of a spacecraft, and their measurements."""
    definitive, mission = context.app.part(Definitive), context.app.context.mission(name)
    shown = shown_period(context, name, query)
    drawn = None
    if shown is not None:
        found = definitive.days.of_period(name, query.run, shown.start, shown.end)
        if found is not None:
            axis = TimeAxis(shown.start, shown.end)
            met = found.innovations
            drawn = Drawn(
                found,
                definitive_charts(found, axis, mission.trackers[0]),
                [] if met is None else innovation_charts(met, axis),
                strips(found, axis),
                axis.ticks(),
            )
    return context.rendered(
        "definitive.html.jinja",
        query.run,
        name=name,
        missing=without_gyro(context, name, query.run, shown) if shown else "",
        whole_days=_whole_days(shown) if shown else (),
        stretch=shown,
        ranges=list(RANGES_S),
        drawn=drawn,
        most_blocks=MOST_BLOCKS,
        jobs=definitive.jobs.all(name)[:JOBS],
    )


def _whole_days(shown: ShownPeriod) -> tuple[Utc, Utc]:
    """Beginning and end of the UTC days that a period touches; of a day up to now, the last one."""
    last = shifted(shown.end, -0.001).bucket(DAY_S)
    first = last if shown.range == "day" else shown.start.bucket(DAY_S)
    return bucket_start(first, DAY_S), bucket_start(last + 1, DAY_S)
