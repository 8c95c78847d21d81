"""Query parameters of requests, with checks; unknown ones are refused."""

from typing import Annotated, Any, Literal, Self, TypeAlias, TypedDict, TypeVar

from fastapi import Depends, Path
from fastapi import Query as InQuery
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    WithJsonSchema,
    field_validator,
    model_validator,
)

from service.errors import BadInput
from service.observations.schema import Key, RunName
from service.storage.queries.results import OutcomeName, StatusName
from service.storage.queries.time_buckets import Bucket
from service.storage.queries.trends import MAX_SIZE, Strategy
from service.table_files.formats import JSON_FORMAT, TABLE_FORMATS
from service.times import Utc, parse_utc
from service.trends.quantities import OneOf, QuantityName, RankedName, trend_names
from service.web.requests.request_body import require_no_query

T = TypeVar("T")
FromQuery: TypeAlias = Annotated[T, InQuery()]
"""Annotation of a model whose fields are the query parameters of a route."""


def _time(value: object) -> Utc:
    try:
        return parse_utc(value)
    except BadInput as error:
        raise ValueError(error.faults[0].message) from None


TIME_SCHEMA: dict[str, Any] = {
    "type": "string",
    "pattern": r"^\d{4}-(\d\d-\d\d|\d{3})T\d\d:\d\d:\d\d(\.\d{1,9})?(Z|[+-]\d\d(:?\d\d)?)?$",
    "examples": ["1996-01-10T12:00:00.000Z", "1996-010T12:00:00Z"],
}
"""Schema of UTC, calendar or day-of-year; `format: date-time` has no leap seconds."""

Time = Annotated[Utc, PlainValidator(_time), WithJsonSchema(TIME_SCHEMA)]
"""UTC text, calendar or day-of-year, parsed to the type `Utc`."""

Run = Annotated[RunName, Field(description="The run; `live` for the batches of pipelines.")]
RunOrAll = Annotated[
    RunName | Literal["*"],
    Field(description="The run: `live` for the batches of pipelines, `*` for all runs."),
]
Start = Annotated[Time | None, Field(description="Start of the period, included.")]
End = Annotated[Time | None, Field(description="End of the period, excluded.")]
PageLimit = Annotated[int, Field(ge=1, le=500, description="Maximum number of items on a page.")]
Cursor = Annotated[
    str | None,
    Field(
        pattern=r"^[\x21-\x7e]{1,200}$",
        description="Start of the page, taken from a `Link` header.",
    ),
]
OfTracker = Annotated[
    Key | None,
    Field(
        description="Of this tracker's own stars, for the quantities that a tracker has: shares of "
        "its stars, residuals, magnitude offset; `suspect_share` is then the share of batches in "
        "which it is the tracker that disagrees."
    ),
]
SpacecraftFilter = Annotated[Key | None, Field(description="Only items of this spacecraft.")]


class Query(BaseModel):
    """Base of all query models; refuses unknown parameters."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def asked(self) -> dict[str, Any]:
        """Parameters by name, as arguments of the app's functions."""
        return {name: getattr(self, name) for name in type(self).model_fields}


def require_order(start: Utc | None, end: Utc | None) -> None:
    """Raise `ValueError` for a period that ends before it starts."""
    if start and end and start.tai_ns > end.tai_ns:
        raise ValueError(f"start {start} must not be after end {end}")


class RunAndTimes(TypedDict):
    """Arguments for a run and a period."""

    run: str
    start: Utc | None
    end: Utc | None


class PeriodQuery(Query):
    """Query with a run and a period."""

    run: Run = "live"
    start: Start = None
    end: End = None

    @property
    def run_and_times(self) -> RunAndTimes:
        """Run and times by name, as arguments of the app's functions."""
        return {"run": self.run, "start": self.start, "end": self.end}

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        require_order(self.start, self.end)
        return self


class PeriodPageQuery(PeriodQuery):
    """Query for one page of a list within a period."""

    limit: PageLimit = 100
    cursor: Cursor = None


