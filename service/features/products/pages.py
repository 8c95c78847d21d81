"""Console page of export files: attitudes of a period by grade, and tables."""

from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Annotated
from urllib.parse import quote, urlencode

import numpy as np
from pydantic import Field, field_validator
from starlette.responses import Response

from service.features.products.attitude_formats import attitude_formats
from service.features.products.attitudes import AttitudeSeries, ProductGrade, turns_far
from service.features.products.part import TABLE_KINDS, Products
from service.missions.product_settings import MAX_LARGEST_GAP_S
from service.table_files.formats import TABLE_FORMATS
from service.times import DAY_S, Utc, bucket_start, parse_utc, recorded_utc
from service.web.console.formatting import completed_utc
from service.web.console.page import ContextDep, FromQuery, PageContext, console_page
from service.web.console.pages.period import without_gyro
from service.web.console.pages.spacecraft_page import ShownPeriod, SpacecraftQuery, shown_period
from service.web.requests.access import Policy
from service.web.requests.query_parameters import Start

GRADES: dict[ProductGrade, str] = {
    "smoothed": "The definitive attitude: every measurement of the day, before and after each "
    "moment, with the gyro. The most accurate; it exists once the day was smoothed.",
    "filtered": "From the measurements before each moment, with the gyro, as a filter on board "
    "would have it.",
    "raw": "One attitude for each batch, from its stars alone, independent of its neighbours.",
}
MOST_COUNTED = 5_000
"""Greatest number of attitudes read to count intervals; takes about 0.1 s."""
CONVERGED_S = 900.0
"""Time in seconds that a filter may take until its attitude is good."""
FEW_PER_STRETCH = 10
"""Least mean number of attitudes per interval for a file that is useful for interpolation."""


class FilesQuery(SpacecraftQuery):
    """Query of the files page: period and largest gap; empty: from the mission or the cadence.

    A `day` in UTC is the period in place of the other parameters; without any it is the day of the
    latest batch.
    """

    gap_s: Annotated[float | None, Field(gt=0, le=MAX_LARGEST_GAP_S)] = None
    day: Start = None

    @field_validator("gap_s", mode="before")
    @classmethod
    def _without_empty_gap(cls, value: object) -> object:
        return None if value == "" else value

    @field_validator("day", mode="before")
    @classmethod
    def _completed_day(cls, value: object) -> object:
        return completed_utc(value) if isinstance(value, str) and value else None


@dataclass(frozen=True)
class GradeOfFile:
    """Summary of one grade of attitudes in a period: number, intervals, largest gap.

    `covers` are the times of the first and the last attitude.  `missing` is the reason for having
    none, if known.  Intervals begin `after_turns` of more than
    a quarter turn, `after_missing` attitudes of batches between, and `after_gaps` that are too
    long; each counts for the first of these reasons.

    `is_cut` is true if only the first `MOST_COUNTED` attitudes were counted.
    """

    grade: ProductGrade
    what: str
    missing: str
    covers: tuple[Utc, Utc] | None
    attitudes: int
    after_turns: int
    after_missing: int
    after_gaps: int
    largest_gap_s: float
    is_cut: bool

    @property
    def stretches(self) -> int:
        """Number of intervals."""
        return min(self.attitudes, 1) + self.after_turns + self.after_missing + self.after_gaps

    @property
    def is_shattered(self) -> bool:
        """True if a file has several intervals, and more than a tenth as many as attitudes."""
        return self.stretches * FEW_PER_STRETCH > self.attitudes and self.stretches > 1

    def falls_short_of(self, other: "GradeOfFile") -> bool:
        """True if another grade reaches further in time, by more than gaps and convergence."""
        if self.covers is None or other.covers is None:
            return False
        (first, last), (others_first, others_last) = self.covers, other.covers
        # A filter takes minutes until its first attitude is good.
        least_s = max(CONVERGED_S, self.largest_gap_s, other.largest_gap_s)
        missing_ns = max(first.tai_ns - others_first.tai_ns, others_last.tai_ns - last.tai_ns)
        return missing_ns * 1e-9 > least_s


@console_page("/spacecraft/{name}/files", "Files", Policy("read", "path"), section="/")
def files_page(name: str, query: FromQuery[FilesQuery], context: ContextDep) -> Response:
    """Console page with export files of a period: attitudes by grade and format, and tables."""
    context.app.context.mission(name)
    day = query.day
    if day is None and not (query.range or query.start or query.end):
        latest = context.app.results.page(spacecraft=name, run=query.run, limit=1).items
        day = parse_utc(latest[0].time) if latest else None
    if day:
        start, end = (bucket_start(day.bucket(DAY_S) + each, DAY_S) for each in (0, 1))
        query = query.model_copy(update={"range": None, "start": start, "end": end})
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
        is_stale=_is_stale(context, name, query, shown) if shown else False,
        days=_days(shown.start) if shown else {},
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
        read = partial(
            products.attitudes,
            name,
            run=query.run,
            start=shown.start,
            end=shown.end,
            grade=grade,
        )
        series = read(largest_gap_s=query.gap_s)
        newest = read(order="newest", largest_gap_s=series.about.largest_gap_s)
        found.append(_counted(grade, what, missing, series, newest))
    return found


def _is_stale(context: PageContext, name: str, query: FilesQuery, shown: ShownPeriod) -> bool:
    """True if the latest batch of a period came after its definitive attitude was made."""
    made = context.app.part(Products).made_at(name, query.run, shown.start, shown.end)
    latest = context.app.results.page(
        spacecraft=name, run=query.run, start=shown.start, end=shown.end, limit=1
    ).items
    return bool(made and latest and recorded_utc(latest[0].created).tai_ns > made.tai_ns)


def _days(shown: Utc) -> dict[str, str]:
    """Date of a shown day and its neighbours, as in an address."""
    number = shown.bucket(DAY_S)
    at = {"before": number - 1, "shown": number, "after": number + 1}
    return {name: bucket_start(day, DAY_S).text[:10] for name, day in at.items()}


def _counted(
    grade: ProductGrade, what: str, why_none: str, series: AttitudeSeries, newest: AttitudeSeries
) -> GradeOfFile:
    """Summary of a series of attitudes; `newest` has the same, the latest first."""
    covers = None
    attitudes = after_turns = after_missing = after_gaps = 0
    last = None
    for block in islice(series.blocks, MOST_COUNTED):
        if covers is None:
            # Batches may be pruned meanwhile.
            latest = next(iter(newest.blocks), block)
            covers = parse_utc(block.time[0]), parse_utc(latest.time[0])
        attitudes += len(block)
        rows = block if last is None else last.followed_by(block)
        begins = np.diff(rows.stretch) != 0
        turns, missing = turns_far(rows), np.diff(rows.gaps) != 0
        after_turns += int(np.count_nonzero(begins & turns))
        after_missing += int(np.count_nonzero(begins & ~turns & missing))
        after_gaps += int(np.count_nonzero(begins & ~turns & ~missing))
        last = rows.taken(slice(-1, None))
        if attitudes >= MOST_COUNTED:
            break
    return GradeOfFile(
        grade,
        what,
        "" if grade == "raw" else why_none,
        covers,
        attitudes,
        after_turns,
        after_missing,
        after_gaps,
        series.about.largest_gap_s,
        is_cut=attitudes >= MOST_COUNTED,
    )
