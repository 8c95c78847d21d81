"""What may stand behind the question mark: each parameter checked, unknown ones refused."""

from typing import Annotated, Any, Literal, Self, TypedDict

from fastapi import Depends
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    PlainValidator,
    WithJsonSchema,
    field_validator,
    model_validator,
)
from starlette.requests import Request

from service.alarms.quantities import TRENDS, QuantityName
from service.errors import BadBatch, BadInput, Fault, shown_value
from service.observe.wire import Key, RunName
from service.records.alarms import StateFilter
from service.records.reading import OutcomeName, Status
from service.records.rollups import Bucket
from service.records.trends import MAX_SIZE, Strategy
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

Start = Annotated[Time | None, Field(description="The first moment, itself included.")]
End = Annotated[Time | None, Field(description="The last moment, itself excluded.")]
Limit = Annotated[int, Field(ge=1, le=MAX_LIMIT, description="The most items on a page.")]
Cursor = Annotated[
    str | None,
    Field(pattern=r"^[\x21-\x7e]{1,200}$", description="Where the page begins: from a `Link`."),
]
Spacecraft = Annotated[Key | None, Field(description="Only those of this spacecraft.")]


class Query(BaseModel):
    """The ground rules of every query: nothing unknown."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    def asked(self) -> dict[str, Any]:
        """Every parameter by its name, as the operations take them."""
        return {name: getattr(self, name) for name in type(self).model_fields}


class Where(TypedDict):
    """A run and the times of a stretch."""

    run: str
    start: Utc | None
    end: Utc | None


class Stretch(Query):
    """A stretch of time and a run."""

    run: Annotated[RunName, Field(description="The run; `live` is what pipelines send.")] = "live"
    start: Start = None
    end: End = None

    @property
    def stretch(self) -> Where:
        """Its run and times by their names, as the operations take them."""
        return {"run": self.run, "start": self.start, "end": self.end}

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.start and self.end and self.start.tai_ns > self.end.tai_ns:
            raise ValueError(f"start {self.start} must not be after end {self.end}")
        return self


class StretchPage(Stretch):
    """A page of what lies in a stretch of time."""

    limit: Limit = 100
    cursor: Cursor = None


class AuditQuery(Query):
    """A page of changes."""

    limit: Limit = 100
    cursor: Cursor = None


class BatchQuery(StretchPage):
    """Which of the recorded batches."""

    run: Annotated[
        RunName | Literal["*"],
        Field(description="The run; `live` is what pipelines send, `*` stands for every run."),
    ] = "live"
    spacecraft: Spacecraft = None
    outcome: Annotated[
        OutcomeName | None, Field(description="Only those with at least one star of it.")
    ] = None
    status: Annotated[
        Status | None,
        Field(description="Only those whose attitude is good or suspect, or that have none."),
    ] = None


class RunQuery(Query):
    """A run."""

    run: Annotated[RunName, Field(description="The run; `live` is what pipelines send.")] = "live"


class RatesQuery(Stretch):
    """Star rates of a stretch of time, in buckets."""

    bucket: Annotated[Bucket, Field(description="The width of a bucket, in UTC.")] = "hour"


class HistoryQuery(Stretch):
    """A history of quantities, thinned out."""

    quantity: Annotated[
        list[QuantityName],
        Field(description="One or, repeated, several; without any, all that have a history."),
    ] = []
    strategy: Annotated[
        Strategy | None,
        Field(
            description="`minmax`: buckets with mean, least and greatest of a batch; "
            "`latest`: the newest batches one by one. Unless given it is `minmax`, but `latest` "
            "in a CSV without `size`."
        ),
    ] = None
    size: Annotated[
        int | None,
        Field(
            ge=1,
            le=MAX_SIZE,
            description="The most points: 500 unless given, but every batch of the stretch in a "
            "CSV of single batches.",
        ),
    ] = None
    format: Annotated[Literal["json", "csv"], Field(description="Columns, or a table.")] = "json"

    @property
    def of_every_batch(self) -> bool:
        """Whether a table of all batches of the stretch is asked for."""
        return self.format == "csv" and self.size is None and self.strategy != "minmax"

    @field_validator("quantity")
    @classmethod
    def _with_history(cls, names: list[QuantityName]) -> list[QuantityName]:
        for name in names:
            if name not in TRENDS:
                raise ValueError(f"{name} has no history; {', '.join(TRENDS)} have")
        return list(dict.fromkeys(names))


class WorstQuery(Stretch):
    """Which batches are worst, by what."""

    by: Annotated[
        Literal[
            "ambiguous_share",
            "unmatched_share",
            "residual_rms_arcsec",
            "predicted_rms_arcsec",
            "residual_ratio",
            "magnitude_offset_mag",
            "a_priori_angle_deg",
        ],
        Field(description="The quantity; of `magnitude_offset_mag` the size counts."),
    ] = "ambiguous_share"
    limit: Annotated[int, Field(ge=1, le=100, description="The most items.")] = 20


class AlarmQuery(Query):
    """Which alarms."""

    run: Annotated[
        RunName | Literal["*"],
        Field(description="The run; `live` is what pipelines send, `*` stands for every run."),
    ] = "live"
    spacecraft: Spacecraft = None
    state: Annotated[StateFilter, Field(description="`active` are those that are not cleared.")] = (
        "active"
    )
    limit: Limit = 100
    cursor: Cursor = None


Who = Annotated[
    str | None,
    Field(
        min_length=1,
        max_length=64,
        description="Who does this; with a token its name is taken, else this must be there.",
    ),
]
Comment = Annotated[str | None, Field(max_length=2_000, description="What they say of it.")]


class SaidQuery(Query):
    """Who does something, and what they say of it."""

    who: Who = None
    comment: Comment = None


async def require_no_query(request: Request) -> None:
    """Raise `BadBatch` for every parameter that a request brings."""
    faults = [
        Fault(name[:80], "there is no such parameter here; there is none", shown_value(value))
        for name, value in request.query_params.items()
    ]
    if faults:
        raise BadBatch(faults)


NO_QUERY = Depends(require_no_query)
"""For a route that takes no parameter."""