class AuditQuery(Query):
    """Query for one page of the audit list, with filters."""

    limit: PageLimit = 100
    cursor: Cursor = None
    person: Annotated[str, Field(max_length=80, description="Who signed, or the token.")] = ""
    action: Annotated[str, Field(max_length=64, description="Part of the operation's name.")] = ""
    about: Annotated[str, Field(max_length=200, description="Part of the path and query.")] = ""


class BatchQuery(PeriodPageQuery):
    """Query that selects recorded batches by run, period, spacecraft, outcome and status."""

    run: RunOrAll = "live"
    spacecraft: SpacecraftFilter = None
    outcome: Annotated[
        OutcomeName | None,
        Field(description="Only batches with at least one star of this outcome."),
    ] = None
    status: Annotated[
        StatusName | None,
        Field(description="Only batches with a good attitude, with a suspect one, or with none."),
    ] = None
    batch: Annotated[
        Key | None, Field(description="Only the batch with this batch id; needs `spacecraft`.")
    ] = None
    adopted: Annotated[
        bool, Field(description="Only batches whose current result is an adopted what-if.")
    ] = False

    @model_validator(mode="after")
    def _batch_of_a_spacecraft(self) -> Self:
        if self.batch is not None and self.spacecraft is None:
            raise ValueError("batch needs spacecraft: batch ids of two spacecraft may be the same")
        return self


class RunQuery(Query):
    """Query that selects a run."""

    run: Run = "live"


class RatesQuery(PeriodQuery):
    """Query for star rates of a period, in buckets."""

    bucket: Annotated[Bucket, Field(description="The width of a bucket, in UTC.")] = "hour"


class HistoryQuery(PeriodQuery):
    """Query for the history of quantities, thinned or complete."""

    quantity: Annotated[
        list[QuantityName],
        Field(
            description="A quantity; repeat the parameter for several. Default: all "
            "quantities with a history."
        ),
    ] = []
    tracker: OfTracker = None
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
        OneOf(lambda: (JSON_FORMAT, *TABLE_FORMATS)),
        Field(description="`json`: columns; any other: a table, as a file."),
    ] = JSON_FORMAT

    @property
    def of_every_batch(self) -> bool:
        """True if a table of all batches of the period is requested."""
        return self.format != JSON_FORMAT and self.size is None and self.strategy != "minmax"

    @field_validator("quantity")
    @classmethod
    def _with_history(cls, names: list[QuantityName]) -> list[QuantityName]:
        for name in names:
            if name not in trend_names():
                raise ValueError(f"{name} has no history; {', '.join(trend_names())} have")
        return list(dict.fromkeys(names))


class WorstQuery(PeriodQuery):
    """Query for the batches with the worst values of a quantity."""

    by: Annotated[
        RankedName, Field(description="The quantity. For an offset, its absolute value.")
    ] = "ambiguous_share"
    tracker: OfTracker = None
    limit: Annotated[int, Field(ge=1, le=100, description="Maximum number of items.")] = 20


class AnnotationQuery(Query):
    """Query that selects annotations by spacecraft and period."""

    spacecraft: Annotated[
        Key | None,
        Field(description="Only those of this spacecraft, and those about every spacecraft."),
    ] = None
    start: Start = None
    end: End = None
    limit: PageLimit = 100
    cursor: Cursor = None

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        require_order(self.start, self.end)
        return self


def without_nul(text: str | None) -> str | None:
    """Check a text; raises `ValueError` for a NUL character, which PostgreSQL does not store."""
    if text is not None and "\x00" in text:
        raise ValueError("must have no NUL character")
    return text


Who = Annotated[
    str | None,
    Field(
        min_length=1,
        max_length=64,
        description="Your name. Required while access is open; with a token, the service uses "
        "the token's name.",
    ),
    AfterValidator(without_nul),
]
Comment = Annotated[
    str | None, Field(max_length=2_000, description="A comment."), AfterValidator(without_nul)
]


class AuthorQuery(Query):
    """Query with the author of a change."""

    who: Who = None


class StatementQuery(AuthorQuery):
    """Query with the author of a change, and a comment."""

    comment: Comment = None


NO_QUERY = Depends(require_no_query)
"""Dependency of routes that take no query parameter."""


SpacecraftPath = Annotated[str, Path(description="The spacecraft's name, such as `XTE`.")]
