"""Query parameters of products: attitudes, the attitude at a moment, and tables."""

from typing import Annotated, Literal

from fastapi import Path
from pydantic import Field

from service.app.products import TableKind
from service.missions.product_settings import MAX_LARGEST_GAP_S, MIN_NAIF_ID, OBJECT_ID
from service.products.attitudes import ProductGrade, StatusWanted
from service.products.formats import JSON_FORMAT, attitude_formats, table_formats
from service.products.moment import AtMethod
from service.web.requests.query_parameters import FormatNames, PeriodQuery, RunQuery, Time

TDM_MEDIA_TYPE = "text/plain"
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
    StatusWanted,
    Field(description="Only good attitudes, only suspect ones, or `all`."),
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


class AttitudeQuery(PeriodQuery):
    """Attitudes of a period, in a format."""

    format: Annotated[
        str,
        FormatNames(lambda: [*attitude_formats()]),
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


class TracksQuery(PeriodQuery):
    """Tracks of a period, in a format."""

    format: Annotated[
        Literal["json", "tdm"],
        Field(description="`json`: every track; `tdm`: the moving ones as a file, a CCSDS TDM."),
    ] = "json"


class AttitudeAtQuery(RunQuery):
    """A moment, and how its attitude is found."""

    time: Annotated[Time, Field(description="The moment.")]
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


class TableQuery(PeriodQuery):
    """A table of a period, in a format."""

    format: Annotated[
        str,
        FormatNames(lambda: [*table_formats()]),
        Field(description="The format of the file."),
    ] = "csv"
