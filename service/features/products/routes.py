"""API routes for exported attitudes and tables of a period, and the attitude at a given time."""

from dataclasses import asdict
from typing import Annotated, Literal

from fastapi import Depends, Path
from pydantic import Field
from starlette.responses import Response

from service.features.products import records
from service.features.products.attitude_formats import (
    attitude_formats,
    file_suffix,
    write_attitudes,
)
from service.features.products.attitudes import ProductGrade, StatusWanted
from service.features.products.moment import AtMethod
from service.features.products.part import Products, TableKind
from service.missions.product_settings import MAX_LARGEST_GAP_S, MIN_NAIF_ID, OBJECT_ID
from service.table_files.formats import JSON_FORMAT, TABLE_FORMATS, write_table
from service.times import shifted
from service.trends.quantities import OneOf
from service.web.openapi import FORMATS_OF, ApiRouter, Example, Returns
from service.web.requests import query_parameters as params
from service.web.requests.access import AppDep, CallerDep, Policy, json_response
from service.web.requests.exports import ExportsDep, attached_as
from service.web.requests.query_parameters import FromQuery, SpacecraftPath

router = ApiRouter("products")
ROUTERS = (router,)
FORMATS_OF["attitudes"] = attitude_formats


LargestGap = Annotated[
    float | None,
    Field(
        gt=0,
        le=MAX_LARGEST_GAP_S,
        allow_inf_nan=False,
        description="Attitudes farther apart than this, in seconds, belong to two stretches. "
        "Default: the mission's; of raw attitudes of a mission without the key, at least 60 and "
        "two and a half times the usual time between batches of the period.",
    ),
]
Statuses = Annotated[
    StatusWanted, Field(description="Only good attitudes, only suspect ones, or `all`.")
]
Grades = Annotated[
    ProductGrade,
    Field(
        description="`raw`: the attitudes of batches. `filtered`, `smoothed`: those that "
        "`acquire smooth` recorded, the latest revision of each day."
    ),
]
TableKindPath = Annotated[
    TableKind,
    Path(
        description="`batches`: one row per batch; `stars`: one row per star; "
        "`gyro`: one row per gyro sample."
    ),
]


async def _products(app: AppDep) -> Products:
    return app.part(Products)


ProductsDep = Annotated[Products, Depends(_products)]


class AttitudeQuery(params.PeriodQuery):
    """Query for attitudes of a period in an output format."""

    format: Annotated[
        str,
        OneOf(lambda: tuple(attitude_formats())),
        Field(description="`json`: objects; any other: a file."),
    ] = JSON_FORMAT
    grade: Grades = "raw"
    status: Statuses = "good"
    order: Annotated[
        Literal["oldest", "newest"],
        Field(description="Which come first. `newest` is for JSON and tables alone."),
    ] = "oldest"
    largest_gap_s: LargestGap = None
    object_id: Annotated[
        str | None,
        Field(
            pattern=f"^{OBJECT_ID}$",
            description="OBJECT_ID of CCSDS messages, such as 1995-074A. Default: the mission's, "
            "or else the name.",
        ),
    ] = None
    naif_id: Annotated[
        int | None,
        Field(
            ge=MIN_NAIF_ID,
            le=-1,
            description="NAIF's id of the spacecraft, for SPICE kernels. Default: the mission's.",
        ),
    ] = None


class AttitudeAtQuery(params.RunQuery):
    """Query for the attitude at a given time, nearest or interpolated."""

    time: Annotated[params.Time, Field(description="The moment.")]
    method: Annotated[
        AtMethod,
        Field(
            description="`interpolated`: between the attitudes before and after the moment, within "
            "a stretch. `nearest`: the nearest one within the largest gap."
        ),
    ] = "interpolated"
    grade: Grades = "raw"
    status: Statuses = "good"
    largest_gap_s: LargestGap = None


class TableQuery(params.PeriodQuery):
    """Query for a table of a period in an output format."""

    format: Annotated[
        str, OneOf(lambda: tuple(TABLE_FORMATS)), Field(description="The format of the file.")
    ] = "csv"


def _days_of(query: params.PeriodQuery) -> str:
    """Text for the name of a file: the first and the last UTC day of its period, or the one day."""
    last = query.end and shifted(query.end, -1e-3)
    days = dict.fromkeys(each.text[:10] for each in (query.start, last) if each)
    return "".join(f"-{day}" for day in days)


@Example("one", path={"name": "SWAS"})
@router.serves(
    "GET /spacecraft/{name}/attitude",
    Policy("read", "path"),
    Returns(
        "The attitudes, in the requested format.", records.AttitudeProduct, formats="attitudes"
    ),
    problems=(503,),
)
def get_attitude(
    name: SpacecraftPath,
    query: FromQuery[AttitudeQuery],
    products: ProductsDep,
    exports: ExportsDep,
    caller: CallerDep,
) -> Response:
    """The attitudes of a period, oldest first: as JSON, a table, or a file of flight dynamics."""
    asked = query.asked()
    format = asked.pop("format")
    written = attitude_formats()[format]
    kind = "attitude" if query.grade == "raw" else f"attitude-{query.grade}"
    series = products.attitudes(name, **asked, most_batches=written.most_batches)
    return exports.response(
        caller,
        lambda: write_attitudes(format, series),
        written.media_type,
        None
        if format == JSON_FORMAT
        else attached_as(f"{name}-{query.run}-{kind}{_days_of(query)}", file_suffix(format)),
    )


@Example("nearest", "status=all&method=nearest&time=1999-060T00:00:05Z", path={"name": "SWAS"})
@Example("none", "status=all&method=nearest&time=1999-061T00:00:00Z", path={"name": "SWAS"})
@router.serves(
    "GET /spacecraft/{name}/attitude/at",
    Policy("read", "path"),
    Returns("The attitude.", records.AttitudeAtMoment),
)
def get_attitude_at(
    name: SpacecraftPath, query: FromQuery[AttitudeAtQuery], products: ProductsDep
) -> Response:
    """The attitude at a given time with its error: interpolated within an interval, or the nearest.

    404 if no attitude lies within the largest gap, or if the time to interpolate at lies within no
    interval.
    """
    asked = query.asked()
    found = products.attitude_at(name, asked.pop("time"), asked.pop("method"), **asked)
    return json_response(records.AttitudeAtMoment(**asdict(found)))


@router.serves(
    "GET /spacecraft/{name}/tables/{kind}",
    Policy("read", "path"),
    Returns(
        "The table, in the requested format.",
        media_type=TABLE_FORMATS["csv"].media_type,
        formats="tables",
    ),
    problems=(503,),
)
def get_table(
    name: SpacecraftPath,
    kind: TableKindPath,
    query: FromQuery[TableQuery],
    products: ProductsDep,
    exports: ExportsDep,
    caller: CallerDep,
) -> Response:
    """A table of a period, oldest first.

    The batches with their quantities, their stars with outcomes, or the gyro samples.
    """
    written = TABLE_FORMATS[query.format]
    table = products.table(name, kind, **query.run_and_times, most_batches=written.most_batches)
    return exports.response(
        caller,
        lambda: write_table(query.format, table),
        written.media_type,
        attached_as(f"{name}-{query.run}-{kind}{_days_of(query)}", query.format),
    )
