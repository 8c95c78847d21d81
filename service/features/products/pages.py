"""Console page of export files: attitudes of a period by grade, and tables."""

from dataclasses import dataclass
from itertools import islice
from typing import Annotated
from urllib.parse import quote, urlencode

from pydantic import Field, field_validator
from starlette.responses import Response

from service.features.products.attitude_formats import attitude_formats
from service.features.products.attitudes import AttitudeSeries, ProductGrade
from service.features.products.part import TABLE_KINDS, Products
from service.missions.product_settings import MAX_LARGEST_GAP_S
from service.table_files.formats import TABLE_FORMATS
from service.web.console.page import ContextDep, FromQuery, PageContext, console_page
from service.web.console.pages.period import without_gyro
from service.web.console.pages.spacecraft_page import (
    RANGES_S,
    ShownPeriod,
    SpacecraftQuery,
    shown_period,
)
from service.web.requests.access import Policy

GRADES: dict[ProductGrade, str] = {
    "smoothed": "The definitive attitude: every measurement of the day, before and after each "
    "moment, with the gyro. The most accurate; it exists once the day was smoothed.",
    "filtered": "From the measurements before each moment, with the gyro, as a filter on board "
    "would have it.",
    "raw": "One attitude for each batch, from its stars alone, independent of its neighbours.",
}
MOST_COUNTED = 5_000
"""Greatest number of attitudes read to count intervals; takes about 0.1 s."""
FEW_PER_STRETCH = 10
"""Least mean number of attitudes per interval for a file that is useful for interpolation."""


class FilesQuery(SpacecraftQuery):
    """Query of the files page: period and largest gap; empty: from the mission or the cadence."""

    gap_s: Annotated[float | None, Field(gt=0, le=MAX_LARGEST_GAP_S)] = None

    @field_validator("gap_s", mode="before")
    @classmethod
    def _without_empty_gap(cls, value: object) -> object:
        return None if value == "" else value


@dataclass(frozen=True)
class GradeOfFile:
    """Summary of one grade of attitudes in a period: number, intervals, largest gap.

    `missing` is the reason for having none, if known.

    `is_cut` is true if only the first `MOST_COUNTED` attitudes were counted.
    """

    grade: ProductGrade
    what: str
    missing: str
    attitudes: int
    stretches: int
    largest_gap_s: float
    is_cut: bool

    @property
    def is_shattered(self) -> bool:
        """True if a file has several intervals, and more than a tenth as many as attitudes."""
        return self.stretches * FEW_PER_STRETCH > self.attitudes and self.stretches > 1


@console_page("/spacecraft/{name}/files", "Files", Policy("read", "path"), section="/")
def files_page(name: str, query: FromQuery[FilesQuery], context: ContextDep) -> Response:
    """Console page with export files of a period: attitudes by grade and format, and tables."""
    context.app.context.mission(name)
    shown = shown_period(context, name, query)

    def address(product: str, format: str, **more: str) -> str:
        assert shown is not None
        asked = {
            "run": query.run,
            "start": shown.start.text,
            "end": shown.end.text,
            "format": format,
        }
        if product == "attitude" and query.gap_s is not None:
            asked["largest_gap_s"] = f"{query.gap_s:g}"
        return f"/api/v1/spacecraft/{quote(name)}/{product}?{urlencode(asked | more)}"

    return context.rendered(
        "files.html.jinja",
        query.run,
        name=name,
        query=query,
        stretch=shown,
        ranges=list(RANGES_S),
        grades=_grades(context, name, query, shown) if shown else [],
        attitude_formats=attitude_formats(),
        formats=TABLE_FORMATS,
        table_kinds=TABLE_KINDS,
        most_counted=MOST_COUNTED,
        address=address,
    )


def _grades(
    context: PageContext, name: str, query: FilesQuery, shown: ShownPeriod
) -> list[GradeOfFile]:
    found = []
    products = context.app.part(Products)
    missing = without_gyro(context, name, query.run, shown)
    for grade, what in GRADES.items():
        series = products.attitudes(
            name,
            run=query.run,
            start=shown.start,
            end=shown.end,
            grade=grade,
            largest_gap_s=query.gap_s,
        )
        found.append(_counted(grade, what, "" if grade == "raw" else missing, series))
    return found


def _counted(grade: ProductGrade, what: str, missing: str, series: AttitudeSeries) -> GradeOfFile:
    attitudes = stretches = 0
    last = None
    for block in islice(series.blocks, MOST_COUNTED):
        attitudes += len(block)
        begun = len(set(block.stretch.tolist()))
        stretches += begun - (last == int(block.stretch[0]))
        last = int(block.stretch[-1])
        if attitudes >= MOST_COUNTED:
            break
    is_cut = attitudes >= MOST_COUNTED
    return GradeOfFile(
        grade, what, missing, attitudes, stretches, series.about.largest_gap_s, is_cut
    )
