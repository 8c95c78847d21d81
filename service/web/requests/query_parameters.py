"""Query parameters: each is checked, unknown ones are refused."""

from typing import Annotated, Any, Literal, Self, TypedDict

from fastapi import Depends
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    PlainValidator,
    WithJsonSchema,
    field_validator,
    model_validator,
)
from pydantic_core import CoreSchema
from starlette.requests import Request

from service.alarms.quantities import QuantityName, RankedName, trend_names
from service.app.output_formats import OUTPUT_FORMATS
from service.errors import BadBatch, BadInput, Fault, shown_value
from service.observations.schema import Key, RunName
from service.storage.queries.alarms import StateFilter
from service.storage.queries.results import OutcomeName, StatusName
from service.storage.queries.trends import MAX_SIZE, Strategy
from service.storage.recording.rollups import Bucket
from service.times import Utc, parse_utc

MAX_LIMIT = 500


def _time(value: object) -> Utc:
    try:
        return parse_utc(value)
    except BadInput as error:
        raise ValueError(error.faults[0].message) from None


_TIME_SCHEMA = {"type": "string", "examples": ["1996-01-10T12:00:00.000Z", "1996-010T12:00:00Z"]}

Time = Annotated[Utc, PlainValidator(_time), WithJsonSchema(_TIME_SCHEMA)]
"""UTC text, calendar or day-of-year, as the core's own type."""

Start = Annotated[Time | None, Field(description="Start of the period, included.")]
End = Annotated[Time | None, Field(description="End of the period, excluded.")]
PageLimit = Annotated[
    int, Field(ge=1, le=MAX_LIMIT, description="Maximum number of items on a page.")
]
Cursor = Annotated[
    str | None,
    Field(
        pattern=r"^[\x21-\x7e]{1,200}$",
        description="Start of the page, taken from a `Link` header.",
    ),
]
SpacecraftFilter = Annotated[Key | None, Field(description="Only items of this spacecraft.")]


class Query(BaseModel):
    """The base of every query: unknown parameters are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def asked(self) -> dict[str, Any]:
        """Every parameter by its name, as the app's functions take them."""
        return {name: getattr(self, name) for name in type(self).model_fields}


class RunAndTimes(TypedDict):
    """A run and a period."""

    run: str
    start: Utc | None
    end: Utc | None


class PeriodQuery(Query):
    """A period and a run."""

    run: Annotated[RunName, Field(description="The run; `live` for the batches of pipelines.")] = (
        "live"
    )
    start: Start = None
    end: End = None

    @property
    def run_and_times(self) -> RunAndTimes:
        """Its run and times by their names, as the app's functions take them."""
        return {"run": self.run, "start": self.start, "end": self.end}

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.start and self.end and self.start.tai_ns > self.end.tai_ns:
            raise ValueError(f"start {self.start} must not be after end {self.end}")
        return self


class PeriodPageQuery(PeriodQuery):
    """A page of what lies in a period."""

    limit: PageLimit = 100
    cursor: Cursor = None


class AuditQuery(Query):
    """A page of changes."""

    limit: PageLimit = 100
    cursor: Cursor = None


class BatchQuery(PeriodPageQuery):
    """Which of the recorded batches."""

    run: Annotated[
        RunName | Literal["*"],
        Field(description="The run: `live` for the batches of pipelines, `*` for all runs."),
    ] = "live"
    spacecraft: SpacecraftFilter = None
    outcome: Annotated[
        OutcomeName | None,
        Field(description="Only batches with at least one star of this outcome."),
    ] = None
    status: Annotated[
        StatusName | None,
        Field(description="Only batches with a good attitude, with a suspect one, or with none."),
    ] = None


class RunQuery(Query):
    """A run."""

    run: Annotated[RunName, Field(description="The run; `live` for the batches of pipelines.")] = (
        "live"
    )


class RatesQuery(PeriodQuery):
    """Star rates of a period, in buckets."""

    bucket: Annotated[Bucket, Field(description="The width of a bucket, in UTC.")] = "hour"


JSON_FORMAT = "json"
"""The API's own form of a history; every other format is a table."""


class FormatNames:
    """Puts the names of the output formats into the OpenAPI document."""

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """The schema of the parameter, with the formats that are registered by now."""
        return {"enum": format_names(), "type": "string"}


def format_names() -> list[str]:
    """Every value of the parameter `format`."""
    return [JSON_FORMAT, *OUTPUT_FORMATS]


def _format(name: str) -> str:
    names = [repr(each) for each in format_names()]
    if repr(name) not in names:
        raise ValueError(f"Input should be {', '.join(names[:-1])} or {names[-1]}")
    return name


class HistoryQuery(PeriodQuery):
    """A history of quantities, thinned out."""

    quantity: Annotated[
        list[QuantityName],
        Field(
            description="A quantity; repeat the parameter for several. Default: all "
            "quantities with a history."
        ),
    ] = []
    strategy: Annotated[
        Strategy | None,
        Field(
            description="`minmax`: buckets with the mean, and the least and greatest value of a "
            "batch. `latest`: the newest batches one by one. Default: `minmax`; for "
            "a table without `size`, `latest`."
        ),
    ] = None
    size: Annotated[
        int | None,
        Field(
            ge=1,
            le=MAX_SIZE,
            description="Maximum number of points. Default: 500; for a table of single batches, "
            "every batch of the period.",
        ),
    ] = None
    format: Annotated[
        str,
        AfterValidator(_format),
        FormatNames(),
        Field(description="`json`: columns; any other: a table, as a file."),
    ] = JSON_FORMAT

    @property
    def of_every_batch(self) -> bool:
        """Whether a table of all batches of the period is asked for."""
        return self.format != JSON_FORMAT and self.size is None and self.strategy != "minmax"

    @field_validator("quantity")
    @classmethod
    def _with_history(cls, names: list[QuantityName]) -> list[QuantityName]:
        for name in names:
            if name not in trend_names():
                raise ValueError(f"{name} has no history; {', '.join(trend_names())} have")
        return list(dict.fromkeys(names))


class WorstQuery(PeriodQuery):
    """Which batches are worst, by what."""

    by: Annotated[
        RankedName,
        Field(description="The quantity. For `magnitude_offset_mag`, its absolute value."),
    ] = "ambiguous_share"
    limit: Annotated[int, Field(ge=1, le=100, description="Maximum number of items.")] = 20


class AlarmQuery(Query):
    """Which alarms."""

    run: Annotated[
        RunName | Literal["*"],
        Field(description="The run: `live` for the batches of pipelines, `*` for all runs."),
    ] = "live"
    spacecraft: SpacecraftFilter = None
    state: Annotated[
        StateFilter, Field(description="`active`: all alarms that are not cleared.")
    ] = "active"
    limit: PageLimit = 100
    cursor: Cursor = None


Who = Annotated[
    str | None,
    Field(
        min_length=1,
        max_length=64,
        description="Your name. Required while access is open; with a token, the service uses "
        "the token's name.",
    ),
]
Comment = Annotated[str | None, Field(max_length=2_000, description="A comment.")]


class StatementQuery(Query):
    """Who makes a change, and a comment on it."""

    who: Who = None
    comment: Comment = None


async def require_no_query(request: Request) -> None:
    """Raise `BadBatch` for every parameter that a request brings."""
    faults = [
        Fault(name[:80], "unknown parameter; this route has none", shown_value(value))
        for name, value in request.query_params.items()
    ]
    if faults:
        raise BadBatch(faults)


NO_QUERY = Depends(require_no_query)
"""For a route that takes no parameter."""
